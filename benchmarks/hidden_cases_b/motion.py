# SPDX-License-Identifier: Apache-2.0
"""Motion of a train between two stops: longitudinal balance at 20 ms, and the driver, compiled with numba.

Written for itself: shares no code and no formula text with the package that is tested.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.quirks import Quirks

Array = NDArray[np.float64]
H = 0.02  # s
GRAV = 9.81
LOG_EVERY = 5  # steps
COLUMNS = 14
(T, X, V, WAY, PULL, NOM, CMD, GUST, FLAW, WEIGHED, LEG, ACC, LOADED, REAL) = range(COLUMNS)


class Stock(NamedTuple):
    """The train and its driver for one leg."""

    length: float
    gamma: float
    a: float
    b: float
    c: float
    lag: float
    delay: float
    weighed: float
    loaded: float  # true mass without the effect mass_error
    crowding: float  # per cent above the usual load
    whim: float
    pull_max: float
    power: float
    jerk: float
    serve: float  # service deceleration
    cruise: float
    band: float
    style: float  # 0 hold, 1 on-off, 2 coasting
    last_coast: float  # m before the stop from where no traction is used
    zone_from: float  # speed restriction, m from the departure; < 0 none
    zone_to: float
    zone_speed: float
    notch: float  # resolution of the command
    beat: int  # ticks between two decisions on the brake
    tick: int  # steps of 20 ms per decision
    hold: float  # command while standing, <= 0
    electric: float  # 1: holds speed downhill with negative traction
    filter: float  # s, lag of the reported traction
    wind_gust: float  # 1: gusts enter through the air speed
    still: float  # 1: no wind in tunnels


@njit(cache=True)
def _read(table: Array, origin: float, x: float) -> float:
    p = (x - origin) / 2.0
    i = int(p)
    i = max(i, 0)
    i = min(i, table.shape[0] - 2)
    value: float = table[i] + (p - i) * (table[i + 1] - table[i])
    return value


@njit(cache=True)
def _overlap(front: float, rear: float, low: float, high: float, length: float) -> float:
    a = max(min(front, rear), low)
    b = min(max(front, rear), high)
    return max(0.0, b - a) / length


@njit(cache=True)
def _drags(
    q: Quirks, s: Stock, origin: float, climb: Array, flaw: Array, bend: Array, bore: Array, x: float, way: float,
    v: float, now: float, gone: float, freed: float, since: float, pulling: float, gust_v: float, gust_w: float,
) -> tuple[float, float, float, float]:
    """Return all resistances [N/kN] but those of brake and acceleration, then the shares of gust and flaw."""
    rear = x - way * s.length
    slope = (_read(climb, origin, x) - _read(climb, origin, rear)) / s.length
    miss = (_read(flaw, origin, x) - _read(flaw, origin, rear)) / s.length
    curv = abs(_read(bend, origin, x) - _read(bend, origin, rear)) / s.length
    dark = abs(_read(bore, origin, x) - _read(bore, origin, rear)) / s.length
    open_air = 1.0 - dark * s.still
    aero = s.c * (1.0 + (q.bore_gain - 1.0) * dark)
    calm = v + way * q.wind * open_air
    air = calm + gust_v * open_air
    gust = aero * (air * abs(air) - calm * abs(calm)) + gust_w * min(1.0, v / 3.0)
    w = s.a + s.b * v + aero * calm * abs(calm) + slope + miss + gust
    w += q.flange * curv
    w += way * q.slope_miss * _overlap(x, rear, q.slope_from, q.slope_to, s.length)
    w += q.rub * _overlap(x, rear, q.rub_from, q.rub_to, s.length)
    w += q.cubic * v * v * v
    w += q.stiction * math.exp(-v / q.stiction_v)
    if q.cold_time > 0.0:
        w += q.cold * math.exp(-now / q.cold_time)
    else:
        w += q.cold * math.exp(-gone / q.cold_run)
    if now >= q.jump_at:
        w += q.jump
    if freed < q.drag_for:
        w += q.drag_after
    if q.wave != 0.0:
        w += q.wave * math.sin(6.283185307 * (x - 0.5 * way * s.length) / q.wave_length + q.wave_phase)
    w += q.creep * now / 3600.0
    w += q.whim * s.whim
    if q.damp != 0.0:
        d = (v - q.damp_mid) / q.damp_wide
        w += q.damp * math.exp(-0.5 * d * d)
    if q.parked != 0.0:
        w += q.parked * math.exp(-since / q.parked_time)
    w += q.cant * curv * v * v + q.crowd * s.crowding + q.hill * abs(slope)
    if q.storm_from <= now < q.storm_to:
        w += q.storm
    if way > 0.0 and pulling > 0.0:
        w += q.oneway_pull
    return w, slope, gust, miss


@njit(cache=True)
def _rate(
    q: Quirks, s: Stock, push: float, nominal: float, heat: float, v: float, w: float, x: float
) -> tuple[float, float]:
    """Return acceleration [m/s^2] and the brake's deceleration of the nominal inertia (<= 0)."""
    mass = s.loaded * q.heavy
    loss = q.fade_loss * (1.0 - math.exp(-heat / q.fade_heat))
    brake = q.bite * (1.0 - loss) * (1.0 - q.bite_speed * v) * nominal
    gain = q.pull
    if v > q.sag_from and push > 0.0:
        gain *= 1.0 - q.sag * (v - q.sag_from)
    if q.feeder_from <= x < q.feeder_to and push > 0.0:
        gain *= 1.0 - q.feeder
    force = gain * push + brake * s.weighed * (1.0 + s.gamma)
    weight = mass * GRAV / 1000.0
    acc = (force - weight * w) / (mass * (1.0 + s.gamma + q.rotary))
    if q.surge != 0.0:
        # Implicit in |a|: a = a0 - k |a|.
        k = q.surge * GRAV / 1000.0 / (1.0 + s.gamma + q.rotary)
        acc = acc / (1.0 + k) if acc > 0.0 else acc / (1.0 - k)
    return acc, brake


@njit(cache=True)
def run_leg(  # noqa: PLR0912, PLR0915
    q: Quirks, s: Stock, origin: float, climb: Array, flaw: Array, bend: Array, bore: Array, state: Array, way: float,
    leg: float, target: float, dwell: float, gust_v: Array, gust_w: Array, log: Array, row: int,
) -> int:
    """Drive to ``target`` and stand for ``dwell`` seconds.

    Args:
        q: Quirks.
        s: Stock of this leg.
        origin: Position of the first node of the tables.
        climb: Integral of the map's gradient; likewise flaw, bend, bore of the ground.
        flaw: Of the map.
        bend: Of 1/R.
        bore: Of the tunnels.
        state: [time s, position, heat J/kg, distance run, seconds since brake release], changed in place.
        way: +1 or -1.
        leg: Number of the leg.
        target: Where to stop [m].
        dwell: Time to stand [s].
        gust_v: Gust speed, 0.1 s.
        gust_w: Further gust resistance [N/kN], 0.1 s.
        log: Rows of 0.1 s, filled from ``row`` on.
        row: First free row.

    Returns:
        The next free row, or -1 if the log is full or the stop was never reached.

    """
    now, x, heat, gone, freed = state[0], state[1], state[2], state[3], state[4]
    start_x = x
    v = 0.0
    push = 0.0
    shown = 0.0
    nominal = s.hold
    real = s.hold
    cmd = 0.0
    mode = 0
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
    peak = 0.0
    while True:
        w, slope, gust, miss = _drags(
            q, s, origin, climb, flaw, bend, bore, x, way, v, now, gone, freed, now - state[0], push,
            gust_v[int(now * 10.0)], gust_w[int(now * 10.0)],
        )
        if count % s.tick == 0:
            left = way * (target - x)
            covered = way * (x - start_x)
            limit = s.cruise
            plan_w = s.a + s.b * v + s.c * v * v + slope
            in_zone = s.zone_from >= 0.0 and s.zone_from <= covered <= s.zone_to + s.length
            if in_zone:
                limit = min(limit, s.zone_speed)
            reserve = v * (s.delay + s.lag)
            sure = s.serve + 0.8 * min(slope, 0.0) * GRAV / 1000.0
            to_zone = s.zone_from - covered
            if arrived:
                demand = 0.0
            elif mode == 3:
                if v < math.sqrt(max(0.0, s.serve * left)) - 2.5 and left > 40.0:
                    mode = 5
                    cmd = 0.0
                else:
                    brake_wait -= 1
                    if brake_wait <= 0:
                        want = v * v / (2.0 * max(left - 0.3 * v * s.lag, 0.4)) - 0.7 * plan_w * GRAV / 1000.0
                        if v < 1.2:
                            want = min(want, 0.35) if left > 0.0 else 0.5
                        want = min(max(want, 0.08), 1.5 * s.serve)
                        new = -round(want / s.notch) * s.notch
                        if abs(new - cmd) > 0.6 * s.notch:
                            cmd = min(new, -0.05)
                            brake_wait = s.beat
                    demand = 0.0
            elif mode == 4:
                demand = 0.0
                if v + cmd * (s.delay + 0.5 * s.lag) <= s.zone_speed:
                    cmd = 0.0
                    mode = 2
            elif mode == 6:
                demand = 0.0
                if v < limit - 0.4:
                    cmd = 0.0
                    mode = 2
            else:
                if mode == 0:
                    demand = min(s.pull_max, s.power / max(v, 0.5))
                    if v >= limit - 0.15:
                        mode = 1 if s.style < 0.5 else 2
                elif mode == 2:
                    demand = 0.0
                    spared = left < s.last_coast and v > 0.45 * s.cruise
                    if v < limit - s.band and not spared:
                        mode = 0
                elif mode == 5:
                    demand = min(max(mass * (plan_w * GRAV / 1000.0 + 0.3 * (7.0 - v)), 0.0), s.pull_max)
                if mode == 1:
                    hold = mass * (plan_w * GRAV / 1000.0 + 0.12 * (limit - v))
                    low = -0.25 * s.pull_max if s.electric > 0.5 else 0.0
                    demand = min(max(hold, low), s.pull_max, s.power / max(v, 0.5))
                    if v < limit - 3.0:
                        mode = 0
                if mode < 2 and left < s.last_coast and v > 0.6 * s.cruise:
                    mode = 2
                if v > limit + 1.0 and s.electric < 0.5:
                    mode = 6
                    cmd = -max(s.notch, round((0.12 - plan_w * GRAV / 1000.0) / s.notch) * s.notch)
                elif v > limit + 1.0:
                    mode = 1
                way_to_slow = (v * v - s.zone_speed**2) / (2.0 * 0.8 * s.serve) + reserve
                if s.zone_from >= 0.0 and v > s.zone_speed + 0.5 and 0.0 < to_zone <= way_to_slow:
                    mode = 4
                    cmd = -round(0.8 * s.serve / s.notch) * s.notch
            if not arrived and mode != 3 and left <= v * v / (2.0 * sure) + reserve + 2.0 and (v > 2.0 or left < 4.0):
                mode = 3
                brake_wait = 0
                demand = 0.0
            if mode == 5 and v > 7.0 and left > 60.0:
                mode = 2
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
        a1, _ = _rate(q, s, mid_push, mid_real, heat, v, w, x)
        vm = max(v + 0.5 * H * a1, 0.0)
        w2, _, _, _ = _drags(
            q, s, origin, climb, flaw, bend, bore, x + way * 0.5 * H * v, way, vm, now, gone, freed, now - state[0],
            push, gust_v[int(now * 10.0)], gust_w[int(now * 10.0)],
        )
        a2, brake = _rate(q, s, mid_push, mid_real, heat, vm, w2, x)
        heat += H * (max(-brake, 0.0) * vm - heat / q.fade_cool)
        # Once it has arrived a train is held, by its brake or by its doors.
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
        peak = max(peak, v)
        if v == 0.0 and mode == 3 and not arrived:
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
