# SPDX-License-Identifier: Apache-2.0
"""The driver, compiled with numba: traction and brake command at each tick."""

from __future__ import annotations

import math
from typing import Final

from numba import njit

from benchmarks.hidden_cases_b.forces import GRAV, Stock

# Modes of the driver.
PULLING: Final = 0
KEEPING: Final = 1
COASTING: Final = 2
STOPPING: Final = 3
SLOWING: Final = 4  # for a restriction
CREEPING: Final = 5  # up to the stopping point
CHECKING: Final = 6  # speed downhill


@njit(cache=True)
def decide(
    s: Stock,
    v: float,
    left: float,
    covered: float,
    slope: float,
    arrived: bool,
    mode: int,
    cmd: float,
    demand: float,
    brake_wait: int,
) -> tuple[int, float, float, int]:
    """Return mode, brake command [m/s^2], demanded traction [N] and ticks until the brake may change."""
    limit = s.cruise
    plan_w = s.a + s.b * v + s.c * v * v + slope
    if s.zone_from >= 0.0 and s.zone_from <= covered <= s.zone_to + s.length:
        limit = min(limit, s.zone_speed)
    if arrived:
        demand = 0.0
    elif mode == STOPPING:
        mode, cmd, brake_wait = _stop(s, v, left, plan_w, cmd, brake_wait)
        demand = 0.0
    elif mode == SLOWING:
        demand = 0.0
        if v + cmd * (s.delay + 0.5 * s.lag) <= s.zone_speed:
            mode, cmd = COASTING, 0.0
    elif mode == CHECKING:
        demand = 0.0
        if v < limit - 0.4:
            mode, cmd = COASTING, 0.0
    else:
        mode, demand = _pull(s, v, left, limit, plan_w, mode, demand)
        mode, cmd = _check(s, v, covered, limit, plan_w, mode, cmd)
    reserve = v * (s.delay + s.lag)
    sure = s.serve + 0.8 * min(slope, 0.0) * GRAV / 1000.0
    near = left <= v * v / (2.0 * sure) + reserve + 2.0 and (v > 2.0 or left < 4.0)
    if not arrived and mode != STOPPING and near:
        mode, brake_wait, demand = STOPPING, 0, 0.0
    if mode == CREEPING and v > 7.0 and left > 60.0:
        mode = COASTING
    return mode, cmd, demand, brake_wait


@njit(cache=True)
def _stop(s: Stock, v: float, left: float, plan_w: float, cmd: float, brake_wait: int) -> tuple[int, float, int]:
    if v < math.sqrt(max(0.0, s.serve * left)) - 2.5 and left > 40.0:
        return CREEPING, 0.0, brake_wait
    brake_wait -= 1
    if brake_wait > 0:
        return STOPPING, cmd, brake_wait
    want = v * v / (2.0 * max(left - 0.3 * v * s.lag, 0.4)) - 0.7 * plan_w * GRAV / 1000.0
    if v < 1.2:
        want = min(want, 0.35) if left > 0.0 else 0.5
    want = min(max(want, 0.08), 1.5 * s.serve)
    new = -round(want / s.notch) * s.notch
    if abs(new - cmd) > 0.6 * s.notch:
        return STOPPING, min(new, -0.05), s.beat
    return STOPPING, cmd, brake_wait


@njit(cache=True)
def _pull(s: Stock, v: float, left: float, limit: float, plan_w: float, mode: int, demand: float) -> tuple[int, float]:
    mass = s.weighed * (1.0 + s.gamma)
    strongest = min(s.pull_max, s.power / max(v, 0.5))
    if mode == PULLING:
        demand = strongest
        if v >= limit - 0.15:
            mode = KEEPING if s.style < 0.5 else COASTING
    elif mode == COASTING:
        demand = 0.0
        spared = left < s.last_coast and v > 0.45 * s.cruise
        if v < limit - s.band and not spared:
            mode = PULLING
    elif mode == CREEPING:
        demand = min(max(mass * (plan_w * GRAV / 1000.0 + 0.3 * (7.0 - v)), 0.0), s.pull_max)
    if mode == KEEPING:
        hold = mass * (plan_w * GRAV / 1000.0 + 0.12 * (limit - v))
        low = -0.25 * s.pull_max if s.electric > 0.5 else 0.0
        demand = min(max(hold, low), strongest)
        if v < limit - 3.0:
            mode = PULLING
    if mode < COASTING and left < s.last_coast and v > 0.6 * s.cruise:
        mode = COASTING
    return mode, demand


@njit(cache=True)
def _check(s: Stock, v: float, covered: float, limit: float, plan_w: float, mode: int, cmd: float) -> tuple[int, float]:
    """Brake downhill and before restrictions."""
    if v > limit + 1.0 and s.electric < 0.5:
        mode = CHECKING
        cmd = -max(s.notch, round((0.12 - plan_w * GRAV / 1000.0) / s.notch) * s.notch)
    elif v > limit + 1.0:
        mode = KEEPING
    to_zone = s.zone_from - covered
    needed = (v * v - s.zone_speed**2) / (2.0 * 0.8 * s.serve) + v * (s.delay + s.lag)
    if s.zone_from >= 0.0 and v > s.zone_speed + 0.5 and 0.0 < to_zone <= needed:
        mode = SLOWING
        cmd = -round(0.8 * s.serve / s.notch) * s.notch
    return mode, cmd
