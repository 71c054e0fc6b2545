# SPDX-License-Identifier: Apache-2.0
"""Merge newly found effects with those that the train file already lists."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.model import EffectTerm
    from trainid_ros.train.train_file import Effect, TrainFile


def without_replaced(terms: Sequence[EffectTerm], train_file: TrainFile) -> TrainFile | None:
    """Return the train file without effects that were found again; None if none was.

    An effect that is found again has wrong values in the train file. Effects on the records themselves are
    kept: the records have already been corrected for them.
    """
    again = {term.name for term in terms if not (EFFECTS[term.name].repeatable or EFFECTS[term.name].on_records)}
    rest = tuple(effect for effect in train_file.effects if effect.name not in again)
    return replace(train_file, effects=rest) if len(rest) < len(train_file.effects) else None


def merged(current: Sequence[Effect], added: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects of the train file and the added ones.

    An added effect on the records is what is left after the correction by the train file, so the two are combined into
    one effect. Records are never corrected for slip, so slip that was found replaces that of the train file.
    """
    before = {effect.name: effect for effect in current if EFFECTS[effect.name].on_records}
    total = tuple(
        _sum(before[new.name], new) if new.name in before and EFFECTS[new.name].resistance is not None else new
        for new in added
    )
    names = {effect.name for effect in total if effect.name in before}
    return (*(effect for effect in current if effect.name not in names), *total)


def _sum(before: Effect, new: Effect) -> Effect:
    """Return the combination of two effects of one kind: ratios are multiplied, other amplitudes are added."""
    kind = EFFECTS[new.name]
    old, parameters = dict(before.parameters)[kind.amplitude], dict(new.parameters)
    more = parameters[kind.amplitude]
    parameters[kind.amplitude] = more * old if kind.neutral else more + old
    return replace(new, parameters=tuple(parameters.items()))
