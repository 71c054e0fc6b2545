# SPDX-License-Identifier: Apache-2.0
"""Name the cause of a change from the bags of a train: the discrepancy workflow before and after it.

A bag of the usual days shows what is wrong with the train file for this train at all times; what the bags of its main
departure show besides is new. Each bag is explained alone, since wind and load differ from day to day.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.result import Explanation, FoundEffect
    from trainid_ros.fleet.analysis import FleetView, TrainView
    from trainid_ros.fleet.plan import Setup
    from trainid_ros.fleet.table_file import Row

_MAX_BAGS: Final = 3  # Of a departure that are explained: effects that hold are in the first ones already
_MAX_SIGMAS: Final = 3.0  # Difference of two equal effects, in standard deviations


class Run(NamedTuple):
    """A row as read from a table, and how that was made, None if its plan is missing."""

    row: Row
    setup: Setup | None


class Named(NamedTuple):
    """An effect that is new: as found where its evidence is greatest, and in how many of the bags it was found."""

    effect: FoundEffect
    bags: int


@dataclass(frozen=True, slots=True)
class Cause:
    """What ``explain`` found: number of bags after the change, new effects, the most evident first, or why not."""

    bags: int
    effects: tuple[Named, ...] = ()
    problem: str = ''


def name_cause(view: FleetView, train: TrainView, runs: Sequence[Run]) -> Cause:
    """Return what has changed by the bags of a train.

    Args:
        view: The fleet.
        train: A train with a departure.
        runs: Rows of the tables; each bag is explained with the train file and mapping that it was replayed with.
    """
    usual, away = _bags(view, train, runs)
    try:
        known = [effect for run in usual for effect in _explain(run).effects]
        found = [effect for run in away for effect in _explain(run).effects]
    except TrainIdError as error:
        return Cause(0, problem=str(error))
    return Cause(len(away), _merged([new for new in found if not any(_are_equal(new, old) for old in known)]))


def _bags(view: FleetView, train: TrainView, runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """Return the bag of the usual days that is next to the main departure of a train, and the first ones of that."""
    days, departure = view.labels.days, train.main
    if departure is None:
        return [], []
    own = [run for run in runs if run.row['train'] == train.name and run.row['day'] and run.row['status']]
    own.sort(key=lambda run: (run.row['day'], run.row['start'] or 0.0))
    first, end = days[departure.first], None if departure.end is None else days[departure.end]
    before = [run for run in own if run.row['day'] < first]
    away = [run for run in own if run.row['day'] >= first and (end is None or run.row['day'] < end)]
    after = [run for run in own if end is not None and run.row['day'] >= end]
    return before[-1:] or after[:1], away[:_MAX_BAGS]


def _are_equal(one: FoundEffect, other: FoundEffect) -> bool:
    """Return whether two effects have one name and, within their standard deviations, the same parameters."""
    if one.name != other.name:
        return False
    values, stds = dict(other.parameters), (dict(one.std), dict(other.std))
    return all(
        abs(value - values[name]) <= _MAX_SIGMAS * math.hypot(*(std.get(name, 0.0) for std in stds))
        for name, value in one.parameters
    )


def _merged(found: Sequence[FoundEffect]) -> tuple[Named, ...]:
    """Return each effect once, by the sum of its evidence."""
    by_name: dict[str, list[FoundEffect]] = defaultdict(list)
    for effect in found:
        by_name[effect.name].append(effect)
    ranked = sorted(by_name.values(), key=lambda effects: -sum(effect.evidence for effect in effects))
    return tuple(Named(max(effects, key=lambda effect: effect.evidence), len(effects)) for effects in ranked)


def _explain(run: Run) -> Explanation:
    """Explain a bag.

    Raises:
        InputError: It cannot be used, or it is not known how.
        NoAnswerError: It holds too little motion.
    """
    from trainid_ros.explain.workflow import explain  # noqa: PLC0415 - takes long to load

    row, setup = run
    if setup is None:
        raise InputError('the plan of the table is missing')
    train_file = load_train_file(setup.train)
    inputs = mapped_inputs(setup.mapping, train_file)
    found = read_runs([Path(row['bag'])], train_file, setup.namespace, setup.max_chunk, inputs)
    return explain(found, train_file, provenance='trainid fleet report')
