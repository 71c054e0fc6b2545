# SPDX-License-Identifier: Apache-2.0
"""The effects by name: random size, quirks to set, and the parameters that should be reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.hidden_cases_b.motion import LEG, T, V
from benchmarks.hidden_cases_b.scene import Scene, Wish

Rng = np.random.Generator
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Draw:
    """Quirks to set, and those parameters in the form of the interface that can be compared exactly."""

    quirks: Mapping[str, float]
    parameters: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Context:
    """Inputs on which sizes may depend: the scene and the log without the effect."""

    scene: Scene
    log: Array


Maker = Callable[[Rng, Context], Draw]


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: Rng) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _plain(quirk: str, parameter: str, size: Callable[[Rng, Context], float]) -> Maker:
    def make(rng: Rng, at: Context) -> Draw:
        value = size(rng, at)
        return Draw({quirk: value}, ((parameter, value),))

    return make


def _ratio(quirk: str, low: float, high: float, down: float = 0.5) -> Maker:
    return _plain(quirk, 'ratio', lambda rng, _: 1.0 + (-1.0 if rng.random() < down else 1.0) * _log(rng, low, high))


def _place(rng: Rng, at: Context, low: float, high: float) -> tuple[float, float]:
    """Return a section of the leg that is driven most often, in both directions if there is one."""
    seen: dict[tuple[float, float], list[float]] = {}
    for leg in at.scene.legs:
        seen.setdefault((min(leg.start, leg.target), max(leg.start, leg.target)), []).append(leg.way)
    best = max(len(set(ways)) * 100 + len(ways) for ways in seen.values())
    ties = [key for key, ways in seen.items() if len(set(ways)) * 100 + len(ways) == best]
    first, last = ties[int(rng.integers(len(ties)))]
    span = last - first
    length = min(_log(rng, low, high), 0.5 * span)
    start = first + float(rng.uniform(0.12, 0.88 - length / span)) * span
    return round(start), round(start + length)


def _gradient_error(rng: Rng, at: Context) -> Draw:
    start, end = _place(rng, at, 200.0, 2000.0)
    size = _sign(rng) * _log(rng, 0.6, 7.0)
    quirks = {'slope_from': start, 'slope_to': end, 'slope_miss': size}
    return Draw(quirks, (('permille', size), ('start', start), ('end', end)))


def _local_drag(rng: Rng, at: Context) -> Draw:
    start, end = _place(rng, at, 200.0, 2000.0)
    size = _log(rng, 0.5, 6.0)
    return Draw({'rub_from': start, 'rub_to': end, 'rub': size}, (('permille', size), ('start', start), ('end', end)))


def _brake_fade(rng: Rng, at: Context) -> Draw:
    loss = _log(rng, 0.02, 0.45)
    stop = 0.5 * float(np.quantile(at.log[:, V], 0.95)) ** 2
    heat = stop * _log(rng, 0.3, 1.5)
    return Draw({'fade_loss': loss, 'fade_heat': heat, 'fade_cool': float(rng.uniform(120.0, 500.0))})


def _dragging_brake(rng: Rng, _: Context) -> Draw:
    size, time = _log(rng, 0.3, 7.0), _log(rng, 6.0, 35.0)
    return Draw({'drag_after': size, 'drag_for': time}, (('permille', size), ('time', time)))


def _strength(at: Context) -> float:
    """Return half of the starting traction [N/kN]."""
    stock = at.scene.stocks[0]
    return 0.5 * stock.pull_max / (stock.weighed * 9.81 / 1000.0)


def _starting(rng: Rng, at: Context) -> Draw:
    value, speed = min(_log(rng, 4.0, 40.0), _strength(at)), _log(rng, 1.5, 9.0)
    return Draw({'stiction': value, 'stiction_v': speed}, (('value', value), ('speed', speed)))


def _warmup(rng: Rng, at: Context) -> Draw:
    value = _log(rng, 0.15, 3.0)
    moving = float(np.mean(at.log[:, V]))
    total = moving * float(at.log[-1, T])
    distance = _log(rng, 0.08, 0.35) * total
    if rng.random() < 0.5:
        return Draw({'cold': value, 'cold_run': distance}, (('value', value), ('distance', distance)))
    return Draw({'cold': value, 'cold_time': distance / moving}, (('value', value),))


def _step(rng: Rng, at: Context) -> Draw:
    size = _sign(rng) * _log(rng, 0.07, 1.5)
    if size < 0.0:
        size = max(size, -0.6 * at.scene.stocks[0].a)
    when = float(at.log[-1, T]) * float(rng.uniform(0.25, 0.75))
    return Draw({'jump': size, 'jump_at': when}, (('a', size), ('time', when)))


def _slip(rng: Rng, _: Context) -> Draw:
    share, speed = _log(rng, 0.01, 0.1), _log(rng, 0.5, 4.0)
    return Draw({'slip_share': share, 'slip_speed': speed})


def _top(at: Context) -> float:
    return float(np.quantile(at.log[:, V], 0.97))


LIBRARY: Final[Mapping[str, Maker]] = {
    'tunnel_drag': _plain('bore_gain', 'factor', lambda rng, _: 1.0 + _log(rng, 0.15, 2.5)),
    'curve_resistance': _plain('flange', 'coefficient', lambda rng, _: _log(rng, 250.0, 2500.0)),
    'gradient_error': _gradient_error,
    'headwind': _plain('wind', 'speed', lambda rng, _: _sign(rng) * _log(rng, 0.5, 10.0)),
    'mass_error': _ratio('heavy', 0.004, 0.12),
    'traction_scale': _ratio('pull', 0.004, 0.1),
    'brake_scale': _ratio('bite', 0.006, 0.25, down=0.7),
    'brake_fade': _brake_fade,
    'brake_delay': _plain('late', 'extra', lambda rng, _: round(_log(rng, 0.15, 1.6) / 0.02) * 0.02),
    'dragging_brake': _dragging_brake,
    'starting_resistance': _starting,
    'bearing_warmup': _warmup,
    'wheel_diameter': _ratio('wheel', 0.004, 0.04),
    'wheel_slip': _slip,
    'resistance_step': _step,
    'local_drag': _local_drag,
    'higher_order_drag': _plain('cubic', 'coefficient', lambda rng, at: _log(rng, 2.0, 18.0) / _top(at) ** 3),
}
"""Effects named in the interface."""


def _wave(rng: Rng, _: Context) -> Draw:
    return Draw(
        {
            'wave': _log(rng, 0.5, 3.0),
            'wave_length': _log(rng, 400.0, 3000.0),
            'wave_phase': float(rng.uniform(0.0, 6.28)),
        }
    )


def _sag(rng: Rng, at: Context) -> Draw:
    begin = _top(at) * float(rng.uniform(0.4, 0.7))
    return Draw({'sag_from': begin, 'sag': _log(rng, 0.08, 0.35) / (_top(at) - begin)})


def _damp(rng: Rng, at: Context) -> Draw:
    return Draw(
        {
            'damp': _log(rng, 0.8, 7.0),
            'damp_mid': _top(at) * float(rng.uniform(0.35, 0.75)),
            'damp_wide': _top(at) * float(rng.uniform(0.04, 0.1)),
        }
    )


def _storm(rng: Rng, at: Context) -> Draw:
    total = float(at.log[-1, T])
    begin = total * float(rng.uniform(0.2, 0.6))
    return Draw({'storm': _log(rng, 0.4, 3.0), 'storm_from': begin, 'storm_to': begin + total * rng.uniform(0.1, 0.3)})


def _feeder(rng: Rng, at: Context) -> Draw:
    stops = at.scene.ground.stops
    moving = at.log[at.log[:, V] > 3.0]
    leg = at.scene.legs[int(rng.choice(np.unique(moving[:, LEG])))]
    low = min(leg.start, leg.target) - 100.0
    width = 0.6 * abs(leg.target - leg.start) if len(stops) == 2 else abs(leg.target - leg.start)
    return Draw({'feeder': _log(rng, 0.02, 0.35), 'feeder_from': low, 'feeder_to': low + width})


def _only(quirk: str, low: float, high: float, *, both: bool = False) -> Maker:
    return lambda rng, _: Draw({quirk: (_sign(rng) if both else 1.0) * _log(rng, low, high)})


OUTSIDE: Final[Mapping[str, Maker]] = {
    'resistance_wave': _wave,
    'day_creep': lambda rng, at: Draw({'creep': _log(rng, 0.5, 4.0) * 3600.0 / float(at.log[-1, T])}),
    'brake_falls_with_speed': lambda rng, at: Draw({'bite_speed': _log(rng, 0.02, 0.35) / _top(at)}),
    'traction_saturation': _sag,
    'rotary_mass_error': _only('rotary', 0.015, 0.06, both=True),
    'acceleration_drag': _only('surge', 1.0, 12.0),
    'oneway_traction_drag': _only('oneway_pull', 0.4, 4.0),
    'resistance_per_run': _only('whim', 0.06, 0.7),
    'speed_band_drag': _damp,
    'cold_departure': lambda rng, _: Draw({'parked': _log(rng, 1.0, 5.0), 'parked_time': _log(rng, 20.0, 90.0)}),
    'lateral_drag': _only('cant', 0.6, 7.0),
    'crowd_drag': _only('crowd', 0.05, 0.4),
    'storm_hour': _storm,
    'weak_feeder': _feeder,
    'uphill_drag': _only('hill', 0.03, 0.3),
}
"""Effects outside the library, with names of this generator."""

NEAR: Final[Mapping[str, tuple[str, ...]]] = {
    'resistance_wave': ('local_drag', 'gradient_error'),
    'day_creep': ('resistance_step', 'bearing_warmup'),
    'brake_falls_with_speed': ('brake_slope', 'brake_scale', 'brake_fade'),
    'traction_saturation': ('traction_scale', 'higher_order_drag'),
    'rotary_mass_error': ('mass_error', 'traction_scale', 'wheel_diameter'),
    'acceleration_drag': ('mass_error', 'traction_scale', 'brake_scale'),
    'oneway_traction_drag': ('traction_scale', 'headwind', 'gradient_error'),
    'resistance_per_run': ('resistance_step',),
    'cold_departure': ('starting_resistance', 'dragging_brake'),
    'lateral_drag': ('curve_resistance',),
    'crowd_drag': ('resistance_step', 'mass_error'),
    'storm_hour': ('resistance_step',),
    'weak_feeder': ('traction_scale', 'local_drag'),
    'uphill_drag': ('gradient_error', 'local_drag'),
}
"""Acceptable generic names for effects outside the library."""

SENSOR_EXTRA: Final[Mapping[str, Maker]] = {
    'map_shift': _plain('map_ahead', 'distance', lambda rng, _: _sign(rng) * _log(rng, 15.0, 150.0)),
    'stamp_skew': _plain('force_late', 'delay', lambda rng, _: _log(rng, 0.12, 1.2)),
}
"""Sensor effects that are required but not named in the interface."""

MENU: Final[Mapping[str, Maker]] = {**LIBRARY, **SENSOR_EXTRA, **OUTSIDE}

_WISHES: Final = {
    'tunnel_drag': Wish(tunnels=True),
    'curve_resistance': Wish(curves=True),
    'lateral_drag': Wish(curves=True),
    'oneway_traction_drag': Wish(both_ways=True),
    'brake_fade': Wish(zones=True),
    'dragging_brake': Wish(zones=True, hold=True),
    'brake_delay': Wish(zones=True),
    'bearing_warmup': Wish(single_bag=True),
    'resistance_step': Wish(single_bag=True),
    'day_creep': Wish(single_bag=True),
    'storm_hour': Wish(single_bag=True),
}


def wish_for(names: tuple[str, ...]) -> Wish:
    wishes = [_WISHES.get(name, Wish()) for name in names]
    return Wish(*(any(getattr(w, key) for w in wishes) for key in Wish.__slots__))
