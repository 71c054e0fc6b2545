# SPDX-License-Identifier: Apache-2.0
"""Drive of a train of several cars in newtons: balance, adhesion, blended brake and driver at 20 ms (numba).

Gravity acts on the mass of each car, air on the whole train: its drag is a force, not a share of the weight. Without an
interlock traction acts beside the brake, while one gives way to the other or the driver pulls against the brake.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit

from benchmarks.hidden_log import STEP, Array, G

LONGEST: Final = 1500.0
"""Longest time of a leg [s]."""
HOLD: Final = -0.5
"""Brake command at standstill [m/s^2]."""
# Sizes of effects, 0 for none. Relative: air drag in tunnels, mass, traction, brake, loss of a hot brake, of the brake
# per m/s, of air density per hour, of traction at standstill and in a section; rotary mass.
TWISTS: Final = 39
(BORE, HEAVY, PULL, BITE, FADE, IRON, THIN, CREEP, WIRE, SPIN) = range(10)
# In N/kN, some per unit: curvature, cubed speed, after a release, at standstill, of cold bearings, from a time on, on
# wet legs, of full traction, of lateral acceleration, for rising positions, after departure, of load, of a section.
(FLANGE, CUBIC, CLING, STICK, COLD, JUMP, WET, GEAR, TIGHT, BIASED, PARKED, AXLE, RUB) = range(10, 23)
# Others: headwind and decay of STICK [m/s], heat of FADE [J/kg], more dead time and lag of releases, duration of CLING
# and begin of JUMP [s], decay of COLD and section [m], error of the slope there [per mille].
(WIND, STICK_V, FADE_HEAT, LATE, STUCK, CLING_FOR, JUMP_AT, COLD_RUN, START, END, SLOPE) = range(23, 34)
# Of the sensors, which the balance does not read: measured over true speed, share and speed of slip, late stamps of the
# force [s], early reading of the map [m].
(WHEEL, SLIP, SLIP_V, SKEW, SHIFT) = range(34, 39)
_BEAT: Final = 20  # Steps between two decisions
_DWELL: Final = 25.0  # [s]
_RING: Final = 400  # Steps of the command that are remembered
_ED_LAG: Final = 0.15  # Of the electric brake [s]


class Leg(NamedTuple):
    """Train and driver on the way to a stop; SI units, resistance in N/kN."""

    length: float
    mass: float  # True, without the effect on it
    weighed: float
    gamma: float
    a: float
    b: float
    c: float
    drag: float  # N (s/m)^2
    effort: float
    power: float
    adhesive: float  # Weight on driven wheels [N]
    jerk: float
    delay: float  # Of the nominal brake
    lag: float
    later: float  # Dead time of applications less that of the nominal brake; releases are as much earlier
    slower: float  # The same of the lag
    electric: float  # Share of the electric brake at speed
    serve: float  # Usual braking
    cruise: float
    start: float = 0.0
    target: float = 0.0
    way: float = 1.0  # +1 or -1
    load: float = 1.0  # Mass over the usual one
    band: float = 0.0  # Speed lost before traction is used again; 0 holds the speed
    notch: float = 0.05  # Resolution of the brake command
    overlap: float = 0.0  # 0 interlock, 1 none, 2 with light braking in traction too
    coast: float = 0.0  # Distance from the stop without traction
    zone: float = -1e4  # Distance from the departure to a restriction of 150 m
    zone_v: float = 0.0
    wet: float = 0.0  # 1 on wet rails


class Track(NamedTuple):
    """Per metre from ``origin`` on, by position of the front and direction of travel."""

    origin: float
    tables: Array  # Slope of the map and of the masses [per mille], curvature [1/m], tunnel share, section; (2, n, 5)


@njit(cache=True)
def _accelerate(
    t: Array, leg: Leg, at: Array, v: float, pull: float, brake: Array, gust: float, now: float, gone_s: float,
    run: float, heat: float, since: float,
) -> float:  # fmt: skip
    """Return dv/dt [m/s^2] with effects of the sizes ``t``; ``since`` a release [s]."""
    air = v + (gust + leg.way * t[WIND]) * (1.0 - at[3])
    drag = leg.drag * (1.0 - t[THIN] * now / 3600.0) * (1.0 + t[BORE] * at[3]) * air * abs(air)
    w = leg.a + leg.b * v + at[1] + (leg.way * t[SLOPE] + t[RUB]) * at[4] + at[2] * (t[FLANGE] + t[TIGHT] * v * v)
    w += t[CUBIC] * v**3 + t[STICK] * math.exp(-v / (t[STICK_V] + 1e-9)) + t[WET] * leg.wet
    w += t[COLD] * math.exp(-run / (t[COLD_RUN] + 1e-9)) + t[JUMP] * (now >= t[JUMP_AT])
    w += t[CLING] * (0.0 < since < t[CLING_FOR]) + t[BIASED] * (leg.way > 0.0)
    w += t[GEAR] * (pull / leg.effort) ** 2 + t[PARKED] * math.exp(-gone_s / 40.0) + 10.0 * t[AXLE] * (leg.load - 1.0)
    gain = (1.0 + t[PULL]) * (1.0 - t[CREEP] * math.exp(-v / 4.0)) * (1.0 - t[WIRE] * at[4])
    hot = 1.0 - t[FADE] * min(1.0, heat / (t[FADE_HEAT] + 1e-9))
    braking = (1.0 + t[BITE]) * (1.0 - t[IRON] * v) * (brake[0] + hot * brake[1]) * leg.weighed * (1.0 + leg.gamma)
    mass = leg.mass * (1.0 + t[HEAVY])
    rate: float = (gain * pull + braking - mass * G / 1000.0 * w - drag) / (mass * (1.0 + leg.gamma + t[SPIN]))
    return rate


@njit(cache=True)
def _share(leg: Leg, v: float) -> float:
    """Return the share of the electric brake, which fades out from 4 to 2 m/s."""
    return leg.electric * min(1.0, max(0.0, 0.5 * (v - 2.0)))


@njit(cache=True)
def _press(t: Array, leg: Leg, ring: Array, k: int, v: float, brake: Array) -> None:
    """Advance electric and friction brake [m/s^2]; dead time and lag depend on the direction of change."""
    on = ring[(k - round((leg.delay + leg.later + t[LATE]) / STEP)) % _RING]
    off = ring[(k - round((leg.delay - leg.later + t[LATE]) / STEP)) % _RING]
    due = max(on, off) if leg.later > 0.0 else min(on, off)
    lag = (leg.lag - leg.electric * _ED_LAG) / (1.0 - leg.electric)
    # The friction brake is asked early for what the electric one is about to lose.
    friction = due * (1.0 - _share(leg, max(0.0, v + lag * due)))
    lag += leg.slower if friction < brake[1] else t[STUCK] - leg.slower
    brake[0] += (due * _share(leg, v) - brake[0]) * (1.0 - math.exp(-STEP / _ED_LAG))
    brake[1] += (friction - brake[1]) * (1.0 - math.exp(-STEP / lag))


@njit(cache=True)
def _decide(
    leg: Leg, v: float, left: float, gone: float, slope: float, now: float, nominal: float, hand: Array
) -> tuple[float, float]:
    """Return brake command [m/s^2] and traction wanted [N]; ``hand``: braking, resting, last command."""
    look, top = v * (leg.delay + leg.lag), leg.cruise
    need, near = v * v / (2.0 * max(left - look, 1.0)), left < 20.0 + look
    if leg.zone <= gone <= leg.zone + 150.0 + leg.length:
        top = leg.zone_v
    elif gone < leg.zone and v > leg.zone_v:
        need = max(need, (v * v - leg.zone_v**2) / (2.0 * max(leg.zone - gone - look, 1.0)))
    w = (leg.a + leg.b * v + leg.c * v * v + slope) * G / 1000.0
    if need > leg.serve or v > top + 1.0 or (near and v > 2.0):
        hand[0] = 1.0
    elif need < 0.4 * leg.serve and v < top - 0.5 and not near:
        hand[0] = 0.0
    if hand[0] > 0.0:
        want = min(1.2, max(0.12, need - 0.6 * w, 0.3 * (min(v - top, 1.0) if v > 2.0 else 1.0) - min(w, 0.0)))
        if abs(want + hand[2]) > 0.6 * leg.notch:
            hand[2] = -leg.notch * round(want / leg.notch)
        return hand[2], 0.0
    hand[2] = 0.0
    if leg.overlap == 0.0 and nominal < -0.02:
        return 0.0, 0.0
    # Curtius and Kniffler's adhesion, speed in km/h.
    most = min(leg.effort, leg.power / max(v, 1.0), leg.adhesive * (0.161 + 7.5 / (3.6 * v + 44.0)))
    # Coasting saves energy before a stop; between two speeds the driver coasts too, or holds the speed.
    coasts, low, high = left < leg.coast, top - leg.band, top - 0.2
    if coasts:
        low, high = min(low, 0.5 * leg.cruise), min(high, 0.75 * leg.cruise)
    hand[1] = 1.0 * ((coasts or leg.band > 0.0) and (v >= high or (hand[1] > 0.0 and v > low)))
    hold = leg.weighed * (1.0 + leg.gamma) * (w + 0.2 * (top - v))
    demand = (most if leg.band > 0.0 else min(most, max(0.0, hold))) * (1.0 - hand[1])
    light = leg.overlap > 1.0 and demand > 0.0 and v > 5.0 and now % 60.0 < 5.0
    return -0.15 if light else 0.0, demand


@njit(cache=True)
def drive_leg(twists: Array, leg: Leg, number: float, track: Track, gusts: Array, state: Array, log: Array) -> int:
    """Drive to a stop and stand there; return the number of rows of the log used, 0 if the stop is not reached.

    Args:
        twists: Sizes of effects: of none, of all together, which act on the train, and of each; shape (m, TWISTS).
        leg: Train and driver.
        number: Number of the run.
        track: Tables of the line.
        gusts: Gust speed of each second [m/s].
        state: Time [s], position [m], heat of the brake [J/kg], distance run [m], time since a release [s]; updated.
        log: A row per step, as in Log.

    """
    ring, hand, brakes = np.full(_RING, HOLD), np.zeros(3), np.zeros((len(twists), 2))
    brakes[:, 1] = HOLD
    rates, tables = np.zeros(len(twists)), track.tables[0 if leg.way > 0.0 else 1]
    begun, start, nominal, cmd = state[0], state[1], HOLD, HOLD
    v, pull, demand, stood = 0.0, 0.0, 0.0, 0.0
    for k in range(len(log)):
        now, x, heat, run, since = state
        i, j = int(x - track.origin), int(now)
        at = tables[i] + (x - track.origin - i) * (tables[i + 1] - tables[i])
        gust = gusts[j] + (now - j) * (gusts[j + 1] - gusts[j])
        if stood > 0.0:
            cmd, demand = HOLD, 0.0
        elif k % _BEAT == 0:
            cmd, demand = _decide(leg, v, leg.way * (leg.target - x), abs(x - start), at[0], now, nominal, hand)
        ring[k % _RING] = cmd
        change = leg.jerk * leg.weighed * STEP
        pull = min(max(min(demand, pull + change), pull - 1.5 * change), leg.power / max(v, 1.0))
        nominal += (ring[(k - round(leg.delay / STEP)) % _RING] - nominal) * (1.0 - math.exp(-STEP / leg.lag))
        state[4] = 0.0 if nominal < -0.02 else since + STEP
        for n in range(len(twists)):
            _press(twists[n], leg, ring, k, v, brakes[n])
            rates[n] = _accelerate(twists[n], leg, at, v, pull, brakes[n], gust, now, now - begun, run, heat, state[4])
        w = leg.a + leg.b * v + leg.c * v * v + at[0]
        assumed = (pull / leg.weighed - G / 1000.0 * w) / (1.0 + leg.gamma) + nominal
        new = max(0.0, v + STEP * rates[1]) if stood == 0.0 else 0.0
        line, moves = log[k], v > 0.0 or new > 0.0
        line[0], line[1], line[2], line[3] = x, leg.way, number if moves else -1.0, v
        line[4] = pull + leg.weighed * (1.0 + leg.gamma) * nominal
        line[5], line[6], line[7] = cmd, leg.weighed, (rates[0] - assumed) * moves
        line[8:] = (rates[2:] - rates[0]) * moves
        moved = 0.5 * STEP * (v + new)
        state[0], state[1], state[3] = now + STEP, x + leg.way * moved, run + moved
        state[2] += STEP * (-brakes[1, 1] * v - heat / 250.0)
        stood += STEP * (stood > 0.0 or (new == 0.0 and v > 0.0 and hand[0] > 0.0))
        v = new
        if stood > _DWELL:
            return k + 1
    return 0
