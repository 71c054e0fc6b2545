# SPDX-License-Identifier: Apache-2.0
"""Conditions that vary during a drive: resistance by weather, brake rate, gusts and load."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from benchmarks.worlds.unknowns import Errors, Vehicle

Coefficients = tuple[float, float, float]

# Changes fall in this part of the drive, so that there is data before and after each.
FIRST_CHANGE: Final = 0.3
LAST_CHANGE: Final = 0.8


@dataclass(frozen=True, slots=True)
class Resistance:
    """Davis coefficients [N/kN, v in m/s] by time [s]; ``values[i]`` hold from ``times[i]`` on."""

    times: tuple[float, ...]
    values: tuple[Coefficients, ...]

    def at(self, time: float) -> Coefficients:
        """Return a, b, c [N/kN, v in m/s] at a time [s]."""
        return self.values[bisect_right(self.times, time) - 1]


@dataclass(frozen=True, slots=True)
class BrakeRate:
    """Brake rate by time: linear between the points (time [s], rate [1])."""

    times: tuple[float, ...]
    rates: tuple[float, ...]
    changes: tuple[float, ...]

    def at(self, time: float) -> float:
        """Return the rate [1] at a time [s]."""
        return float(np.interp(time, self.times, self.rates))


def draw_resistance(vehicle: Vehicle, duration: float, changes: bool, rng: np.random.Generator) -> Resistance:
    """Draw one or two steps of resistance: of a as by rain, or of c as by wind."""
    times, values = [0.0], [vehicle.davis]
    for at in _change_times(rng, duration) if changes else ():
        a, b, c = values[-1]
        if rng.uniform() < 0.5:
            step = float(rng.uniform(0.3, 0.6))
            a += step if a < vehicle.davis[0] + 0.1 else -step
        else:
            c *= float(rng.uniform(1.15, 1.3)) ** (1 if c < 1.05 * vehicle.davis[2] else -1)
        times.append(at)
        values.append((a, b, c))
    return Resistance(tuple(times), tuple(values))


def draw_brake_rate(vehicle: Vehicle, duration: float, changes: bool, rng: np.random.Generator) -> BrakeRate:
    """Draw a slow drift of the brake rate with one or two steps or ramps."""
    rate = vehicle.brake_rate
    if not changes:
        return BrakeRate((0.0,), (rate,), ())
    at = _change_times(rng, duration)
    ends = [start if rng.uniform() < 0.5 else start + float(rng.uniform(60.0, 240.0)) for start in at]
    times, rates = [0.0], [rate]
    drift = float(rng.uniform(-0.03, 0.03)) / 3600.0
    for start, end in zip(at, ends, strict=True):
        rate += drift * (start - times[-1])
        times.append(start)
        rates.append(rate)
        rate = _changed(rate, rng)
        times.append(end + 1e-3)
        rates.append(rate)
    times.append(2.0 * duration)
    rates.append(rate + drift * (times[-1] - times[-2]))
    return BrakeRate(tuple(times), tuple(rates), at)


def draw_gusts(errors: Errors, count: int, step: float, rng: np.random.Generator) -> list[float]:
    """Draw the random specific resistance [N/kN], one value per time step (first-order Gauss-Markov process)."""
    keep = float(np.exp(-step / errors.gust_time))
    noise = (errors.gust_std * np.sqrt(1.0 - keep**2) * rng.normal(size=count)).tolist()
    out, value = [], errors.gust_std * float(rng.normal())
    for shock in noise:
        value = keep * value + shock
        out.append(value)
    return out


def draw_loads(vehicle: Vehicle, count: int, rng: np.random.Generator) -> list[float]:
    """Draw the mass from each stop to the next one [kg]: part of the passengers changes."""
    most = vehicle.kind.load
    load, out = float(rng.uniform(0.0, most)), []
    for _ in range(count):
        out.append(vehicle.mass * (1.0 + load))
        load = float(np.clip(load + rng.uniform(-0.6, 0.6) * most, 0.0, most))
    return out


def _changed(rate: float, rng: np.random.Generator) -> float:
    """Return a rate in 0.75 to 1.1 that differs by more than 0.07."""
    while True:
        new = float(rng.uniform(0.75, 1.1))
        if abs(new - rate) > 0.07:
            return new


def _change_times(rng: np.random.Generator, duration: float) -> tuple[float, ...]:
    count = int(rng.integers(1, 3))
    width = (LAST_CHANGE - FIRST_CHANGE) / count
    return tuple(duration * (FIRST_CHANGE + width * (i + float(rng.uniform(0.1, 0.7)))) for i in range(count))
