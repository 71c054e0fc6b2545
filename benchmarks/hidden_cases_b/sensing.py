# SPDX-License-Identifier: Apache-2.0
"""From the log of a day to records: sampling, quantisation, drift, late flags, lost and wild messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.motion import CMD, GRAV, LEG, NOM, PULL, REAL, WAY, WEIGHED, T, V, X
from benchmarks.hidden_cases_b.quirks import Quirks
from benchmarks.hidden_cases_b.scene import Scene
from trainid_ros.core.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

Array = NDArray[np.float64]
_STRAIGHT: Final = 1e-4  # 1/m


@dataclass(frozen=True, slots=True)
class Instruments:
    """How the signals of one case are made."""

    period: float
    speed_noise: float
    quantum: float
    force_noise: float
    stamp_jitter: float
    corrected: bool
    odo_scale: float
    odo_walk: float
    lookup_measured: bool
    point_gradient: bool
    flags_late: float
    force_carries_delay: bool
    outliers: float
    dropouts: float
    slip_share: float
    slip_speed: float
    base_ns: int


def draw_instruments(rng: np.random.Generator, scene: Scene, quirks: Quirks) -> Instruments:
    """Draw sensors; contamination in about a quarter of the cases."""
    corrected = bool(rng.random() < 0.65)
    slips = rng.random() < 0.1 and quirks.slip_share == 0.0
    return Instruments(
        period=scene.stocks[0].tick * 0.02,
        speed_noise=float(rng.uniform(0.01, 0.05)),
        quantum=float(rng.choice([0.01, 0.03, 0.1])) / 3.6,
        force_noise=float(rng.uniform(0.1, 0.4)),
        stamp_jitter=float(rng.uniform(0.0, 0.002)),
        corrected=corrected,
        odo_scale=float(rng.standard_normal()) * (0.001 if corrected else 0.0002),
        odo_walk=float(rng.uniform(0.01, 0.05)),
        lookup_measured=bool(corrected and rng.random() < 0.5),
        point_gradient=bool(rng.random() < 0.15),
        flags_late=float(rng.uniform(0.0, 8.0)) if rng.random() < 0.6 else 0.0,
        force_carries_delay=bool(rng.random() < 0.5),
        outliers=0.05 if rng.random() < 0.1 else 0.0,
        dropouts=0.03 if rng.random() < 0.1 else 0.0,
        slip_share=float(rng.uniform(0.005, 0.02)) if slips else 0.0,
        slip_speed=float(rng.uniform(0.5, 2.5)) if slips else 0.0,
        base_ns=1_700_000_000_000_000_000 + int(rng.integers(0, 10**15)),
    )


def flags_of(kit: Instruments, quirks: Quirks) -> tuple[str, ...]:
    """Return words for what the scoring may want to tell apart."""
    words = {
        'outliers': kit.outliers > 0.0, 'dropouts': kit.dropouts > 0.0, 'slip_contamination': kit.slip_share > 0.0,
        'point_gradient': kit.point_gradient, 'late_flags': kit.flags_late > 0.0,
        'pure_odometry': not kit.corrected, 'lookup_measured': kit.lookup_measured,
        'force_carries_delay': kit.force_carries_delay and quirks.late > 0.0, '10_hz': kit.period < 0.15,
    }
    return tuple(word for word, holds in words.items() if holds)


def slip_bursts(rng: np.random.Generator, log: Array, share: float, speed: float) -> Array:
    """Return what the wheel turns too fast or too slow [m/s]: humps of 0.8 to 3 s where the pull is greatest."""
    out = np.zeros(len(log))
    push = log[:, PULL] / log[:, WEIGHED] + log[:, NOM]
    moving = np.flatnonzero((log[:, V] > 1.0) & (np.abs(push) > 0.05))
    if share <= 0.0 or len(moving) == 0:
        return out
    goal = share * float(np.count_nonzero(log[:, V] > 0.5))
    odds = np.abs(push[moving])
    odds = odds / odds.sum()
    done = 0.0
    while done < goal:
        width = int(rng.integers(8, 31))
        at = int(rng.choice(moving, p=odds))
        hump = np.sin(np.linspace(0.1, np.pi - 0.1, width)) ** 0.5 * float(rng.uniform(0.3, 1.0)) * speed
        end = min(at + width, len(log))
        same = log[at:end, LEG] == log[at, LEG]
        room = np.abs(hump[: end - at]) * np.sign(push[at]) * same * (log[at:end, V] > 0.3)
        out[at:end] = np.where(out[at:end] == 0.0, room, out[at:end])
        done += width
    return out


def odometer_error(rng: np.random.Generator, log: Array, kit: Instruments, wheel: float, slip: Array) -> Array:
    """Return measured minus true position [m] along the log."""
    step = np.diff(log[:, X], prepend=log[0, X])
    fresh = np.abs(step) > 20.0
    step[fresh] = 0.0
    walk = kit.odo_walk * np.sqrt(0.1) * rng.standard_normal(len(log)) * (log[:, V] > 0.0)
    grown = np.cumsum(step * (wheel * (1.0 + kit.odo_scale) - 1.0) + log[:, WAY] * 0.1 * slip + walk)
    index = np.arange(len(log))
    anchors = (log[:, V] == 0.0) if kit.corrected else np.zeros(len(log), bool)
    anchors = anchors | fresh
    anchors[0] = True
    last = np.maximum.accumulate(np.where(anchors, index, 0))
    error: Array = grown - grown[last]
    return error


def sense(rng: np.random.Generator, scene: Scene, quirks: Quirks, kit: Instruments, log: Array) -> list[list[Record]]:
    """Return the records of every bag in the order of their stamps."""
    share, speed = (kit.slip_share, kit.slip_speed) if kit.slip_share else (quirks.slip_share, quirks.slip_speed)
    slip = slip_bursts(np.random.default_rng([kit.base_ns % 2**31, 5]), log, share, speed)
    error = odometer_error(rng, log, kit, quirks.wheel, slip)
    bag_of = np.array([leg.bag for leg in scene.legs])[log[:, LEG].astype(int)]
    bags = []
    for bag in range(int(bag_of.max()) + 1):
        rows = np.flatnonzero(bag_of == bag)
        bags.append(_bag(rng, scene, quirks, kit, log[rows], error[rows], slip[rows]))
    return bags


def _bag(
    rng: np.random.Generator, scene: Scene, quirks: Quirks, kit: Instruments, log: Array, error: Array, slip: Array
) -> list[Record]:
    time = log[:, T]
    begin, end = float(time[0]), float(time[-1])
    records: list[Record] = []

    def grid(period: float, phase: float) -> Array:
        return np.arange(begin + phase, end - 0.01, period)

    def stamps(at: Array, *, exact: bool = False) -> list[int]:
        shaken = at if exact else at + np.clip(kit.stamp_jitter * rng.standard_normal(len(at)), -0.004, 0.004)
        return [kit.base_ns + int(ns) for ns in np.round(shaken * 1e9).tolist()]

    def kept(at: Array) -> NDArray[np.bool_]:
        return rng.random(len(at)) >= kit.dropouts

    def of(column: int | Array, at: Array) -> Array:
        return np.interp(at, time, log[:, column] if isinstance(column, int) else column)

    def held(column: int, at: Array) -> Array:
        row = np.clip(np.searchsorted(time, at + 1e-6, side='right') - 1, 0, len(time) - 1)
        picked: Array = log[row, column]
        return picked

    at = grid(kit.period, float(rng.uniform(0.0, 0.04)))
    true = of(V, at)
    raw = quirks.wheel * true + of(slip, at) + kit.speed_noise * rng.standard_normal(len(at))
    wild = rng.random(len(at)) < kit.outliers
    raw = np.where(wild, raw + rng.choice([-1.0, 1.0], len(at)) * rng.uniform(1.0, 8.0, len(at)), raw)
    seen = np.maximum(np.round(raw / kit.quantum) * kit.quantum, 0.0)
    seen = np.where((true <= 0.0) & ~wild, 0.0, seen)
    place = of(X, at) + of(error, at)
    ok = kept(at)
    records += [
        SpeedRecord(s, v, x)
        for s, v, x, k in zip(stamps(at), seen.tolist(), place.tolist(), ok.tolist(), strict=True) if k
    ]

    at = grid(kit.period, float(rng.uniform(0.0, 0.19)) % kit.period)
    then = at - quirks.force_late
    mass = held(WEIGHED, then)
    effort = of(REAL if kit.force_carries_delay else NOM, then)
    pull = of(int(PULL), then)
    force = pull + mass * (1.0 + scene.stocks[0].gamma) * effort
    force = force + kit.force_noise * mass * GRAV / 1000.0 * rng.standard_normal(len(at))
    force = force * (1.0 + 0.002 * rng.standard_normal(len(at)))
    ok = kept(at)
    records += [ForceRecord(s, f) for s, f, k in zip(stamps(at), force.tolist(), ok.tolist(), strict=True) if k]

    at = grid(kit.period, float(rng.uniform(0.0, 0.19)) % kit.period)
    way = held(WAY, at)
    front = of(X, at) + (of(error, at) if kit.lookup_measured else 0.0)
    slope = felt_gradient(scene, front + way * quirks.map_ahead, way, point=kit.point_gradient)
    ground, length = scene.ground, scene.stocks[0].length
    behind = front - way * kit.flags_late
    bend = ground.mean_under(ground.bend, behind, way, length)
    radius = np.where(bend > _STRAIGHT, 1.0 / np.maximum(bend, _STRAIGHT), 0.0)
    dark = ground.mean_under(ground.bore, behind, way, length) >= 0.5
    ok = kept(at)
    records += [
        GradientRecord(s, g, r, d)
        for s, g, r, d, k in zip(stamps(at), slope.tolist(), radius.tolist(), dark.tolist(), ok.tolist(), strict=True)
        if k
    ]

    at = grid(kit.period, 0.0)
    ok = kept(at)
    command = held(CMD, at) + 0.0
    records += [
        BrakeRecord(s, u, emergency=False)
        for s, u, k in zip(stamps(at, exact=True), command.tolist(), ok.tolist(), strict=True) if k
    ]

    def weighing() -> list[Record]:
        at = grid(1.0, float(rng.uniform(0.0, 0.5)))
        ok = kept(at)
        weighed = held(WEIGHED, at)
        return [MassRecord(s, m) for s, m, k in zip(stamps(at), weighed.tolist(), ok.tolist(), strict=True) if k]

    records += weighing() if scene.mass_topic else []
    records.sort(key=lambda record: record.stamp_ns)
    return records


def felt_gradient(scene: Scene, front: Array, way: Array, *, point: bool = False) -> Array:
    """Return the map's gradient under the train, or at the middle of the train."""
    ground, length = scene.ground, scene.stocks[0].length
    if not point:
        return ground.felt(ground.climb, front, way, length)
    middle = front - way * 0.5 * length
    return way * (ground.at(ground.climb, middle + 1.0) - ground.at(ground.climb, middle - 1.0)) / 2.0
