# SPDX-License-Identifier: Apache-2.0
"""Columns of a chunk hold what the messages hold, whatever frame, byte order and padding they have."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.record_table import EMPTY, joined, layout
from trainid_ros.bag.types import full_type, message_from_record, typestore
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)

if TYPE_CHECKING:
    from pathlib import Path

START = 1_700_000_000 * NS_PER_S


def random_records(rng: np.random.Generator, count: int) -> list[Record]:
    made: list[Record] = []
    for _ in range(count):
        stamp = START + int(rng.integers(0, 10 * NS_PER_S))
        x, y = (float(value) for value in rng.normal(0.0, 1e3, 2))
        flag = bool(rng.integers(2))
        choices: tuple[Record, ...] = (
            SpeedRecord(stamp, x, y),
            ForceRecord(stamp, x),
            GradientRecord(stamp, x, y, flag),
            BrakeRecord(stamp, x, flag),
            MassRecord(stamp, x),
        )
        made.append(choices[int(rng.integers(5))])
    return made


def write(path: Path, records: list[Record], rng: np.random.Generator, *, little_endian: bool = True) -> list[Record]:
    """Write records with frames of any length and padding, at log times of their own; return them in log order."""
    kinds = {topic.record: topic for topic in INPUT_TOPICS}
    logged = [(START + int(rng.integers(0, 50)), i, record) for i, record in enumerate(records)]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            kind: writer.add_connection(f'/{topic.name}', full_type(topic.message), typestore=typestore())
            for kind, topic in kinds.items()
        }
        for log_ns, _, record in logged:
            message = message_from_record(record)
            message.header.frame_id = 'f' * int(rng.integers(0, 12))
            name = full_type(kinds[type(record)].message)
            payload = bytes(typestore().serialize_cdr(message, name, little_endian=little_endian))
            writer.write(connections[type(record)], log_ns, payload + bytes(int(rng.integers(0, 4))))
    return [record for _, _, record in sorted(logged, key=lambda item: item[:2])]


@pytest.mark.parametrize('little_endian', [True, False])
def test_every_field_of_every_message_is_read(tmp_path: Path, *, little_endian: bool) -> None:
    rng = np.random.default_rng(91)
    expected = write(tmp_path / 'bag', random_records(rng, 300), rng, little_endian=little_endian)
    with BagReader(tmp_path / 'bag') as reader:
        assert list(reader.records()) == expected
        assert sum(map(len, reader.tables())) == len(expected)


def test_numbers_that_are_not_finite_pass_as_they_are(tmp_path: Path) -> None:
    records: list[Record] = [SpeedRecord(START, math.inf, math.nan), ForceRecord(START + 1, math.nan)]
    write(tmp_path / 'bag', records, np.random.default_rng(92))
    with BagReader(tmp_path / 'bag') as reader:
        assert sorted(map(repr, reader.records())) == sorted(map(repr, records))


@pytest.mark.parametrize('cut', [1, 3, 8, 12])
def test_a_message_that_is_too_short_is_skipped_and_counted(tmp_path: Path, cut: int) -> None:
    name = full_type('TrackGradient')
    payload = bytes(typestore().serialize_cdr(message_from_record(GradientRecord(START, 1.0, 2.0, False)), name))
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/ato/gradient', name, typestore=typestore())
        writer.write(connection, START, payload[:-cut])
        writer.write(connection, START, payload)
    with BagReader(tmp_path / 'bag') as reader:
        assert [len(table) for table in reader.tables()] == [1]
        assert 'topic ato/gradient: 1 message skipped that cannot be read' in reader.warnings[0]


def test_rows_of_a_table_are_those_of_its_records(tmp_path: Path) -> None:
    rng = np.random.default_rng(93)
    expected = write(tmp_path / 'bag', random_records(rng, 50), rng)
    with BagReader(tmp_path / 'bag') as reader:
        rows = [row for table in reader.tables() for row in table.rows()]
    assert rows == [record.row() for record in expected]


def test_layouts_are_those_of_the_definitions() -> None:
    found = {topic.message: (layout(topic.message).floats, layout(topic.message).flags) for topic in INPUT_TOPICS}
    expected = {
        'AtoSpeed': (2, 0),
        'AtoForce': (1, 0),
        'TrackGradient': (2, 1),
        'BrakeCommand': (1, 1),
        'TrainMass': (1, 0),
    }
    assert found == expected


def test_no_tables_join_to_an_empty_one() -> None:
    assert len(joined((EMPTY, EMPTY))) == 0
