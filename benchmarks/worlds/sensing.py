# SPDX-License-Identifier: Apache-2.0
"""Records that sensors, drive control and brake control publish on the topics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.worlds.unknowns import G, random_of
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from benchmarks.worlds.motion import Log, Plan

EPOCH_NS: Final = 1_700_000_000_000_000_000
JITTER: Final = 0.5e-3
# Noise of the reported force: shares of the value and of the weight.
FORCE_NOISE: Final = (0.003, 0.0002)
MAP_STEP: Final = 5.0
# Spacing of the gradients in the train file when they have errors [m].
MAP_PIECE: Final = 50.0


@dataclass(frozen=True, slots=True)
class Rates:
    speed: float = 5.0
    force: float = 5.0
    gradient: float = 5.0
    brake: float = 5.0
    mass: float = 1.0


@dataclass(frozen=True, slots=True)
class MapError:
    """Error of the gradients by position [per mille of rising position]."""

    position: NDArray[np.float64]
    error: NDArray[np.float64]

    def at(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error at positions [m] [per mille]."""
        return np.interp(position, self.position, self.error)


def draw_map_error(plan: Plan, world: str, seed: int) -> MapError:
    """Draw the error of the gradients, a first-order Gauss-Markov process in position."""
    errors, way = plan.errors, plan.ways[0]
    rng = random_of(world, seed, 'map along the line')
    count = int(way.gradient.size / MAP_STEP) + 2
    shocks = rng.normal(size=count)
    keep = float(np.exp(-MAP_STEP / errors.map_length))
    out, value = [], float(shocks[0])
    for shock in shocks:
        value = keep * value + float(np.sqrt(1.0 - keep * keep)) * float(shock)
        out.append(value)
    return MapError(
        way.origin - way.offset + MAP_STEP * np.arange(count, dtype=np.float64), errors.map_std * np.array(out)
    )


def draw_weighed(plan: Plan, world: str, seed: int) -> NDArray[np.float64]:
    """Draw the weighed mass of each run [kg]."""
    errors, masses = plan.errors, np.array(plan.masses)
    noise = random_of(world, seed, 'load weighing').normal(size=masses.size)
    return np.asarray(masses * (1.0 + errors.mass) * (1.0 + errors.weighing * noise))


class Sensors:
    """Converts the true motion to records."""

    def __init__(self, plan: Plan, log: Log, weighed: NDArray[np.float64], map_error: MapError) -> None:
        self.plan, self.log, self.weighed, self.map_error = plan, log, weighed, map_error
        ways = plan.ways
        self.position = np.where(log.direction == 0, ways[0].position(log.way), ways[1].position(log.way))

    def speed(self, stamps: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Record]:
        errors, log = self.plan.errors, self.log
        ratio = 1.0 + errors.wheels
        true = np.interp(stamps, log.time, log.speed)
        noisy = true * ratio + errors.speed_noise * rng.normal(size=stamps.size)
        shown = np.where(true > 0.0, np.maximum(np.round(noisy / errors.quantum), 0.0) * errors.quantum, 0.0)
        start = self.position[0]
        position = start + ratio * (np.interp(stamps, log.time, self.position) - start)
        for at, v, s in zip(_ns(stamps), shown.tolist(), np.round(position, 2).tolist(), strict=True):
            yield SpeedRecord(at, v, s)

    def force(self, stamps: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Record]:
        """Yield reported efforts; while braking, that of a nominal brake."""
        plan, log = self.plan, self.log
        inertia = self.weighed[log.leg] * (1.0 + plan.vehicle.kind.rotary_mass)
        reported = log.force / (1.0 + plan.errors.force_gain) - inertia * log.nominal
        value = np.interp(stamps - plan.errors.force_delay, log.time, reported)
        share, of_weight = FORCE_NOISE
        std = np.hypot(share * value, of_weight * plan.vehicle.mass * G)
        value = np.round(value + std * rng.normal(size=stamps.size), 1)
        for at, force in zip(_ns(stamps), value.tolist(), strict=True):
            yield ForceRecord(at, force)

    def gradient(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        """Yield gradient and curve radius under the train, from the map."""
        plan, log = self.plan, self.log
        at_way = np.interp(stamps, log.time, log.way)
        side = log.direction[self._before(stamps)]
        gradient, curvature = np.empty(stamps.size), np.empty(stamps.size)
        for i, way in enumerate(plan.ways):
            here = side == i
            index, grid = at_way[here] + way.offset, np.arange(way.gradient.size)
            middle = way.position(at_way[here] - 0.5 * plan.vehicle.length)
            gradient[here] = np.interp(index, grid, way.gradient) + way.sign * self.map_error.at(middle)
            curvature[here] = way.curvature[np.round(index).astype(np.int64)]
        radius = np.where(curvature > 0.0, 1.0 / np.maximum(curvature, 1e-6), 0.0)
        for at, slope, r in zip(_ns(stamps), gradient.tolist(), radius.tolist(), strict=True):
            yield GradientRecord(at, slope, r, False)

    def brake(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        command = self.log.command[self._before(stamps)]
        for at, value in zip(_ns(stamps), command.tolist(), strict=True):
            yield BrakeRecord(at, -round(value, 3) if value > 0.0 else 0.0, False)

    def mass(self, stamps: NDArray[np.float64], _: np.random.Generator) -> Iterator[Record]:
        weighed = self.weighed[self.log.leg[self._before(stamps)]]
        for at, value in zip(_ns(stamps), weighed.tolist(), strict=True):
            yield MassRecord(at, value)

    def _before(self, stamps: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.maximum(np.searchsorted(self.log.time, stamps + 1e-9, side='right') - 1, 0)


def sense(sensors: Sensors, rates: Rates, world: str, seed: int) -> tuple[Record, ...]:
    """Return the records of all topics in order of arrival; freight trains have no load weighing."""
    senders = (
        ('speed', rates.speed, sensors.speed),
        ('force', rates.force, sensors.force),
        ('gradient', rates.gradient, sensors.gradient),
        ('brake', rates.brake, sensors.brake),
        *((('mass', rates.mass, sensors.mass),) if sensors.plan.vehicle.kind.load > 0.0 else ()),
    )
    records: list[Record] = []
    end = float(sensors.log.time[-1])
    for name, rate, sender in senders:
        rng = random_of(world, seed, f'sensor {name}')
        # Commands are sent at once; the other topics have a random phase.
        phase = 1.0e-3 if name == 'brake' else float(rng.uniform(2e-3, 1.0 / rate))
        stamps = np.arange(phase, end - 2.0 * JITTER, 1.0 / rate)
        stamps = stamps + np.clip(JITTER * rng.normal(size=stamps.size), -0.9e-3, 0.9e-3)
        records.extend(sender(stamps, rng))
    records.sort(key=lambda record: record.stamp_ns)
    return tuple(records)


def _ns(stamps: NDArray[np.float64]) -> list[int]:
    ns: list[int] = (EPOCH_NS + np.round(stamps * 1e9).astype(np.int64)).tolist()
    return ns
