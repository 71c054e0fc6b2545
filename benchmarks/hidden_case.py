# SPDX-License-Identifier: Apache-2.0
"""A hidden case in the form that both generators give it: input of the workflow, and truth for the scoring.

Only the form is shared: no number of a case comes from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from trainid_ros.interface.records import Record

    Pairs = tuple[tuple[float, float], ...]


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
    train: Mapping[str, object],
    davis: Sequence[str],
    brake: tuple[float, float],
    stops: Iterable[float],
    sections: Mapping[str, Pairs],
    written: Callable[[float], str],
) -> str:
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
