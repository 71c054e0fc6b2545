# SPDX-License-Identifier: Apache-2.0
"""Check the effects of a train file and bind their parameters for evaluation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from trainid_ros.errors import InputError
from trainid_ros.train.effects.kind import Parameter, Parameters, Resistance
from trainid_ros.train.effects.point import TrackPoint
from trainid_ros.train.effects.registry import EFFECTS
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.train_file import Davis, Effect

Term = Callable[[Davis, TrackPoint], float]


def check_effects(effects: Sequence[Effect]) -> None:
    """Check that every effect is known, has exactly its parameters, each in range, and occurs once.

    Effects with their own position or time may occur several times.

    Raises:
        InputError: A check fails; the message names the effect, or effect:key and the value.

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
                msg = f'effect {effect.name}:{key} is not a parameter; {hint}'
                raise InputError(msg)
        for key, limits in kind.parameters.items():
            _check_parameter(f'effect {effect.name}:{key}', values.get(key), limits)
        if 'start' in values and 'end' in values and not values['start'] < values['end']:
            start, end = values['start'], values['end']
            msg = f'effect {effect.name}:end = {end:g} m must be greater than start = {start:g} m'
            raise InputError(msg)
        if not kind.repeatable and sum(other.name == effect.name for other in effects) > 1:
            msg = f'effect {effect.name}: given more than once'
            raise InputError(msg)


def resistance_terms(effects: Sequence[Effect]) -> tuple[Term, ...]:
    """Return one function for each effect that adds to the balance [N/kN]; parameters are checked once, here.

    Effects that act on the records (``on_records``) are left out.

    Raises:
        InputError: As :func:`check_effects`.

    """
    check_effects(effects)
    terms = []
    for effect in effects:
        kind = EFFECTS[effect.name]
        if kind.resistance is not None and not kind.on_records:
            terms.append(_bind(kind.resistance, dict(effect.parameters)))
    return tuple(terms)


def extra_resistance(effects: Sequence[Effect], davis: Davis, point: TrackPoint) -> float:
    """Return the sum of all effects that add to the balance [N/kN].

    Raises:
        InputError: As :func:`check_effects`.

    """
    return sum(term(davis, point) for term in resistance_terms(effects))


def effect_value(effects: Sequence[Effect], name: str, key: str, default: float) -> float:
    """Return a parameter of the only effect of that name, or the default if there is none."""
    for effect in effects:
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
