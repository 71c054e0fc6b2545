# SPDX-License-Identifier: Apache-2.0
"""Bags in the sqlite3 storage of rosbag2 give the records of the same bag in MCAP."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from trainid_ros.bag import db3_file
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import digest, full_definition, full_type, message_from_record, typestore
from trainid_ros.cli.main import main
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping_file import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import Record, input_topic


@pytest.fixture
def db3(tmp_path: Path, records: list[Record]) -> Path:
    """Return a rosbag2 directory in sqlite3 storage, as ROS 2 Iron and later write it."""
    path, store = tmp_path / 'run', typestore()
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for record in records:
            topic = input_topic(record)
            name = full_type(topic.message)
            if topic.name not in connections:
                text, hash_ = full_definition(topic.message), digest(topic.message)
                connections[topic.name] = writer.add_connection(
                    f'/{topic.name}', name, typestore=store, msgdef=text, rihs01=hash_
                )
            payload = store.serialize_cdr(message_from_record(record), name)
            writer.write(connections[topic.name], record.stamp_ns, payload)
    return path


def make_humble(path: Path) -> None:
    """Change a file to what ROS 2 Humble writes: no definitions, no hashes."""
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript("""
            DROP TABLE message_definitions;
            DROP TABLE schema;
            ALTER TABLE topics DROP COLUMN type_description_hash;
        """)


def read(path: Path) -> tuple[list[Record], list[str]]:
    with BagReader(path) as reader:
        found = list(reader.records())
        assert list(reader.records()) == found  # a second pass starts over
        return found, reader.warnings


@pytest.mark.parametrize('at_once', [5000, 7])
def test_records_are_those_written(
    db3: Path, records: list[Record], at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(db3_file, '_MESSAGES_AT_ONCE', at_once)
    assert read(db3) == (records, [])
    with BagReader(db3) as reader:
        assert (reader.message_count, reader.input_count) == (len(records), len(records))
        assert reader.time_range() == (records[0].stamp_ns, records[-1].stamp_ns)
        assert {topic.type for topic in reader.topics()} >= {'trainid_msgs/msg/AtoSpeed'}
        assert len([entry for entry in reader.messages() if entry.topic == 'ato/force']) == len(records) // 4


def test_a_bare_file_and_one_without_metadata_are_read(db3: Path, records: list[Record]) -> None:
    assert read(db3 / 'run.db3') == (records, [])
    (db3 / 'metadata.yaml').unlink()
    found, (warning,) = read(db3)
    assert found == records
    assert 'metadata.yaml is missing' in warning


def test_older_files_without_definitions_are_read(db3: Path, records: list[Record]) -> None:
    (db3 / 'metadata.yaml').unlink()
    make_humble(db3 / 'run.db3')
    assert read(db3 / 'run.db3') == (records, [])


def test_messages_of_equal_log_times_stay_together(
    db3: Path, records: list[Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(db3_file, '_MESSAGES_AT_ONCE', 7)
    with closing(sqlite3.connect(db3 / 'run.db3')) as connection:
        connection.execute('UPDATE messages SET timestamp = 1700000000000000000 WHERE id BETWEEN 3 AND 30')
        connection.commit()
    found, _ = read(db3)
    assert sorted(found, key=lambda record: record.stamp_ns) == records


def test_another_definition_is_an_error(db3: Path) -> None:
    with closing(sqlite3.connect(db3 / 'run.db3')) as connection:
        connection.execute("UPDATE message_definitions SET encoded_message_definition = 'float64 x'")
        connection.commit()
    with pytest.raises(InputError, match=r'run\.db3: topic ato/\w+: definition of .* differs'):
        read(db3)


def test_standard_types_without_definitions_are_mapped(tmp_path: Path) -> None:
    store, path = get_typestore(Stores.ROS2_HUMBLE), tmp_path / 'foreign'
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/v', 'std_msgs/msg/Float32', typestore=store)
        for k in range(3):
            message = store.types['std_msgs/msg/Float32'](data=3.6 * k)
            writer.write(connection, 10**18 + k, store.serialize_cdr(message, 'std_msgs/msg/Float32'))
    make_humble(path / 'foreign.db3')
    mapping = parse_mapping('speed: {topic: /v, field: data, unit: km/h, stamp: receive}', 'map.yaml')
    with BagReader(path / 'foreign.db3', inputs=lambda: MappedInputs(mapping, None)) as reader:
        rows = [record.row() for record in reader.records()]
    assert [row[1] for row in rows] == [10**18, 10**18 + 1, 10**18 + 2]
    assert [row[2] for row in rows] == pytest.approx([0.0, 1.0, 2.0])


@pytest.mark.parametrize('keep', [16, 100, 9000])
def test_a_damaged_file_is_named(db3: Path, keep: int) -> None:
    path = db3 / 'run.db3'
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r'run\.db3: unreadable sqlite3 storage'):
        read(db3)


def test_messages_left_in_the_journal_are_a_warning(db3: Path) -> None:
    (db3 / 'run.db3-wal').write_bytes(b'x')
    _, (warning,) = read(db3)
    assert 'run.db3-wal: messages of an interrupted recording' in warning


def test_commands_take_it(db3: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(db3), str(db3 / 'run.db3'), '--json']) == 0
    assert capsys.readouterr().err == ''


def change(db3: Path, *statements: str) -> None:
    with closing(sqlite3.connect(db3 / 'run.db3')) as connection:
        connection.executescript(';'.join(statements))


@pytest.mark.parametrize('name', ['run#1', '50%41', 'what?', 'a b;c&d', 'ä日'])
def test_the_file_named_is_read_whatever_its_folder_is_called(
    db3: Path, tmp_path: Path, records: list[Record], name: str
) -> None:
    (tmp_path / name).mkdir()
    (db3 / 'run.db3').rename(tmp_path / name / 'run.db3')
    assert read(tmp_path / name / 'run.db3') == (records, [])


@pytest.mark.parametrize(('asked', 'other'), [('run.db3#2', 'run.db3'), ('r%41n.db3', 'rAn.db3')])
def test_no_other_file_is_read_instead(db3: Path, records: list[Record], asked: str, other: str) -> None:
    (db3 / 'run.db3').rename(db3 / asked)
    (db3 / other).write_bytes((db3 / asked).read_bytes())
    with closing(sqlite3.connect(db3 / other)) as connection, connection:
        connection.execute('DELETE FROM messages')
    assert read(db3 / asked) == (records, [])


@pytest.mark.parametrize('encoding', ['unknown', '', 'omgidl'])
def test_a_topic_without_a_known_definition_costs_no_other(db3: Path, records: list[Record], encoding: str) -> None:
    change(
        db3,
        "INSERT INTO topics VALUES (99, '/doors/_action/feedback', 'my/action/Doors', 'cdr', '', '')",
        f"INSERT INTO message_definitions VALUES (99, 'my/action/Doors', '{encoding}', '', '')",
        "INSERT INTO messages VALUES (9999, 99, 1700000000000000000, x'00010000')",
    )
    assert read(db3 / 'run.db3') == (records, [])


@pytest.mark.parametrize('profiles', ['- history: 1\n  depth: 10', 'no: [yaml', ''])
def test_profiles_written_by_hand_do_not_matter(db3: Path, records: list[Record], profiles: str) -> None:
    change(db3, f"UPDATE topics SET offered_qos_profiles = '{profiles}'")
    assert read(db3 / 'run.db3') == (records, [])


def test_a_message_stored_as_text_is_the_only_one_skipped(db3: Path, records: list[Record]) -> None:
    change(db3, "UPDATE messages SET data = 'no message' WHERE id = 5")
    path = db3 / 'run.db3'
    found, warnings = read(path)
    assert found == records[:4] + records[5:]
    assert warnings == [f'{path}: topic ato/speed: 1 message skipped that cannot be read']


@pytest.mark.parametrize('time', ['-1', "'yesterday'"])
def test_a_message_without_a_valid_log_time_is_the_only_one_left_out(
    db3: Path, records: list[Record], time: str
) -> None:
    change(db3, f'UPDATE messages SET timestamp = {time} WHERE id = 5')
    path = db3 / 'run.db3'
    found, warnings = read(path)
    assert found == records[:4] + records[5:]
    assert warnings == [f'{path}: 1 message without a valid log time left out']


def test_numbers_of_topics_may_be_large(db3: Path, records: list[Record]) -> None:
    change(db3, 'UPDATE topics SET id = id + 70000', 'UPDATE messages SET topic_id = topic_id + 70000')
    assert read(db3 / 'run.db3') == (records, [])
