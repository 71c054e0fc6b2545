# SPDX-License-Identifier: Apache-2.0
"""Healthy drives that are unusual: what a check of the inputs must not take for a fault.

Each is a drive of a world whose motion, plan or records differ as stated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.worlds import FIELD, drive
from benchmarks.worlds.conditions import Coefficients
from benchmarks.worlds.motion import HOLD, Motion, Plan
from benchmarks.worlds.tracks import Way
from benchmarks.worlds.unknowns import random_of
from trainid_ros.interface.records import FORCE, SPEED, Row
from trainid_ros.train.train_file import TrainFile

Rows = Callable[[Sequence[Row], TrainFile, int], list[Row]]


@dataclass(frozen=True, slots=True)
class Unusual:
    """An unusual healthy drive: the world, and what differs from it."""

    name: str
    world: str
    motion: type[Motion] = Motion
    change: Callable[[Plan], Plan] | None = None
    rows: Rows | None = None


class _PowerBraking(Motion):
    """The driver pulls against the brake for the first seconds of each braking."""

    since = math.inf

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        self.since = 0.0 if command == 0.0 else self.since + 0.2
        if 0.0 < self.since < 4.0 and self.speed > 3.0:
            effort = 0.25 * self.plan.vehicle.max_force
        super().advance(way, leg, effort, command)


class _DynamicBraking(Motion):
    """The drives brake without a command, but to hold the train at stops."""

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        if command > 0.0 and self.speed > 1.0:
            rotary = 1.0 + self.plan.vehicle.kind.rotary_mass
            effort, command = -command * self.plan.masses[leg] * rotary, 0.0
        super().advance(way, leg, effort, command)


class _HalfDynamicBraking(_DynamicBraking):
    """Every other time."""

    count, was = 0, 0.0

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        self.count += command > 0.0 and self.was == 0.0
        self.was = command
        if self.count % 2:
            super().advance(way, leg, effort, command)
        else:
            Motion.advance(self, way, leg, effort, command)


class _Wind(Motion):
    """Head wind on the way out, tail wind on the way back."""

    wind = 11.0

    def _steps(self, way: Way, davis: Coefficients, mass: float, effort: float, command: float) -> None:
        a, b, c = davis
        wind = self.wind * way.sign
        # c (v + W)^2, which acts against the train where the wind is slower than it.
        super()._steps(way, (a + c * wind * abs(wind), b + 2.0 * c * wind, c), mass, effort, command)


class _Storm(_Wind):
    wind = 15.0


class _Tunnels(Motion):
    """Short tunnels with 2.5 times the aerodynamic drag."""

    def _steps(self, way: Way, davis: Coefficients, mass: float, effort: float, command: float) -> None:
        a, b, c = davis
        here = way.origin + way.sign * self.way
        super()._steps(way, (a, b, 2.5 * c if here % 1500.0 < 400.0 else c), mass, effort, command)


class _Coupling(Motion):
    """A second train is coupled after 20 min, and not weighed."""

    def _steps(self, way: Way, davis: Coefficients, mass: float, effort: float, command: float) -> None:
        super()._steps(way, davis, mass * (2.0 if self.time > 1200.0 else 1.0), effort, command)


class _NeutralSections(Motion):
    """No traction for some seconds of every minute."""

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        super().advance(way, leg, 0.0 if self.time % 60.0 < 4.0 else effort, command)


class _HillStarts(Motion):
    """The driver pulls before the brake is released."""

    pulled = 0.0

    def advance(self, way: Way, leg: int, effort: float, command: float) -> None:
        if self.speed == 0.0 and command == 0.0 and self.pulled < 3.0:
            self.pulled += 0.2
            effort, command = 0.4 * self.plan.vehicle.max_force, 2.0 * HOLD
        elif self.speed > 1.0:
            self.pulled = 0.0
        super().advance(way, leg, effort, command)


class _LeafSeason(Motion):
    """Wheels slide: in bursts the brake has only a part of its force, and the measured speed is too low."""

    def rate_at(self, base: float, speed: float, nominal: float, acted: float) -> float:
        rate = super().rate_at(base, speed, nominal, acted)
        return rate * (0.65 if nominal > 0.4 and slides(self.time) > 0.0 else 1.0)


def slides(time_s: float) -> float:
    """Return by which share sliding wheels are too slow at a time of the day [s]: bursts of one to three seconds."""
    burst = math.floor(time_s / 4.0)
    kind = (burst * 2654435761) % 97
    return (0.08 + 0.002 * kind) if kind < 45 and time_s % 4.0 < 1.0 + 0.04 * kind else 0.0


def _shunting(plan: Plan) -> Plan:
    ways = tuple(replace(way, limits=((way.limits[0][0], 3.1),)) for way in plan.ways)
    return replace(plan, ways=(ways[0], ways[1]))


def _whole_kmh(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    return [(*row[:2], round(row[2] * 3.6) / 3.6, *row[3:]) if row[0] == SPEED else row for row in rows]


def _in_steps(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    return [(*row[:3], 10.0 * math.floor(row[3] / 10.0), row[4]) if row[0] == SPEED else row for row in rows]


def _balises(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    """The position is 2 % off from balise to balise, which stand every 700 m."""
    sent = list[Row]()
    for row in rows:
        balise = 700.0 * math.floor(row[3] / 700.0) if row[0] == SPEED else 0.0
        sent.append((*row[:3], balise + 1.02 * (row[3] - balise), row[4]) if row[0] == SPEED else row)
    return sent


def _slipping(share: float, most: float) -> Rows:
    def change(rows: Sequence[Row], file: TrainFile, seed: int) -> list[Row]:
        rng = random_of('any', seed, 'slip')
        weight, force, left_s, size, last_ns = file.train.mass * 9.80665e-3, 0.0, 0.0, 0.0, 0
        sent = list[Row]()
        for row in rows:
            if row[0] == FORCE:
                force = row[2] / weight
            if row[0] == SPEED:
                left_s -= (row[1] - last_ns) * 1e-9
                last_ns = row[1]
                if left_s <= 0.0 or force * size <= 0.0:
                    size = left_s = 0.0
                    if abs(force) > 10.0 and row[2] > 1.0 and rng.uniform() < share * 0.2 / 1.3 / 0.5:
                        left_s = float(rng.uniform(0.6, 2.0))
                        size = math.copysign(most * float(rng.uniform(0.15, 1.0)), force)
            sent.append((*row[:2], max(row[2] + size, 0.0), *row[3:]) if row[0] == SPEED else row)
        return sent

    return change


def _sliding(rows: Sequence[Row], _: TrainFile, _seed: int) -> list[Row]:
    start_ns, braked, sent = rows[0][1], False, list[Row]()
    for row in rows:
        if row[0] == FORCE:
            braked = row[2] < 0.0
        slide = slides((row[1] - start_ns) * 1e-9) if row[0] == SPEED and braked else 0.0
        sent.append((*row[:2], row[2] * (1.0 - slide), *row[3:]) if slide > 0.0 else row)
    return sent


UNUSUAL: Final = (
    Unusual('power braking', 'metro', _PowerBraking),
    Unusual('power braking', 'freight', _PowerBraking),
    Unusual('dynamic braking without command', 'metro', _DynamicBraking),
    Unusual('dynamic braking, every other one', 'emu', _HalfDynamicBraking),
    Unusual('wind of 11 m/s', 'metro', _Wind),
    Unusual('wind of 15 m/s', 'emu', _Storm),
    Unusual('speed in whole km/h', 'metro', rows=_whole_kmh),
    Unusual('speed in whole km/h', 'high_speed', rows=_whole_kmh),
    Unusual('speed in whole km/h', 'freight', rows=_whole_kmh),
    Unusual('slip in 4 %', 'metro', rows=_slipping(0.04, 2.0)),
    Unusual('slip in 12 %', 'metro', rows=_slipping(0.12, 3.0)),
    Unusual('slip in 4 %', 'tram', rows=_slipping(0.04, 2.0)),
    Unusual('leaf season', 'tram', _LeafSeason, rows=_sliding),
    Unusual('leaf season', 'emu', _LeafSeason, rows=_sliding),
    Unusual('hill starts', 'metro', _HillStarts),
    Unusual('hill starts', 'freight', _HillStarts),
    Unusual('shunting', 'metro', change=_shunting),
    Unusual('shunting', 'tram', change=_shunting),
    Unusual('tunnels, not stated', 'metro', _Tunnels),
    Unusual('tunnels of the line', 'metro', _Tunnels),
    Unusual('coupling, not weighed', 'emu', _Coupling),
    Unusual('neutral sections', 'emu', _NeutralSections),
    Unusual('neutral sections', 'high_speed', _NeutralSections),
    Unusual('position 2 % off between balises', 'metro', rows=_balises),
    Unusual('position 2 % off between balises', 'high_speed', rows=_balises),
    Unusual('position in steps of 10 m', 'metro', rows=_in_steps),
    Unusual('position in steps of 10 m', 'high_speed', rows=_in_steps),
)


def unusual_drive(case: Unusual, seed: int, duration: float) -> tuple[TrainFile, list[Row]]:
    """Return the train file and the rows of an unusual healthy drive."""
    found = drive(case.world, seed, FIELD, 5.0, duration, case.motion, case.change)
    rows, file = [record.row() for record in found.records], found.train_file
    if case.name == 'tunnels of the line':
        ends = [x for x, _ in file.line.gradient]
        starts = np.arange(math.ceil(min(ends) / 1500.0) * 1500.0, max(ends), 1500.0).tolist()
        file = replace(file, line=replace(file.line, tunnel=tuple((x, x + 400.0) for x in starts)))
    return file, rows if case.rows is None else case.rows(rows, file, seed)
