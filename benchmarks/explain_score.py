# SPDX-License-Identifier: Apache-2.0
"""Score outcomes of the workflow against the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from benchmarks.explain_trial import CRASHED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from benchmarks.explain_trial import Named, Outcome

VISIBLE: Final = 20.0
"""Least rise of the gap over the noise floor at which an effect counts [%]."""
GENERIC: Final = frozenset({'local_drag', 'resistance_step'})
"""Names that imply no mechanism, so acceptable for effects outside the library."""
_Z95: Final = 1.959964
_WITHOUT_NAME: Final = frozenset({'no_gap', 'unexplained', CRASHED})
_SLIP: Final = 'wheel_slip'


@dataclass(frozen=True, slots=True)
class Rate:
    """A number of hits among a number of cases."""

    hits: int
    cases: int

    @property
    def share(self) -> float:
        """Return hits over cases, NaN without cases."""
        return self.hits / self.cases if self.cases else math.nan

    def interval(self) -> tuple[float, float]:
        """Return Wilson's 95 % interval of the share."""
        n, p = self.cases, self.share
        if not n:
            return 0.0, 1.0
        middle = p + _Z95**2 / (2 * n)
        half = _Z95 * math.sqrt(p * (1.0 - p) / n + _Z95**2 / (4 * n * n))
        scale = 1.0 + _Z95**2 / n
        return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def rate(outcomes: Iterable[Outcome], holds: Callable[[Outcome], bool]) -> Rate:
    """Return the rate of outcomes for which a predicate holds."""
    answers = [holds(outcome) for outcome in outcomes]
    return Rate(sum(answers), len(answers))


def truth_names(outcome: Outcome) -> tuple[str, ...]:
    return tuple(effect.name for effect in outcome.answer.effects)


def visible(outcome: Outcome) -> bool:
    """True if all effects together and each alone raise the gap by at least ``VISIBLE``."""
    return outcome.answer.visible >= VISIBLE and all(one.visible >= VISIBLE for one in outcome.answer.effects)


def slip_excused(outcome: Outcome) -> bool:
    """True if slip is reported that contaminates the data without being a hidden effect: this is correct."""
    spoiled = 'slip' in outcome.answer.contamination and _SLIP not in truth_names(outcome)
    return spoiled and any(effect.name == _SLIP for effect in outcome.found)


def named(outcome: Outcome) -> tuple[Named, ...]:
    """Return the effects named, without correctly reported slip contamination."""
    excused = slip_excused(outcome)
    return tuple(effect for effect in outcome.found if not (excused and effect.name == _SLIP))


def reported(outcome: Outcome) -> tuple[str, ...]:
    """Return all names and twins that were reported, each once."""
    effects = named(outcome)
    names = [*(effect.name for effect in effects), *(twin for effect in effects for twin in effect.twins)]
    return tuple(dict.fromkeys(names))


def alarmed(outcome: Outcome) -> bool:
    """True if the outcome is a false alarm on a case without effect: anything but "no gap"."""
    if named(outcome) or outcome.verdict in {'unexplained', CRASHED}:
        return True
    return outcome.verdict != 'no_gap' and not slip_excused(outcome)


def exact(outcome: Outcome) -> bool:
    """True if exactly the hidden effects were named."""
    names = {effect.name for effect in named(outcome)}
    return outcome.verdict not in _WITHOUT_NAME and names == set(truth_names(outcome))


def within_two(outcome: Outcome) -> bool:
    """True if at most two names were reported and the truth is among them."""
    names = reported(outcome)
    return outcome.verdict not in _WITHOUT_NAME and len(names) <= 2 and set(truth_names(outcome)) <= set(names)


def found_of_truth(outcome: Outcome) -> int:
    """Return how many of the hidden effects were named."""
    return len({effect.name for effect in named(outcome)} & set(truth_names(outcome)))


def both(outcome: Outcome) -> bool:
    return found_of_truth(outcome) == len(outcome.answer.effects)


def generic(outcome: Outcome) -> bool:
    """True if unexplained, or only names that imply no mechanism."""
    return _only_names(outcome, frozenset())


def acceptable(outcome: Outcome) -> bool:
    """True if unexplained, or only names that imply no mechanism or are near to the hidden effect."""
    return _only_names(outcome, frozenset(name for effect in outcome.answer.effects for name in effect.near))


def _only_names(outcome: Outcome, near: frozenset[str]) -> bool:
    if outcome.verdict == 'unexplained':
        return True
    names = {effect.name for effect in named(outcome)}
    return outcome.verdict not in _WITHOUT_NAME and bool(names) and names <= GENERIC | near


def parameter_errors(outcome: Outcome) -> tuple[tuple[str, float], ...]:
    """Return (effect.parameter, error in its own std) of all named effects that are in the data.

    Of a name reported more than once only the strongest counts. A parameter without a usable std has an infinite error.
    """
    truth = {effect.name: dict(effect.parameters) for effect in outcome.answer.effects}
    strongest = {effect.name: effect for effect in reversed(named(outcome))}
    errors: list[tuple[str, float]] = []
    for effect in strongest.values():
        std = dict(effect.std)
        for name, value in effect.parameters:
            if name in truth.get(effect.name, {}):
                spread, error = std.get(name, math.nan), value - truth[effect.name][name]
                usable = math.isfinite(spread) and spread > 0.0
                errors.append((f'{effect.name}.{name}', error / spread if usable else math.inf))
    return tuple(errors)


def within_std(errors: Sequence[float]) -> Rate:
    """Return how many errors are within two of their own std."""
    return Rate(sum(abs(error) <= 2.0 for error in errors), len(errors))


def rms(errors: Sequence[float]) -> float:
    """Return the rms of the finite errors, NaN if there are none."""
    finite = [error for error in errors if math.isfinite(error)]
    return math.sqrt(sum(error * error for error in finite) / len(finite)) if finite else math.nan


def over_floor(outcome: Outcome) -> float:
    """Return the ratio of the gap after to the noise floor, NaN if no run was held out."""
    return math.nan if outcome.gap is None else outcome.gap[1] / outcome.gap[2]


def seconds_for_eight(outcome: Outcome) -> float:
    """Return the CPU time from aligned records to the explanation, scaled to eight runs [s]."""
    return outcome.explain_s * 8.0 / max(outcome.runs, 1)
