# SPDX-License-Identifier: Apache-2.0
"""What becomes of effects that are believed already when more of them are found."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.model import EffectTerm
    from trainid_ros.train.train_file import Effect, TrainFile


def without_replaced(terms: Sequence[EffectTerm], train_file: TrainFile) -> TrainFile | None:
    """Return what is believed without effects that were found once more, since they are otherwise; None if none was.

    Effects that records show themselves have been taken out of the records already, and stay so.
    """
    again = {term.name for term in terms if not (EFFECTS[term.name].repeatable or EFFECTS[term.name].on_records)}
    rest = tuple(effect for effect in train_file.effects if effect.name not in again)
    return replace(train_file, effects=rest) if len(rest) < len(train_file.effects) else None


def together(believed: Sequence[Effect], added: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return all effects; what records showed beside what was taken out of them is one effect with it.

    Slip is never taken out: what was found of it is all of it.
    """
    before = {effect.name: effect for effect in believed if EFFECTS[effect.name].on_records}
    whole = tuple(
        _sum(before[new.name], new) if new.name in before and EFFECTS[new.name].resistance is not None else new
        for new in added
    )
    names = {effect.name for effect in whole if effect.name in before}
    return (*(effect for effect in believed if effect.name not in names), *whole)


def _sum(before: Effect, new: Effect) -> Effect:
    """Return an effect whose amplitude is that of two: ratios multiply, others add up."""
    kind = EFFECTS[new.name]
    old, parameters = dict(before.parameters)[kind.amplitude], dict(new.parameters)
    more = parameters[kind.amplitude]
    parameters[kind.amplitude] = more * old if kind.neutral else more + old
    return replace(new, parameters=tuple(parameters.items()))
