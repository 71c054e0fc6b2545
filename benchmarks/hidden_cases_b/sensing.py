# SPDX-License-Identifier: Apache-2.0
"""Sensors of a case: accuracy, wheel slip, odometer drift, gradient of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.motion import LEG, NOM, PULL, WAY, WEIGHED, V, X
from benchmarks.hidden_cases_b.quirks import Quirks
from benchmarks.hidden_cases_b.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Instruments:
    """Sensor parameters of one case, in SI units."""

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
    """Draw sensors; about a quarter of the cases are contaminated."""
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
    """Return the names of circumstances that the scoring may distinguish."""
    words = {
        'outliers': kit.outliers > 0.0,
        'dropouts': kit.dropouts > 0.0,
        'slip_contamination': kit.slip_share > 0.0,
        'point_gradient': kit.point_gradient,
        'late_flags': kit.flags_late > 0.0,
        'pure_odometry': not kit.corrected,
        'lookup_measured': kit.lookup_measured,
        'force_carries_delay': kit.force_carries_delay and quirks.late > 0.0,
        '10_hz': kit.period < 0.15,
    }
    return tuple(word for word, holds in words.items() if holds)


def slip_bursts(rng: np.random.Generator, log: Array, share: float, speed: float) -> Array:
    """Return the slip speed (wheel minus train) [m/s]: bursts of 0.8 to 3 s, likelier at high specific force."""
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


def map_gradient(scene: Scene, front: Array, way: Array, *, point: bool = False) -> Array:
    """Return the map gradient in the direction of travel [per mille], averaged under the train or at its middle."""
    ground, length = scene.ground, scene.stocks[0].length
    if not point:
        return ground.signed_mean_under(ground.climb, front, way, length)
    middle = front - way * 0.5 * length
    return way * (ground.at(ground.climb, middle + 1.0) - ground.at(ground.climb, middle - 1.0)) / 2.0
