# SPDX-License-Identifier: Apache-2.0
"""Motion of a train between two stops: longitudinal balance at 20 ms, compiled with numba."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.driver import PULLING, STOPPING, decide
from benchmarks.hidden_cases_b.forces import Stock, Track, drags, rate
from benchmarks.hidden_cases_b.quirks import Quirks

Array = NDArray[np.float64]
H = 0.02  # s
LOG_EVERY = 5  # steps
LONGEST = 2400.0  # s
COLUMNS = 14
(T, X, V, WAY, PULL, NOM, CMD, GUST, FLAW, WEIGHED, LEG, ACC, LOADED, REAL) = range(COLUMNS)
# State of the train: time [s], position [m], heat [J/kg], distance run [m], time since the brake release [s], speed
# [m/s], traction and traction shown [N], nominal and true brake [m/s^2], acceleration [m/s^2]. The first five last.
STATES, LASTING = 11, 5
(S_TIME, S_PLACE, S_HEAT, S_GONE, S_FREED, S_SPEED, S_PUSH, S_SHOWN, S_NOMINAL, S_REAL, S_ACC) = range(STATES)


class Gusts(NamedTuple):
    """Gust speed [m/s] and additional gust resistance [N/kN], every 0.1 s."""

    speed: Array
    force: Array


@njit(cache=True)
def run_leg(
    q: Quirks,
    s: Stock,
    track: Track,
    gusts: Gusts,
    state: Array,
    way: float,
    leg: float,
    target: float,
    dwell: float,
    log: Array,
    row: int,
) -> int:
    """Drive to ``target`` and stand for ``dwell`` seconds.

    Args:
        q: Quirks.
        s: Stock of this leg.
        track: Tables of the line.
        gusts: Gusts.
        state: State of the train, changed in place.
        way: +1 or -1.
        leg: Number of the leg.
        target: Where to stop [m].
        dwell: Time to stand [s].
        log: Rows of 0.1 s, filled from ``row`` on.
        row: First free row.

    Returns:
        The next free row, or -1 if the log is full or the stop was not reached.

    """
    state[LASTING:] = 0.0
    state[S_NOMINAL] = state[S_REAL] = s.hold
    start, origin = state[S_TIME], state[S_PLACE]
    ring = np.full(round((s.delay + q.late) / H) + 2, s.hold)
    mode, cmd, demand, brake_wait = PULLING, 0.0, 0.0, 0
    stood, arrived, count = 0.0, False, 0
    while state[S_TIME] - start <= LONGEST:
        x, v = state[S_PLACE], state[S_SPEED]
        w, slope, gust, miss = _drags(q, s, track, gusts, state, way, start, x, v)
        if count % s.tick == 0:
            left, covered = way * (target - x), way * (x - origin)
            mode, cmd, demand, brake_wait = decide(s, v, left, covered, slope, arrived, mode, cmd, demand, brake_wait)
        if count % LOG_EVERY == 0:
            if row >= log.shape[0]:
                return -1
            _note(log[row], q, s, state, way, leg, cmd, gust, miss)
            row += 1
        push, real = _actuate(q, s, state, ring, count, cmd, demand)
        _move(q, s, track, gusts, state, way, start, w, push, real, arrived)
        count += 1
        if state[S_SPEED] == 0.0 and mode == STOPPING and not arrived:
            arrived, cmd = True, s.hold
        if arrived:
            stood += H
            if stood >= dwell - 1e-9 and count % (s.tick * LOG_EVERY) == 0:
                return row
    return -1


@njit(cache=True)
def _drags(
    q: Quirks, s: Stock, track: Track, gusts: Gusts, state: Array, way: float, start: float, x: float, v: float
) -> tuple[float, float, float, float]:
    now = state[S_TIME]
    k = int(now * 10.0)
    gone, freed, push = state[S_GONE], state[S_FREED], state[S_PUSH]
    return drags(q, s, track, x, way, v, now, gone, freed, now - start, push, gusts.speed[k], gusts.force[k])


@njit(cache=True)
def _note(
    line: Array, q: Quirks, s: Stock, state: Array, way: float, leg: float, cmd: float, gust: float, miss: float
) -> None:
    """Fill a row of the log."""
    line[T] = state[S_TIME]
    line[X] = state[S_PLACE]
    line[V] = state[S_SPEED]
    line[WAY] = way
    line[PULL] = state[S_SHOWN]
    line[NOM] = state[S_NOMINAL]
    line[CMD] = cmd
    line[GUST] = gust
    line[FLAW] = miss
    line[WEIGHED] = s.weighed
    line[LEG] = leg
    line[ACC] = state[S_ACC]
    line[LOADED] = s.loaded * q.heavy
    line[REAL] = state[S_REAL]


@njit(cache=True)
def _actuate(
    q: Quirks, s: Stock, state: Array, ring: Array, count: int, cmd: float, demand: float
) -> tuple[float, float]:
    """Advance traction and brake by a step; return both in its middle; ``ring`` holds the latest commands."""
    change = s.jerk * (s.weighed * (1.0 + s.gamma)) * H
    goal = demand if cmd > -1e-9 else 0.0
    before = state[S_PUSH]
    push = before + min(max(goal - before, -change), change)
    if push > 0.0:
        # A motor at its power limit follows the speed, not the jerk limit.
        push = min(push, max(s.power / max(state[S_SPEED], 0.5), 0.0))
    shown = state[S_SHOWN]
    state[S_PUSH] = push
    state[S_SHOWN] += (push - shown) * (1.0 - math.exp(-H / s.filter)) if s.filter > 0.0 else push - shown
    size = ring.shape[0]
    head = count % size
    ring[head] = cmd
    due, due_real = ring[(head - round(s.delay / H)) % size], ring[(head - round((s.delay + q.late) / H)) % size]
    fall = 1.0 - math.exp(-H / s.lag)
    real = state[S_REAL]
    state[S_NOMINAL] += (due - state[S_NOMINAL]) * fall
    state[S_REAL] += (due_real - real) * fall
    state[S_FREED] = 0.0 if state[S_REAL] < -0.02 else state[S_FREED] + H
    return 0.5 * (before + push), 0.5 * (real + state[S_REAL])


@njit(cache=True)
def _move(
    q: Quirks,
    s: Stock,
    track: Track,
    gusts: Gusts,
    state: Array,
    way: float,
    start: float,
    w: float,
    push: float,
    real: float,
    arrived: bool,
) -> None:
    """Advance the motion by a step with the midpoint rule; ``w`` is the resistance at its begin."""
    x, v, heat = state[S_PLACE], state[S_SPEED], state[S_HEAT]
    a1, _ = rate(q, s, push, real, heat, v, w, x)
    vm = max(v + 0.5 * H * a1, 0.0)
    w2, _, _, _ = _drags(q, s, track, gusts, state, way, start, x + way * 0.5 * H * v, vm)
    a2, brake = rate(q, s, push, real, heat, vm, w2, x)
    state[S_HEAT] += H * (max(-brake, 0.0) * vm - heat / q.fade_cool)
    # After arrival the train is held by its brake or interlocked doors.
    nv = 0.0 if arrived else v + H * a2
    if nv <= 0.0:
        ds = 0.5 * v * H if v > 0.0 else 0.0
        state[S_ACC] = -v / H
        nv = 0.0
    else:
        ds = 0.5 * (v + nv) * H
        state[S_ACC] = a2
    state[S_PLACE] += way * ds
    state[S_GONE] += ds
    state[S_SPEED] = nv
    state[S_TIME] += H
