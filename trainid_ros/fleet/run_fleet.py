# SPDX-License-Identifier: Apache-2.0
"""Replay the bags of a plan that have no row yet, here or on a cluster, and write the table."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from trainid_ros.bag.worker_pool import each_bag
from trainid_ros.fleet.bag_row import bag_row, killed_row, labels_in_row
from trainid_ros.fleet.journal import Journal, read_journal
from trainid_ros.fleet.table_file import write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence
    from pathlib import Path

    from trainid_ros.fleet.columns import Row
    from trainid_ros.fleet.plan import Plan, PlannedBag, Setup

    Found = Generator[tuple[int, Row], None, None]
    Rows = Callable[[Plan, Sequence[PlannedBag], Callable[[float], None]], Found]
    """Yields number and row of each bag as they come; calls the function with the number of bags done since."""


class Run(NamedTuple):
    """A row as read from a table, and how that was made, None if its plan is missing."""

    row: Row
    setup: Setup | None


@dataclass(frozen=True, slots=True)
class Files:
    """The files of a table: itself, its plan, and the rows as they come."""

    table: Path

    @property
    def plan(self) -> Path:
        """The plan."""
        return self.table.with_name(f'{self.table.name}.plan.json')

    @property
    def rows(self) -> Path:
        """The rows as they come."""
        return self.table.with_name(f'{self.table.name}.rows.jsonl')


def rows_here(jobs: int) -> Rows:
    """Return what replays bags in processes of this machine."""

    def rows(
        plan: Plan, bags: Sequence[PlannedBag], advance: Callable[[float], None]
    ) -> Generator[tuple[int, Row], None, None]:
        work, killed = partial(bag_row, plan.setup, plan.revision), partial(killed_row, plan.revision)
        return each_bag(work, bags, jobs, advance, killed)

    return rows


def known_rows(plan: Plan, files: Files) -> dict[str, Row]:
    """Return the rows of earlier runs by key: of bags that are still the same, replayed in the same way.

    They get the labels of the plan, which may be others than before. A bag that could not be replayed is tried again.

    Raises:
        InputError: The file of the rows cannot be read.

    """
    bags = {plan.key(bag): bag for bag in plan.bags}
    rows = read_journal(files.rows).items()
    return {key: row | labels_in_row(bags[key], row['start']) for key, row in rows if key in bags and row.get('status')}


def run_plan(
    plan: Plan, files: Files, known: dict[str, Row], rows: Rows, advance: Callable[[float], None]
) -> list[Row]:
    """Write the table of a plan and return its rows, in the order of the plan.

    Whatever ends the work, such as Ctrl-C, the table holds the rows that are there.

    Args:
        plan: The plan.
        files: Where the table and its companions are.
        known: Rows of earlier runs by key.
        rows: What replays bags.
        advance: Called with the number of bags done since its last call.

    Raises:
        InputError: A file cannot be written.

    """
    keys = [plan.key(bag) for bag in plan.bags]
    left = [(key, bag) for key, bag in zip(keys, plan.bags, strict=True) if key not in known]
    done = dict(known)
    try:
        with Journal(files.rows) as journal, closing(rows(plan, [bag for _, bag in left], advance)) as found:
            for number, row in found:
                key, _ = left[number]
                done[key] = row  # first: what is in the file of the rows is in the table, wherever a signal ends this
                journal.add(key, row)
    finally:
        table = [done[key] for key in keys if key in done]
        write_table(table, files.table, plan.to_json() | {'bags': len(plan.bags)})
    return table
