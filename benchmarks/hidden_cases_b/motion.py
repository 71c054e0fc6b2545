# SPDX-License-Identifier: Apache-2.0
"""Motion of a train between two stops: effects, forces, driver and balance at 20 ms, compiled with numba.

Shares no code or formula with the package under test.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAV: Final = 9.81
# Modes of the driver.
PULLING: Final = 0
KEEPING: Final = 1
COASTING: Final = 2
STOPPING: Final = 3
SLOWING: Final = 4  # for a restriction
CREEPING: Final = 5  # up to the stopping point
CHECKING: Final = 6  # speed downhill
H = 0.02  # s
LOG_EVERY = 5  # steps
LONGEST = 2400.0  # s
COLUMNS = 14
(T, X, V, WAY, PULL, NOM, CMD, GUST, FLAW, WEIGHED, LEG, ACC, LOADED, REAL) = range(COLUMNS)
# State of the train: time [s], position [m], heat [J/kg], distance run [m], time since the brake release [s], speed
# [m/s], traction and traction shown [N], nominal and true brake [m/s^2], acceleration [m/s^2]. The first five last.
STATES, LASTING = 11, 5
(S_TIME, S_PLACE, S_HEAT, S_GONE, S_FREED, S_SPEED, S_PUSH, S_SHOWN, S_NOMINAL, S_REAL, S_ACC) = range(STATES)


class Quirks(NamedTuple):
    """Strength of every effect; read by compiled code, so it holds floats only."""

    bore_gain: float = 1.0  # aerodynamic drag inside a tunnel over that outside
    flange: float = 0.0  # N/kN m
    slope_from: float = 0.0
    slope_to: float = 0.0
    slope_miss: float = 0.0  # true minus map gradient, rising position
    wind: float = 0.0  # m/s, + against rising position
    heavy: float = 1.0  # true over weighed mass
    pull: float = 1.0  # true over reported traction
    bite: float = 1.0  # true over nominal brake
    fade_loss: float = 0.0
    fade_heat: float = 1.0  # J/kg
    fade_cool: float = 250.0  # s
    late: float = 0.0  # s
    drag_after: float = 0.0  # N/kN
    drag_for: float = 0.0  # s
    stiction: float = 0.0  # N/kN
    stiction_v: float = 1.0  # m/s
    cold: float = 0.0  # N/kN
    cold_time: float = 0.0  # s; 0: by distance
    cold_run: float = 1.0  # m
    jump: float = 0.0  # N/kN
    jump_at: float = 1e9  # s
    rub_from: float = 0.0
    rub_to: float = 0.0
    rub: float = 0.0  # N/kN, both ways
    cubic: float = 0.0
    # Outside the library.
    wave: float = 0.0  # N/kN, along the line
    wave_length: float = 1000.0
    wave_phase: float = 0.0
    creep: float = 0.0  # N/kN per hour
    bite_speed: float = 0.0  # loss of brake per m/s
    sag: float = 0.0  # loss of traction per m/s beyond sag_from
    sag_from: float = 1e9
    rotary: float = 0.0  # true minus assumed gamma
    surge: float = 0.0  # N/kN per m/s^2 of |acceleration|
    oneway_pull: float = 0.0  # N/kN, in traction, rising position only
    whim: float = 0.0  # N/kN, times a factor of the run
    damp: float = 0.0  # N/kN in a speed band
    damp_mid: float = 0.0
    damp_wide: float = 1.0
    parked: float = 0.0  # N/kN at departure, decays
    parked_time: float = 60.0
    cant: float = 0.0  # N/kN per m/s^2 of lateral acceleration
    crowd: float = 0.0  # N/kN per 1 % of load above usual
    storm: float = 0.0  # N/kN between two times
    storm_from: float = 1e9
    storm_to: float = 1e9
    feeder_from: float = 0.0
    feeder_to: float = 0.0
    feeder: float = 0.0  # loss of traction on a section of the line
    hill: float = 0.0  # N/kN per per mille of |gradient|
    # Sensors; the kernel does not read them.
    wheel: float = 1.0
    slip_share: float = 0.0
    slip_speed: float = 0.0
    map_ahead: float = 0.0  # m
    force_late: float = 0.0  # s


NEUTRAL = Quirks()


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
    crowding: float  # load above the usual one [%]
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


class Track(NamedTuple):
    """Integrals along the line, every 2 m from ``origin`` [m] on."""

    origin: float
    climb: Array  # of the map's gradient [per mille m]
    flaw: Array  # of the map error [per mille m]
    bend: Array  # of 1/R [1]
    bore: Array  # of the tunnel indicator [m]


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
def drags(
    q: Quirks, s: Stock, track: Track, x: float, way: float, v: float, now: float, gone: float, freed: float,
    since: float, pulling: float, gust_v: float, gust_w: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return the total resistance without brake and inertia, then gradient, gust and map error [N/kN]."""
    rear, origin = x - way * s.length, track.origin
    slope = (_read(track.climb, origin, x) - _read(track.climb, origin, rear)) / s.length
    miss = (_read(track.flaw, origin, x) - _read(track.flaw, origin, rear)) / s.length
    curv = abs(_read(track.bend, origin, x) - _read(track.bend, origin, rear)) / s.length
    dark = abs(_read(track.bore, origin, x) - _read(track.bore, origin, rear)) / s.length
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
def rate(
    q: Quirks, s: Stock, push: float, nominal: float, heat: float, v: float, w: float, x: float
) -> tuple[float, float]:
    """Return the acceleration, and the brake deceleration of the nominal inertia (<= 0) [m/s^2]."""
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
def decide(
    s: Stock, v: float, left: float, covered: float, slope: float, arrived: bool, mode: int, cmd: float,
    demand: float, brake_wait: int,
) -> tuple[int, float, float, int]:  # fmt: skip
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


class Gusts(NamedTuple):
    """Gust speed [m/s] and additional gust resistance [N/kN], every 0.1 s."""

    speed: Array
    force: Array


@njit(cache=True)
def run_leg(
    q: Quirks, s: Stock, track: Track, gusts: Gusts, state: Array, way: float, leg: float, target: float,
    dwell: float, log: Array, row: int,
) -> int:  # fmt: skip
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
    q: Quirks, s: Stock, track: Track, gusts: Gusts, state: Array, way: float, start: float, w: float, push: float,
    real: float, arrived: bool,
) -> None:  # fmt: skip
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
