# SPDX-License-Identifier: Apache-2.0
"""``trainid import``: make a bag of a table."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.output import print_json, progress, show, warn
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import load_table_mapping
from trainid_ros.inputs.table_records import TableRecords
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, REQUIRED_TOPICS
from trainid_ros.interface.text import pluralise
from trainid_ros.train.fields import shown
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

# Numbers that are not in the table of a column and are named.
_MAX_NAMED: Final = 5
_TOPIC_OF = {topic.record: topic.name for topic in INPUT_TOPICS}


def run(args: argparse.Namespace) -> int:
    """Read the table and write the bag.

    Raises:
        InputError: A file cannot be used, or the bag exists already; then no bag is left.
    """
    train_file = None if args.train is None else load_train_file(args.train)
    table = TableRecords(args.file, MappedInputs(load_table_mapping(args.map), train_file))
    counts: Counter[str] = Counter({topic.name: 0 for topic in REQUIRED_TOPICS})
    first_ns = last_ns = 0
    with _new_bag(args.out) as writer, progress(f'importing {args.file.name}', 1.0) as advance:
        for share, records in table.blocks():
            for log_ns, record in records:
                writer.write_record(record, log_ns)
                counts[_TOPIC_OF[type(record)]] += 1
            if records:
                first_ns, last_ns = first_ns or records[0][0], records[-1][0]
            advance(share)
        if not writer.message_count:
            raise InputError(f'{args.file}: nothing in {pluralise(table.rows, "row")} has a time and a value')
    _print_result(args, table, counts, (last_ns - first_ns) / NS_PER_S)
    return 0


@contextmanager
def _new_bag(path: Path) -> Iterator[BagWriter]:
    """Write a bag beside its place, and put it there once it is complete."""
    if path.exists() or path.is_symlink():
        raise InputError(f'{path}: exists already and is not overwritten')
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f'.{path.name}.', dir=path.parent) as folder:
        with BagWriter(Path(folder) / path.name) as writer:
            yield writer
        writer.path.rename(path)


def _print_result(args: argparse.Namespace, table: TableRecords, counts: Counter[str], duration_s: float) -> None:
    for line in table.warnings:
        warn(line)
    for (name, number), count in table.unlisted.most_common(_MAX_NAMED):
        warn(
            f'{args.file}: column {shown(name)}: {number:g} is not in table of the mapping ({pluralise(count, "row")})'
        )
    if table.steps_back:
        warn(f'{args.file}: {pluralise(table.steps_back, "row")} earlier than one before')
    if table.repeated:
        warn(f'{args.file}: {pluralise(table.repeated, "row")} with the time of the one before')
    if missing := [topic for topic, count in counts.items() if not count]:
        warn(f'{args.out}: no messages on {", ".join(missing)}: the mapping names no column with values')
    blank = {name: count for name, count in table.blank.items() if count}
    if args.json:
        read = {'rows': table.rows, 'blank': blank, 'duration_s': duration_s}
        print_json({'out': args.out, 'messages': dict(sorted(counts.items())), **read})
        return
    show(f'{args.out}: {counts.total()} messages from {pluralise(table.rows, "row")} over {duration_s:.1f} s')
    show('\n'.join(f'  {topic}: {count}' for topic, count in counts.items()))
    if blank:
        show('rows without a value: ' + ', '.join(f'{name} {count}' for name, count in blank.items()))
