# SPDX-License-Identifier: Apache-2.0
"""Hidden cases of both generators in one form: input of the workflow, and truth for the scoring."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle, islice
from typing import TYPE_CHECKING, Final, Literal

from benchmarks import hidden_cases, hidden_cases_b

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.interface.records import Record

Generator = Literal['A', 'B']
GENERATORS: Final[tuple[Generator, ...]] = ('A', 'B')
_CONTAMINATION_B: Final = {'outliers': 'outliers', 'dropouts': 'dropouts', 'slip_contamination': 'slip'}


@dataclass(frozen=True, slots=True)
class Spec:
    """Identification of a case; generator, name and seed reproduce it."""

    generator: Generator
    name: str
    seed: int


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    """One effect in the data.

    Attributes:
        name: Its name.
        parameters: (name, value) of those that an estimate may be compared with.
        near: For effects outside the library, acceptable generic names.
        visible: How much it raises the gap over the noise floor [%].

    """

    name: str
    parameters: tuple[tuple[str, float], ...]
    near: tuple[str, ...]
    visible: float


@dataclass(frozen=True, slots=True)
class Answer:
    """The truth of a case.

    Attributes:
        kind: none, single, pair or outside.
        effects: What is hidden.
        visible: How much all effects raise the gap over the noise floor [%].
        floor: RMS speed gap of the true model due to noise, by the generator [m/s].
        one_way: All runs go up the line.
        contamination: Any of outliers, dropouts, slip.
        flags: Names of further circumstances.

    """

    kind: str
    effects: tuple[HiddenEffect, ...]
    visible: float
    floor: float
    one_way: bool
    contamination: tuple[str, ...]
    flags: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Opened:
    """A generated case; the workflow gets only the train file and the bags."""

    train_yaml: str
    bags: tuple[tuple[Record, ...], ...]
    answer: Answer


def draw_specs(generator: Generator, seed: int, count: int, names: Sequence[str] = ()) -> tuple[Spec, ...]:
    """Return a mix of cases drawn by the generator, or the given names in turn."""
    if names:
        turns = islice(cycle(names), count)
        return tuple(Spec(generator, name, seed * 100_003 + k // len(names)) for k, name in enumerate(turns))
    draw = hidden_cases.draw_cases if generator == 'A' else hidden_cases_b.draw_cases
    return tuple(Spec(generator, name, of_case) for name, of_case in draw(seed, count))


def open_case(spec: Spec) -> Opened:
    """Generate a case."""
    return _case_a(spec) if spec.generator == 'A' else _case_b(spec)


def _case_a(spec: Spec) -> Opened:
    case = hidden_cases.make_case(spec.name, spec.seed)
    truth = case.truth
    effects = tuple(
        HiddenEffect(effect.name, effect.parameters if effect.comparable else (), effect.near, effect.visible_percent)
        for effect in truth.effects
    )
    flags = () if truth.mass_topic else ('no_mass_topic',)
    answer = Answer(truth.kind, effects, truth.visible_percent, truth.floor, truth.one_way, truth.contamination, flags)
    return Opened(case.train_yaml, case.bags, answer)


def _case_b(spec: Spec) -> Opened:
    case = hidden_cases_b.make_case(spec.name, spec.seed)
    truth = case.truth
    effects = tuple(
        HiddenEffect(
            name,
            tuple((key, truth.parameters[name][key]) for key in truth.exact[name]),
            hidden_cases_b.NEAR.get(name, ()),
            truth.visible_each[name],
        )
        for name in truth.effects
    )
    contamination = tuple(name for flag, name in _CONTAMINATION_B.items() if flag in truth.flags)
    flags = (truth.service, *(flag for flag in truth.flags if flag != 'one_way' and flag not in _CONTAMINATION_B))
    answer = Answer(truth.kind, effects, truth.visible, truth.gap.floor, 'one_way' in truth.flags, contamination, flags)
    return Opened(case.train_yaml, case.bags, answer)
