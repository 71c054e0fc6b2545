# SPDX-License-Identifier: Apache-2.0
"""Forces on the train, compiled with numba; shares no code or formula with the package under test."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.quirks import Quirks

Array = NDArray[np.float64]
GRAV: Final = 9.81


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
    q: Quirks,
    s: Stock,
    track: Track,
    x: float,
    way: float,
    v: float,
    now: float,
    gone: float,
    freed: float,
    since: float,
    pulling: float,
    gust_v: float,
    gust_w: float,
) -> tuple[float, float, float, float]:
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
