# SPDX-License-Identifier: Apache-2.0
"""Files of a folder that are read as a bag, messages about others, and bags in the sqlite3 storage of rosbag2."""

from __future__ import annotations

import gzip
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
import yaml
import zstandard
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from test.own_bag import error_of, read_bag, write_bag
from trainid_ros.bag import bag_files
from trainid_ros.bag.bag_files import bags_below
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import digest, full_definition, full_type, message_from_record, typestore
from trainid_ros.cli.main import main
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import INPUT_TOPICS, Record, input_topic

LFS_POINTER = b'version https://git-lfs.github.com/spec/v1\noid sha256:0\n'


def change(bag: Path, **values: object) -> None:
    """Change what the metadata of a bag say."""
    path = bag / 'metadata.yaml'
    document = yaml.safe_load(path.read_text())
    document['rosbag2_bagfile_information'] |= values
    path.write_text(yaml.safe_dump(document))


def pack(path: Path) -> Path:
    """Replace a file by a compressed one, as ros2 bag does in mode file."""
    packed = path.with_name(f'{path.name}.zstd')
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    path.unlink()
    return packed


@pytest.fixture
def split(tmp_path: Path, records: list[Record]) -> Path:
    """Return a bag in three parts, of which its metadata list two."""
    folder = tmp_path / 'split'
    folder.mkdir()
    for number in range(3):
        part = write_bag(tmp_path / f'part_{number}', records[number::3])
        shutil.copy(part / f'part_{number}.mcap', folder / f'split_{number}.mcap')
    shutil.copy(tmp_path / 'part_0' / 'metadata.yaml', folder)
    names = ['split_0.mcap', 'split_1.mcap']
    change(folder, relative_file_paths=names, message_count=2 * len(records) // 3)
    return folder


@pytest.mark.parametrize('listed', [1, 2])
def test_parts_that_the_metadata_do_not_list_are_read_with_a_warning(
    split: Path, records: list[Record], listed: int
) -> None:
    names = [f'split_{number}.mcap' for number in range(3)]
    change(split, relative_file_paths=names[:listed])
    how = 'not listed in metadata.yaml, read as a part of the bag'
    assert read_bag(split) == (records, [f'{split / name}: {how}' for name in names[listed:]])


@pytest.mark.parametrize('name', ['other_2.mcap', 'split_2.db3', 'split_copy.mcap'])
def test_a_file_of_another_name_is_no_part_of_the_bag(split: Path, records: list[Record], name: str) -> None:
    (split / 'split_2.mcap').rename(split / name)
    expected = [record for k, record in enumerate(records) if k % 3 != 2]
    assert read_bag(split) == (expected, [f'{split / name}: not listed in metadata.yaml, not read'])


def test_a_missing_part_makes_no_other_file_one(split: Path, records: list[Record]) -> None:
    (split / 'split_2.mcap').rename(split / 'other.mcap')
    (split / 'split_1.mcap').unlink()
    warnings = [
        f'{split / "split_1.mcap"}: file listed in metadata.yaml is missing, the files that are there were read',
        f'{split / "other.mcap"}: not listed in metadata.yaml, not read',
        f'{split}: 67 of 133 messages found',
    ]
    assert read_bag(split) == (records[::3], warnings)


def test_a_bag_of_one_file_has_no_other_parts(bag: Path, records: list[Record]) -> None:
    shutil.copy(bag / 'bag.mcap', bag / 'bag_1.mcap')
    assert read_bag(bag) == (records, [f'{bag / "bag_1.mcap"}: not listed in metadata.yaml, not read'])


def test_compressed_parts_are_never_left_out_in_silence(split: Path, records: list[Record]) -> None:
    """A recorder that is killed leaves its last file as it is."""
    packed = pack(split / 'split_1.mcap')
    warning = f'{packed}: not read: it is compressed by zstd, as ros2 bag does in mode file; unpack it with zstd -d'
    found, warnings = read_bag(split)
    assert warning in warnings
    (split / 'metadata.yaml').unlink()
    assert sorted(bags_below(split)) == [split / 'split_0.mcap', packed, split / 'split_2.mcap']
    expected = [record for k, record in enumerate(records) if k % 3 != 1]
    missing = f'{split}: metadata.yaml is missing, the files were read without it'
    assert read_bag(split) == (found, [missing, warning]) == (expected, [missing, warning])
    shutil.copy(split / 'split_0.mcap', split / 'split_1.mcap')
    assert warning not in read_bag(split)[1]
    assert packed not in bags_below(split)


@pytest.mark.parametrize(
    ('content', 'why'),
    [
        (b'', 'is empty'),
        (LFS_POINTER, 'is not an MCAP file: it is a pointer of Git LFS; get the file with git lfs pull'),
        (b'SQLite format 3\0', 'unreadable sqlite3 storage (file is not a database)'),
    ],
    ids=['empty', 'pointer', 'cut'],
)
def test_a_part_that_cannot_be_read_costs_no_other(
    split: Path, records: list[Record], content: bytes, why: str
) -> None:
    path = split / 'split_2.mcap'
    path.write_bytes(content)
    found, warnings = read_bag(split)
    assert found == [record for k, record in enumerate(records) if k % 3 != 2]
    assert f'{path}: {why}; the other files of the bag were read' in warnings
    for number in range(2):
        (split / f'split_{number}.mcap').write_bytes(content)
    assert error_of(split) == f'{split / "split_0.mcap"}: {why}'


def test_suffixes_in_capitals_are_those_of_bags(bag: Path, records: list[Record]) -> None:
    (bag / 'metadata.yaml').unlink()
    (bag / 'bag.mcap').rename(bag / 'BAG.MCAP')
    assert read_bag(bag)[0] == records
    assert bags_below(bag.parent) == [bag / 'BAG.MCAP']


@pytest.mark.parametrize('mode', ['file', 'message'])
def test_compression_by_ros2_bag_is_named(bag: Path, mode: str) -> None:
    packed = pack(bag / 'bag.mcap') if mode == 'file' else bag / 'bag.mcap'
    change(bag, compression_mode=mode.upper(), relative_file_paths=[packed.name])
    assert f"compression mode '{mode}' of ros2 bag is not supported" in error_of(bag)


def test_files_that_were_unpacked_by_hand_are_read(bag: Path, records: list[Record]) -> None:
    change(bag, compression_mode='FILE', relative_file_paths=['bag.mcap.zstd'])
    found, (warning,) = read_bag(bag)
    assert found == records
    assert warning.endswith("metadata.yaml: compression mode 'file', but the files are unpacked, and were read")


@pytest.mark.parametrize('has_metadata', [True, False])
def test_compressed_files_in_a_folder_are_named(bag: Path, *, has_metadata: bool) -> None:
    pack(bag / 'bag.mcap')
    if not has_metadata:
        (bag / 'metadata.yaml').unlink()
    hint = 'it is compressed by zstd, as ros2 bag does in mode file; unpack it with zstd -d'
    assert error_of(bag).endswith(f'; bag.mcap.zstd: {hint}')


@pytest.mark.parametrize(
    ('content', 'hint'),
    [
        (zstandard.compress(b'bag'), 'unpack it with zstd -d'),
        (gzip.compress(b'bag', mtime=0), 'unpack it with gunzip'),
        (b'#ROSBAG V2.0\n', 'it is a ROS 1 bag; convert it with rosbags-convert'),
        (LFS_POINTER, 'get the file with git lfs pull'),
    ],
    ids=['zstd', 'gzip', 'ROS 1', 'Git LFS'],
)
def test_other_files_get_a_hint(tmp_path: Path, content: bytes, hint: str) -> None:
    (tmp_path / 'x.mcap').write_bytes(content)
    text = error_of(tmp_path / 'x.mcap')
    assert text.startswith(f'{tmp_path / "x.mcap"}: is not an MCAP file: it is ')
    assert text.endswith(hint)


@pytest.fixture
def db3(tmp_path: Path, records: list[Record]) -> Path:
    """Return a rosbag2 directory in sqlite3 storage, as ROS 2 Iron and later write it."""
    path, store = tmp_path / 'run', typestore()
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {
            topic: writer.add_connection(
                f'/{topic.name}', full_type(topic.message), typestore=store,
                msgdef=full_definition(topic.message), rihs01=digest(topic.message),
            )
            for topic in INPUT_TOPICS
        }  # fmt: skip
        for record in records:
            topic = input_topic(record)
            payload = store.serialize_cdr(message_from_record(record), full_type(topic.message))
            writer.write(connections[topic], record.stamp_ns, payload)
    return path


def make_humble(path: Path) -> None:
    """Change a file to what ROS 2 Humble writes: no definitions, no hashes."""
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript("""
            DROP TABLE message_definitions;
            DROP TABLE schema;
            ALTER TABLE topics DROP COLUMN type_description_hash;
        """)


@pytest.mark.parametrize('at_once', [5000, 7])
def test_records_are_those_written(
    db3: Path, records: list[Record], at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_files, '_MESSAGES_AT_ONCE', at_once)
    assert read_bag(db3) == (records, [])
    with BagReader(db3) as reader:
        assert (reader.message_count, reader.input_count) == (len(records), len(records))
        assert reader.time_range() == (records[0].stamp_ns, records[-1].stamp_ns)
        assert {topic.type for topic in reader.topics()} >= {'trainid_msgs/msg/AtoSpeed'}


def test_a_bare_file_and_one_without_metadata_are_read(db3: Path, records: list[Record]) -> None:
    assert read_bag(db3 / 'run.db3') == (records, [])
    (db3 / 'metadata.yaml').unlink()
    found, (warning,) = read_bag(db3)
    assert found == records
    assert 'metadata.yaml is missing' in warning


def test_older_files_without_definitions_are_read(db3: Path, records: list[Record]) -> None:
    make_humble(db3 / 'run.db3')
    assert read_bag(db3 / 'run.db3') == (records, [])


def test_messages_of_equal_log_times_stay_together(
    db3: Path, records: list[Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_files, '_MESSAGES_AT_ONCE', 7)
    execute(db3, 'UPDATE messages SET timestamp = 1700000000000000000 WHERE id BETWEEN 3 AND 30')
    found, _ = read_bag(db3)
    assert sorted(found, key=lambda record: record.stamp_ns) == records


def test_another_definition_is_an_error(db3: Path) -> None:
    execute(db3, "UPDATE message_definitions SET encoded_message_definition = 'float64 x'")
    with pytest.raises(InputError, match=r'run\.db3: topic ato/\w+: definition of .* differs'):
        read_bag(db3)


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
    assert f'{path}: unreadable sqlite3 storage' in error_of(db3)


def test_messages_left_in_the_journal_are_a_warning(db3: Path) -> None:
    (db3 / 'run.db3-wal').write_bytes(b'x')
    _, (warning,) = read_bag(db3)
    assert 'run.db3-wal: messages of an interrupted recording' in warning


def test_commands_take_it(db3: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(db3), str(db3 / 'run.db3'), '--json']) == 0
    assert capsys.readouterr().err == ''


def execute(db3: Path, *statements: str) -> None:
    with closing(sqlite3.connect(db3 / 'run.db3')) as connection:
        connection.executescript(';'.join(statements))


@pytest.mark.parametrize('name', ['run#1', '50%41', 'what?', 'a b;c&d', 'ä日'])
def test_the_file_named_is_read_whatever_its_folder_is_called(
    db3: Path, tmp_path: Path, records: list[Record], name: str
) -> None:
    (tmp_path / name).mkdir()
    (db3 / 'run.db3').rename(tmp_path / name / 'run.db3')
    assert read_bag(tmp_path / name / 'run.db3') == (records, [])


@pytest.mark.parametrize(('asked', 'other'), [('run.db3#2', 'run.db3'), ('r%41n.db3', 'rAn.db3')])
def test_no_other_file_is_read_instead(db3: Path, records: list[Record], asked: str, other: str) -> None:
    (db3 / 'run.db3').rename(db3 / asked)
    (db3 / other).write_bytes((db3 / asked).read_bytes())
    with closing(sqlite3.connect(db3 / other)) as connection, connection:
        connection.execute('DELETE FROM messages')
    assert read_bag(db3 / asked) == (records, [])


# SQL that leaves out that texts must be there.
UNCHECKED = ('CREATE TABLE x AS SELECT * FROM topics', 'DROP TABLE topics', 'ALTER TABLE x RENAME TO topics')


def other_topic(encoding: str) -> tuple[str, ...]:
    return (
        "INSERT INTO topics VALUES (99, '/doors/_action/feedback', 'my/action/Doors', 'cdr', '', '')",
        f"INSERT INTO message_definitions VALUES (99, 'my/action/Doors', '{encoding}', '', '')",
        "INSERT INTO messages VALUES (9999, 99, 1700000000000000000, x'00010000')",
    )


@pytest.mark.parametrize(
    'statements',
    [
        *(other_topic(encoding) for encoding in ('unknown', '', 'omgidl')),
        ("UPDATE topics SET offered_qos_profiles = '- history: 1\n  depth: 10'",),
        ("UPDATE topics SET offered_qos_profiles = 'no: [yaml'",),
        ("UPDATE topics SET offered_qos_profiles = ''",),
        (*other_topic('cdr'), "UPDATE topics SET name = x'ff00', type = 5 WHERE id = 99"),
        (*other_topic(''), *UNCHECKED, 'UPDATE topics SET name = NULL, type = NULL WHERE id = 99'),
        ('UPDATE message_definitions SET encoded_message_definition = CAST(encoded_message_definition AS BLOB)',),
        ('UPDATE topics SET id = id + 70000', 'UPDATE messages SET topic_id = topic_id + 70000'),
    ],
)
def test_unknown_definitions_profiles_and_large_numbers_lose_nothing(
    db3: Path, records: list[Record], statements: tuple[str, ...]
) -> None:
    execute(db3, *statements)
    assert read_bag(db3 / 'run.db3') == (records, [])


@pytest.mark.parametrize(
    ('change_to', 'warning'),
    [
        ("data = 'no message'", 'topic ato/speed: 1 message skipped that cannot be read'),
        ('timestamp = -1', '1 message without a valid log time left out'),
        ('topic_id = 77', '1 message on unknown topics left out'),
        ("timestamp = 'yesterday'", '1 message without a valid log time left out'),
    ],
)
def test_a_damaged_message_is_the_only_one_left_out(
    db3: Path, records: list[Record], change_to: str, warning: str
) -> None:
    execute(db3, f'UPDATE messages SET {change_to} WHERE id = 5')
    path = db3 / 'run.db3'
    assert read_bag(path) == (records[:4] + records[5:], [f'{path}: {warning}'])
