# SPDX-License-Identifier: Apache-2.0
"""Name the cause of a change from the bags of a train: the discrepancy workflow before and after it.

What is wrong with the train file for this train at all times is explained first, from bags before the change. Against
the train file with these effects, the bags after the change show what is new.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.errors import TrainIdError
from trainid_ros.mapping.mapped_inputs import mapped_inputs
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from trainid_ros.explain.result import Explanation, FoundEffect
    from trainid_ros.fleet.analysis import FleetView, TrainView
    from trainid_ros.fleet.columns import Row
    from trainid_ros.train.train_file import TrainFile

_MOST_BAGS: Final = 4


@dataclass(frozen=True, slots=True)
class Named:
    """What ``explain`` found after a change: verdict, effects, or why it found nothing."""

    verdict: str
    effects: tuple[FoundEffect, ...] = ()
    problem: str = ''


def name_cause(view: FleetView, train: TrainView, rows: Sequence[Row], setup: Mapping[str, Any]) -> Named:
    """Return what has changed by the bags of a train.

    Args:
        view: The fleet.
        train: A train with a change.
        rows: Rows of the tables.
        setup: How the bags were replayed, from the plan.

    """
    day = view.labels.days[train.changes[-1].day]
    own = [row for row in rows if row['train'] == train.name and row['day'] and row['status']]
    own.sort(key=lambda row: (row['day'], row['start'] or 0.0))
    before = [Path(row['bag']) for row in own if row['day'] < day][-_MOST_BAGS:]
    after = [Path(row['bag']) for row in own if row['day'] >= day][:_MOST_BAGS]
    try:
        train_file = load_train_file(Path(setup['train']))
        known = _explain(before, train_file, setup).train_file if before else train_file
        found = _explain(after, replace(known, train=train_file.train), setup)
    except KeyError:
        return Named('', problem='the plan of the table is missing')
    except TrainIdError as error:
        return Named('', problem=str(error))
    return Named(found.verdict.value, found.effects)


def _explain(bags: Sequence[Path], train_file: TrainFile, setup: Mapping[str, Any]) -> Explanation:
    """Explain bags.

    Raises:
        InputError: A bag cannot be used.
        NoAnswerError: They hold too little motion.

    """
    from trainid_ros.explain.workflow import explain  # noqa: PLC0415 - takes long to load

    mapping = None if setup['mapping'] is None else Path(setup['mapping'])
    inputs = mapped_inputs(mapping, train_file)
    runs = read_runs(bags, train_file, setup['namespace'], setup['max_chunk'], inputs)
    return explain(runs, train_file, provenance='trainid fleet report')
