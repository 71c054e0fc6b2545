# SPDX-License-Identifier: Apache-2.0
"""Motion of a train between two stops: longitudinal balance at 20 ms, compiled with numba."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.driver import PULLING, STOPPING, decide
from benchmarks.hidden_cases_b.forces import Stock, drags, rate
from benchmarks.hidden_cases_b.quirks import Quirks

Array = NDArray[np.float64]
H = 0.02  # s
LOG_EVERY = 5  # steps
COLUMNS = 14
(T, X, V, WAY, PULL, NOM, CMD, GUST, FLAW, WEIGHED, LEG, ACC, LOADED, REAL) = range(COLUMNS)


@njit(cache=True)
def run_leg(  # noqa: PLR0915 - one loop over plain numbers compiles best
    q: Quirks,
    s: Stock,
    origin: float,
    climb: Array,
    flaw: Array,
    bend: Array,
    bore: Array,
    state: Array,
    way: float,
    leg: float,
    target: float,
    dwell: float,
    gust_v: Array,
    gust_w: Array,
    log: Array,
    row: int,
) -> int:
    """Drive to ``target`` and stand for ``dwell`` seconds.

    Args:
        q: Quirks.
        s: Stock of this leg.
        origin: Position of the first node of the tables [m].
        climb: Integral of the map's gradient [per mille m].
        flaw: Integral of the map error [per mille m].
        bend: Integral of 1/R [1].
        bore: Integral of the tunnel indicator [m].
        state: [time s, position, heat J/kg, distance run, seconds since brake release], changed in place.
        way: +1 or -1.
        leg: Number of the leg.
        target: Where to stop [m].
        dwell: Time to stand [s].
        gust_v: Gust speed [m/s], every 0.1 s.
        gust_w: Additional gust resistance [N/kN], every 0.1 s.
        log: Rows of 0.1 s, filled from ``row`` on.
        row: First free row.

    Returns:
        The next free row, or -1 if the log is full or the stop was not reached.

    """
    now, x, heat, gone, freed = state[0], state[1], state[2], state[3], state[4]
    start_x = x
    v = 0.0
    push = 0.0
    shown = 0.0
    nominal = s.hold
    real = s.hold
    cmd = 0.0
    mode = PULLING
    count = 0
    n_late = round(s.delay / H)
    n_real = round((s.delay + q.late) / H)
    ring = np.full(n_real + 2, s.hold)
    head = 0
    fall = 1.0 - math.exp(-H / s.lag)
    stood = 0.0
    arrived = False
    demand = 0.0
    brake_wait = 0
    acc = 0.0
    mass = s.weighed * (1.0 + s.gamma)
    while True:
        w, slope, gust, miss = drags(
            q,
            s,
            origin,
            climb,
            flaw,
            bend,
            bore,
            x,
            way,
            v,
            now,
            gone,
            freed,
            now - state[0],
            push,
            gust_v[int(now * 10.0)],
            gust_w[int(now * 10.0)],
        )
        if count % s.tick == 0:
            mode, cmd, demand, brake_wait = decide(
                s, v, way * (target - x), way * (x - start_x), slope, arrived, mode, cmd, demand, brake_wait
            )
        if count % LOG_EVERY == 0:
            if row >= log.shape[0]:
                return -1
            line = log[row]
            line[0] = now
            line[1] = x
            line[2] = v
            line[3] = way
            line[4] = shown
            line[5] = nominal
            line[6] = cmd
            line[7] = gust
            line[8] = miss
            line[9] = s.weighed
            line[10] = leg
            line[11] = acc
            line[12] = s.loaded * q.heavy
            line[13] = real
            row += 1
        # Actuators: midpoint of the step.
        change = s.jerk * mass * H
        goal = demand if cmd > -1e-9 else 0.0
        rest = push
        push += min(max(goal - push, -change), change)
        if push > 0.0:
            # A motor at its power limit follows the speed, not the jerk limit.
            push = min(push, max(s.power / max(v, 0.5), 0.0))
        mid_push = 0.5 * (rest + push)
        shown += (push - shown) * (1.0 - math.exp(-H / s.filter)) if s.filter > 0.0 else push - shown
        ring[head] = cmd
        size = ring.shape[0]
        due = ring[(head - n_late) % size]
        due_real = ring[(head - n_real) % size]
        head = (head + 1) % size
        nominal += (due - nominal) * fall
        before = real
        real += (due_real - real) * fall
        mid_real = 0.5 * (before + real)
        freed = 0.0 if real < -0.02 else freed + H
        # Midpoint rule.
        a1, _ = rate(q, s, mid_push, mid_real, heat, v, w, x)
        vm = max(v + 0.5 * H * a1, 0.0)
        w2, _, _, _ = drags(
            q,
            s,
            origin,
            climb,
            flaw,
            bend,
            bore,
            x + way * 0.5 * H * v,
            way,
            vm,
            now,
            gone,
            freed,
            now - state[0],
            push,
            gust_v[int(now * 10.0)],
            gust_w[int(now * 10.0)],
        )
        a2, brake = rate(q, s, mid_push, mid_real, heat, vm, w2, x)
        heat += H * (max(-brake, 0.0) * vm - heat / q.fade_cool)
        # After arrival the train is held by its brake or interlocked doors.
        nv = 0.0 if arrived else v + H * a2
        if nv <= 0.0:
            ds = 0.5 * v * H if v > 0.0 else 0.0
            acc = -v / H
            nv = 0.0
        else:
            ds = 0.5 * (v + nv) * H
            acc = a2
        x += way * ds
        gone += ds
        v = nv
        now += H
        count += 1
        if v == 0.0 and mode == STOPPING and not arrived:
            arrived = True
            cmd = s.hold
        if arrived:
            stood += H
            if stood >= dwell - 1e-9 and count % (s.tick * LOG_EVERY) == 0:
                break
        if now - state[0] > 2400.0:
            return -1
    state[0], state[1], state[2], state[3], state[4] = now, x, heat, gone, freed
    return row
