# SPDX-License-Identifier: Apache-2.0
"""The library of effects beyond Davis resistance and gradient; those of a train file, checked and bound to evaluate.

Every effect is expressed as an *equivalent extra resistance* in the specific balance with the assumed mass,
``T + B = w(v) + i + w_extra + 1000 (1 + gamma) (dv/dt) / g0``, where T is the reported traction and B the braking
force of the assumed brake, both in N/kN. Simulator, live estimators and workflow evaluate the same function.

A new effect is one EffectKind in :mod:`effect_terms`, or one file that defines ``EFFECT`` in a folder listed in
TRAINID_EFFECTS.
"""

from __future__ import annotations

import importlib.util
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Final

from trainid_ros.interface.errors import InputError
from trainid_ros.train.effect_kinds import EffectKind, Parameter, Parameters, Resistance, Twin
from trainid_ros.train.effect_terms import KINDS
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.forces import BRAKE_APPLIED, TrackPoint, heat_after
from trainid_ros.train.train_file import Davis, Effect

__all__ = [
    'BRAKE_APPLIED', 'EFFECTS', 'FOLDERS_VARIABLE', 'Davis', 'EffectKind', 'Parameter', 'Parameters', 'Resistance',
    'Term', 'TrackPoint', 'Twin', 'check_effects', 'effect_value', 'heat_after', 'parse_effects', 'resistance_terms',
]  # fmt: skip

FOLDERS_VARIABLE: Final = 'TRAINID_EFFECTS'
"""Environment variable listing folders of user effects, separated as in PATH; each ``*.py`` defines ``EFFECT``."""


class _Library(Mapping[str, EffectKind]):
    """Load users' modules on first access, so that an invalid user file affects only code that uses effects."""

    def __getitem__(self, name: str) -> EffectKind:
        return _kinds(os.environ.get(FOLDERS_VARIABLE, ''))[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_kinds(os.environ.get(FOLDERS_VARIABLE, '')))

    def __len__(self) -> int:
        return len(_kinds(os.environ.get(FOLDERS_VARIABLE, '')))


EFFECTS: Final[Mapping[str, EffectKind]] = _Library()
"""All effects by name. Any access raises InputError, naming the file, if a user's module is invalid."""


@lru_cache(maxsize=8)
def _kinds(folders: str) -> Mapping[str, EffectKind]:
    found, files = {kind.name: kind for kind in KINDS}, list[Path]()
    for folder in filter(None, folders.split(os.pathsep)):
        if not Path(folder).is_dir():
            raise InputError(f'{FOLDERS_VARIABLE}: {folder} is not a folder')
        files += sorted(path for path in Path(folder).glob('*.py') if not path.name.startswith('_'))
    for path in files:
        kind = _user_kind(path)
        if kind.name in found:
            raise InputError(f'{path}: effect {kind.name} already exists')
        found[kind.name] = kind
    return MappingProxyType(found)


def _user_kind(path: Path) -> EffectKind:
    spec = importlib.util.spec_from_file_location(f'trainid_user_effect_{path.stem}', path)
    if spec is None or spec.loader is None:
        raise InputError(f'{path}: is not a Python module')
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look up their module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f'{path}: cannot be loaded: {type(error).__name__}: {error}') from error
    kind = getattr(module, 'EFFECT', None)
    if not isinstance(kind, EffectKind):
        raise InputError(f'{path}: must define EFFECT = EffectKind(...), see trainid_ros.train.effects')
    return kind


Term = Callable[[Davis, TrackPoint], float]


def check_effects(effects: Sequence[Effect]) -> None:
    """Raise InputError unless every effect is known, has exactly its parameters, each in range, and occurs once.

    Effects with their own position or time may occur several times. The error names the effect, or effect:key.
    """
    for effect in effects:
        kind = EFFECTS.get(effect.name)
        if kind is None:
            raise InputError(f'effect {effect.name} is not known; {did_you_mean(effect.name, EFFECTS)}')
        values = dict(effect.parameters)
        if unknown := [key for key in values if key not in kind.parameters]:
            hint = did_you_mean(unknown[0], kind.parameters)
            raise InputError(f'effect {effect.name}:{unknown[0]} is not a parameter; {hint}')
        for key, limits in kind.parameters.items():
            _check_parameter(f'effect {effect.name}:{key}', values.get(key), limits)
        start, end = values.get('start', -math.inf), values.get('end', math.inf)
        if not start < end:
            raise InputError(f'effect {effect.name}:end = {end:g} m must be greater than start = {start:g} m')
        if effect.runs:
            if kind.on_records or kind.resistance is None:
                raise InputError(f'effect {effect.name}: runs: it acts on all records')
        elif not kind.repeatable and sum(one.name == effect.name and not one.runs for one in effects) > 1:
            raise InputError(f'effect {effect.name}: given more than once')


def resistance_terms(effects: Sequence[Effect]) -> tuple[Term, ...]:
    """Return one function for each effect that adds to the balance [N/kN]; none for those ``on_records``.

    InputError as by :func:`check_effects`; parameters are checked once, here.
    """
    check_effects(effects)
    kinds = ((EFFECTS[effect.name], effect) for effect in effects)
    return tuple(_bind(kind.resistance, effect) for kind, effect in kinds if kind.resistance and not kind.on_records)


def effect_value(effects: Sequence[Effect], name: str, key: str, default: float) -> float:
    """Return a parameter of the only effect of that name on all runs, or the default if there is none."""
    for effect in effects:
        if effect.name == name and not effect.runs:
            return dict(effect.parameters).get(key, default)
    return default


def _bind(function: Resistance, effect: Effect) -> Term:
    """Return the resistance of an effect with its parameters; InputError where it cannot be evaluated."""
    parameters, runs = dict(effect.parameters), frozenset(effect.runs)

    def evaluate(davis: Davis, point: TrackPoint) -> float:
        if runs and point.run not in runs:
            return 0.0
        try:
            value = float(function(parameters, davis, point))
        except Exception as error:  # the effect may be a user's
            problem = f'its resistance cannot be evaluated: {type(error).__name__}: {error}'
            raise InputError(f'effect {effect.name}: {problem}') from error
        if not math.isfinite(value):
            problem = f'its resistance = {value:g} N/kN at {point.speed:g} m/s must be finite'
            raise InputError(f'effect {effect.name}: {problem}')
        return value

    return evaluate


def _check_parameter(name: str, value: float | None, limits: Parameter) -> None:
    if value is None:
        raise InputError(f'{name} is missing')
    unit = f' {limits.unit}' if limits.unit else ''
    if not math.isfinite(value):
        raise InputError(f'{name} = {value:g}{unit} must be finite')
    if not limits.low <= value <= limits.high:
        raise InputError(f'{name} = {value:g}{unit} is outside [{limits.low:g}, {limits.high:g}]')


def parse_effects(texts: Iterable[str]) -> tuple[Effect, ...]:
    """Parse and check effects ``NAME:key=value``; raise InputError for a wrong form or value.

    Consecutive texts with the same name add parameters to one effect; a repeated key starts another one.
    """
    found: list[tuple[str, dict[str, float]]] = []
    for text in texts:
        name, _, rest = text.partition(':')
        for assignment in rest.split(','):
            key, equals, value = assignment.partition('=')
            if not (name and key and equals):
                raise InputError(f'effect {text!r} must have the form NAME:key=value')
            try:
                number = float(value)
            except ValueError:
                raise InputError(f'effect {text!r}: {key} = {value!r} is not a number') from None
            if not (found and found[-1][0] == name and key.strip() not in found[-1][1]):
                found.append((name, {}))
            found[-1][1][key.strip()] = number
    effects = tuple(Effect(name, tuple(values.items()), (), 'command line') for name, values in found)
    check_effects(effects)
    return effects
