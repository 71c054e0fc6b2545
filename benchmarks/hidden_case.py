# SPDX-License-Identifier: Apache-2.0
"""A hidden case in the form that all generators give it: input of the workflow, and truth for the scoring."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence

    from numpy.random import Generator

    from trainid_ros.interface.records import Record

Pairs = tuple[tuple[float, float], ...]
"""Position and value, or start and end, of the sections of a map."""


def log_uniform(rng: Generator, low: float, high: float) -> float:
    return math.exp(float(rng.uniform(math.log(low), math.log(high))))


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    """One effect that is in the data but not in the assumed train file."""

    name: str  # Name in the interface, or a name of the generator for an effect outside the library
    parameters: tuple[tuple[str, float], ...]  # (name, value) of those that an estimate may be compared with
    near: tuple[str, ...]  # For effects outside the library, acceptable generic names
    visible: float  # How much it alone raises the gap over the noise floor [%]


@dataclass(frozen=True, slots=True)
class Answer:
    """Truth of a case; gaps are rms speed gaps after the refit of a, b, c and the initial speed of each run."""

    kind: str  # none, single, pair or outside
    effects: tuple[HiddenEffect, ...]  # What is hidden
    visible: float  # How much all effects raise the gap over the noise floor [%]
    floor: float  # RMS speed gap of the true model due to noise, by the generator [m/s]
    one_way: bool  # All runs go up the line
    contamination: tuple[str, ...]  # Any of outliers, dropouts, slip
    flags: tuple[str, ...]  # Names of further circumstances


@dataclass(frozen=True, slots=True)
class Case:
    """A generated case; the workflow gets only the train file and the bags."""

    train_yaml: str
    bags: tuple[tuple[Record, ...], ...]
    answer: Answer


def assumed_yaml(
    train: Mapping[str, object], davis: Sequence[str], brake: tuple[float, float], stops: Iterable[float],
    sections: Mapping[str, Pairs], written: Callable[[float], str],
) -> str:  # fmt: skip
    """Return an assumed train file: train, Davis coefficients, time constant and dead time of the brake, and map."""

    def listed(values: Iterable[float]) -> str:
        return f'[{", ".join(map(written, values))}]'

    a, b, c = davis
    return '\n'.join(
        [
            f'train: {{{", ".join(f"{name}: {value}" for name, value in train.items())}}}',
            f'resistance: {{a: {a}, b: {b}, c: {c}}}',
            f'brake: {{rate: 1.0, time_constant: {brake[0]}, delay: {brake[1]:.2f}}}',
            'line:',
            f'  stops: {listed(stops)}',
            *(f'  {name}: [{", ".join(map(listed, pairs))}]' for name, pairs in sections.items()),
            'effects: []',
            '',
        ]
    )


_TWINS = (
    {'mass_error', 'traction_scale', 'wheel_diameter', 'stamp_skew'},
    {'brake_scale', 'brake_fade', 'brake_delay'},
    {'gradient_error', 'local_drag', 'map_shift'},
    {'bearing_warmup', 'resistance_step'},
    {'map_shift', 'stamp_skew'},
    {'headwind', 'tunnel_drag', 'higher_order_drag'},
)
_SHARES = (('none', 0.15), ('single', 0.60), ('pair', 0.10), ('outside', 0.15))


def kind_of(names: Sequence[str], outside: Container[str]) -> str:
    """Return the kind of a case by its effects."""
    if any(name in outside for name in names):
        return 'outside'
    return ('none', 'single')[len(names)] if len(names) < 2 else 'pair'


def draw_mix(seed: int, count: int, library: Iterable[str], outside: Iterable[str]) -> list[tuple[str, int]]:
    """Return names and seeds of a mix: 15 % none, 60 % single, 10 % pairs, 15 % outside, all names in turn."""
    rng, names = np.random.default_rng([seed, 6]), {'single': list(library), 'outside': list(outside)}
    kinds = [kind for kind, share in _SHARES for _ in range(round(share * count))]
    kinds = (kinds + ['single'] * count)[:count]
    turns = {kind: cycle(rng.permutation(some).tolist()) for kind, some in names.items()}
    drawn: list[tuple[str, int]] = []
    for k, kind in enumerate(kinds):
        of_case = seed * 100_003 + k
        if kind == 'pair':
            drawn.append((_pair(names['single'], np.random.default_rng([of_case, 5])), of_case))
        else:
            drawn.append((kind if kind == 'none' else next(turns[kind]), of_case))
    return [drawn[k] for k in rng.permutation(len(drawn)).tolist()]


def _pair(library: list[str], rng: Generator) -> str:
    while True:
        first, second = rng.choice(library, 2, replace=False).tolist()
        if not any({first, second} <= twins for twins in _TWINS):
            return f'{first}+{second}'
