# SPDX-License-Identifier: Apache-2.0
"""Effects beyond Davis and gradient: one small function for each effect that is a resistance.

Effects that scale a quantity (mass, traction, brake, wheel) have no function here: the simulator reads
their value with :func:`effect_value` where it computes that quantity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from trainid_ros.core.errors import InputError
from trainid_ros.physics.fields import did_you_mean
from trainid_ros.physics.train_file import Davis, Effect

Parameters = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """Where and how the train runs at one moment.

    Attributes:
        time_s: Time since the start [s].
        position: Position of the train's front [m].
        direction: +1 while positions rise, -1 while they fall.
        speed: Speed [m/s, >= 0].
        curve_radius: Radius that gives the mean curvature under the train [m], 0 = straight.
        tunnel: True in a tunnel.
        length: Length of the train [m]; 0 places all of it at its front.
        distance_run: Distance run since the start [m].
        since_release: Time since the brake was released [s]; infinite while it has not been used.

    """

    time_s: float
    position: float
    direction: int
    speed: float
    curve_radius: float = 0.0
    tunnel: bool = False
    length: float = 0.0
    distance_run: float = 0.0
    since_release: float = math.inf


Resistance = Callable[[Parameters, Davis, TrackPoint], float]
Term = Callable[[Davis, TrackPoint], float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """Unit and closed range of one parameter of an effect."""

    unit: str
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, slots=True)
class EffectKind:
    """What is known of an effect: its parameters and, if it is a resistance, its function."""

    parameters: Mapping[str, Parameter]
    resistance: Resistance | None = None


def curve_resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``coefficient / R``; the coefficient in N/kN m (600 in the usual formula), R in m."""
    return p['coefficient'] / at.curve_radius if at.curve_radius > 0.0 else 0.0


def tunnel_drag(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    """Return ``(factor - 1) c v^2`` in tunnels: air drag grows from c to factor c."""
    return (p['factor'] - 1.0) * davis.c * at.speed * at.speed if at.tunnel else 0.0


def headwind(p: Parameters, davis: Davis, at: TrackPoint) -> float:
    """Return ``c ((v + u) |v + u| - v^2)`` with the wind u [m/s] along the line.

    ``speed`` > 0 blows against a train that runs up the line and drives the same train on its way back.
    """
    air = at.speed + at.direction * p['speed']
    return davis.c * (air * abs(air) - at.speed * at.speed)


def local_drag(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``permille`` times the share of the train between start and end; the same sign both ways."""
    return p['permille'] * _share(p, at)


def gradient_error(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return what the true gradient exceeds the map by; ``permille`` counts in rising position."""
    return at.direction * p['permille'] * _share(p, at)


def resistance_step(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``a`` [N/kN] from ``time`` [s since the start] on."""
    return p['a'] if at.time_s >= p['time'] else 0.0


def starting_resistance(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``value exp(-v / speed)``: bearings and flanges resist more at low speed [N/kN]."""
    return p['value'] * math.exp(-at.speed / p['speed'])


def higher_order_drag(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``coefficient v^3``; the coefficient in N/kN/(m/s)^3."""
    return p['coefficient'] * at.speed**3


def bearing_warmup(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``value exp(-s / distance)``: cold bearings run warm with the distance s [N/kN, m]."""
    return p['value'] * math.exp(-at.distance_run / p['distance'])


def dragging_brake(p: Parameters, _: Davis, at: TrackPoint) -> float:
    """Return ``permille`` for ``time`` seconds after a release: shoes that do not come off at once."""
    return p['permille'] if at.speed > 0.0 and at.since_release <= p['time'] else 0.0


_SMALLEST: Final = 1e-6
_RATIO: Final = {'ratio': Parameter('', 0.2, 5.0)}
_SECTION: Final = {'start': Parameter('m'), 'end': Parameter('m'), 'permille': Parameter('per mille')}

EFFECTS: Final[Mapping[str, EffectKind]] = MappingProxyType(
    {
        'curve_resistance': EffectKind({'coefficient': Parameter('N/kN m', 0.0)}, curve_resistance),
        'tunnel_drag': EffectKind({'factor': Parameter('', 0.0)}, tunnel_drag),
        'headwind': EffectKind({'speed': Parameter('m/s')}, headwind),
        'local_drag': EffectKind(_SECTION, local_drag),
        'gradient_error': EffectKind(_SECTION, gradient_error),
        'resistance_step': EffectKind({'time': Parameter('s', 0.0), 'a': Parameter('N/kN')}, resistance_step),
        'starting_resistance': EffectKind(
            {'value': Parameter('N/kN'), 'speed': Parameter('m/s', _SMALLEST)}, starting_resistance
        ),
        'higher_order_drag': EffectKind({'coefficient': Parameter('N/kN/(m/s)^3')}, higher_order_drag),
        'bearing_warmup': EffectKind(
            {'value': Parameter('N/kN'), 'distance': Parameter('m', _SMALLEST)}, bearing_warmup
        ),
        'dragging_brake': EffectKind(
            {'permille': Parameter('per mille', 0.0), 'time': Parameter('s', 0.0)}, dragging_brake
        ),
        'mass_error': EffectKind(_RATIO),
        'traction_scale': EffectKind(_RATIO),
        'brake_scale': EffectKind(_RATIO),
        'brake_fade': EffectKind({'loss': Parameter('', 0.0, 0.9), 'energy': Parameter('J/kg', _SMALLEST)}),
        'brake_delay': EffectKind({'extra': Parameter('s', 0.0, 10.0)}),
        'wheel_diameter': EffectKind(_RATIO),
        'wheel_slip': EffectKind({'share': Parameter('', 0.0, 0.5), 'speed': Parameter('m/s', 0.0, 10.0)}),
    }
)
"""The effects the simulator knows, by name.

``mass_error``: true over believed mass. ``traction_scale``: true over reported traction. ``brake_scale``:
factor on the brake rate. ``brake_fade``: the rate falls by ``loss`` once the brake holds the heat ``energy``.
``brake_delay``: further dead time. ``wheel_diameter``: measured over true speed. ``wheel_slip``: ``share`` of
the time with bursts that measure up to ``speed`` wrong.
"""


def check_effects(effects: Sequence[Effect]) -> None:
    """Check that every effect is known and has exactly its parameters, each in its range.

    Raises:
        InputError: It names the effect, or effect:key and the value.

    """
    for effect in effects:
        kind = EFFECTS.get(effect.name)
        if kind is None:
            msg = f'effect {effect.name} is not known; {did_you_mean(effect.name, EFFECTS)}'
            raise InputError(msg)
        values = dict(effect.parameters)
        for key in values:
            if key not in kind.parameters:
                hint = did_you_mean(key, kind.parameters)
                msg = f'effect {effect.name}:{key} is no parameter; {hint}'
                raise InputError(msg)
        for key, limits in kind.parameters.items():
            _check_parameter(f'effect {effect.name}:{key}', values.get(key), limits)
        if 'start' in values and not values['start'] < values['end']:
            start, end = values['start'], values['end']
            msg = f'effect {effect.name}:end = {end:g} m must lie after start = {start:g} m'
            raise InputError(msg)


def resistance_terms(effects: Sequence[Effect]) -> tuple[Term, ...]:
    """Return one function for each effect that is a resistance, checked once and fast to call.

    Raises:
        InputError: As :func:`check_effects`.

    """
    check_effects(effects)
    kinds = ((EFFECTS[effect.name].resistance, effect) for effect in effects)
    return tuple(_bind(function, dict(effect.parameters)) for function, effect in kinds if function is not None)


def extra_resistance(effects: Sequence[Effect], davis: Davis, point: TrackPoint) -> float:
    """Return the sum of all effects that are a resistance [N/kN].

    Raises:
        InputError: As :func:`check_effects`.

    """
    return sum(term(davis, point) for term in resistance_terms(effects))


def effect_value(effects: Sequence[Effect], name: str, key: str, default: float) -> float:
    """Return a parameter of the last effect of that name, or the default."""
    for effect in reversed(effects):
        if effect.name == name:
            return dict(effect.parameters).get(key, default)
    return default


def _bind(function: Resistance, parameters: Parameters) -> Term:
    return lambda davis, point: function(parameters, davis, point)


def _check_parameter(name: str, value: float | None, limits: Parameter) -> None:
    if value is None:
        msg = f'{name} is missing'
        raise InputError(msg)
    if not (math.isfinite(value) and limits.low <= value <= limits.high):
        unit = f' {limits.unit}' if limits.unit else ''
        msg = f'{name} = {value:g}{unit} is outside [{limits.low:g}, {limits.high:g}]'
        raise InputError(msg)


def _share(p: Parameters, at: TrackPoint) -> float:
    if at.length <= 0.0:
        return 1.0 if p['start'] <= at.position < p['end'] else 0.0
    rear = at.position - at.direction * at.length
    low, high = min(rear, at.position), max(rear, at.position)
    return max(0.0, min(high, p['end']) - max(low, p['start'])) / at.length
