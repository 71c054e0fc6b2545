# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from test.own_bag import START_NS as STAMP
from test.own_bag import error_of, read_bag, write_bag
from trainid_ros.bag.reader import BagReader, in_two, require_topics
from trainid_ros.bag.types import full_type, message_from_record, typestore
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import ForceRecord, MassRecord, Record, SpeedRecord, input_topic
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.train.train_file import Davis, Train, TrainFile

if TYPE_CHECKING:
    from collections.abc import Iterable


def write(path: Path, entries: Iterable[tuple[str, Record]]) -> Path:
    """Write records on any topic, logged at their stamps."""
    with BagWriter(path) as writer:
        for topic, record in entries:
            writer.write_message(topic, input_topic(record).message, record.stamp_ns, message_from_record(record))
    return path


def test_records_are_read_back_as_written(bag: Path, records: list[Record]) -> None:
    with BagReader(bag) as reader:
        assert list(reader.records()) == records
        assert list(reader.records()) == records  # a second pass starts over
        assert (reader.message_count, reader.input_count) == (len(records), len(records))
        assert reader.time_range() == (records[0].stamp_ns, records[-1].stamp_ns)
        assert reader.warnings == []
        require_topics(reader)


def test_topics_are_listed_with_type_and_count(bag: Path, records: list[Record]) -> None:
    with BagReader(bag) as reader:
        topics = {topic.name: (topic.type, topic.count) for topic in reader.topics()}
    each = len(records) // 4
    assert topics['ato/speed'] == ('trainid_msgs/msg/AtoSpeed', each)
    assert sorted(topics) == ['ato/brake_command', 'ato/force', 'ato/gradient', 'ato/speed']


def test_bare_file_reads_like_its_directory(bag: Path, records: list[Record]) -> None:
    assert read_bag(bag / 'bag.mcap') == (records, [])


def test_order_is_log_time_and_on_ties_that_of_the_file(tmp_path: Path) -> None:
    late, first, tie_a, tie_b = (
        SpeedRecord(STAMP + 9, 1.0, 0.0),
        SpeedRecord(STAMP + 1, 2.0, 0.0),
        ForceRecord(STAMP, 3.0),
        SpeedRecord(STAMP + 3, 4.0, 0.0),
    )
    path = write_bag(tmp_path / 'bag', (late, tie_a, tie_b, first), [STAMP + offset for offset in (30, 20, 20, 10)])
    with BagReader(path) as reader:
        assert list(reader.records()) == [first, tie_a, tie_b, late]
        assert next(iter(reader.rows())) == (STAMP + 10, first.row())


def test_order_holds_across_chunks_that_overlap(tmp_path: Path) -> None:
    # 1.5 MB on a foreign topic push the second half into later chunks of about 1 MB.
    store = typestore()
    store.register(get_types_from_msg('string data', 'std_msgs/msg/String'))
    filler = store.types['std_msgs/msg/String'](data='x' * 500_000)
    path = tmp_path / 'bag'
    order = [50, 10, 40, 0, 30, 20]
    with BagWriter(path) as writer:
        for offset in order:
            record = MassRecord(STAMP + offset, float(offset))
            writer.write_message('ato/mass', 'TrainMass', STAMP + offset, message_from_record(record))
            writer.write_message('chatter', 'std_msgs/msg/String', STAMP, filler)
    with BagReader(path) as reader:
        assert [record.stamp_ns - STAMP for record in reader.records()] == sorted(order)
        assert (reader.message_count, reader.input_count) == (12, 6)
        assert [log_ns - STAMP for log_ns, _, _ in reader.stored()] == sorted(order)


def test_stored_messages_of_successive_files_are_in_order(tmp_path: Path) -> None:
    folder = tmp_path / 'split'
    folder.mkdir()
    for k in range(3):
        part = write_bag(tmp_path / f'part_{k}', [MassRecord(STAMP + k, 1e5)])
        (part / f'part_{k}.mcap').rename(folder / f'part_{k}.mcap')
    with BagReader(folder) as reader:
        assert [log_ns - STAMP for log_ns, _, _ in reader.stored()] == [0, 1, 2]


def test_a_bag_without_messages_lacks_none(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag'):
        pass
    with BagReader(tmp_path / 'bag') as reader:
        assert (reader.message_count, reader.warnings) == (0, [])


def test_namespace_selects_the_train(tmp_path: Path) -> None:
    one, two = SpeedRecord(STAMP, 1.0, 0.0), SpeedRecord(STAMP + 1, 2.0, 0.0)
    path = write(tmp_path / 'bag', [('/train1/ato/speed', one), ('/train2/ato/speed', two)])
    for namespace in ('/train2', 'train2/'):
        with BagReader(path, namespace) as reader:
            assert list(reader.records()) == [two]
            assert [topic.name for topic in reader.topics()] == ['/train1/ato/speed', 'ato/speed']
    with BagReader(path) as reader:
        assert list(reader.records()) == []


def test_a_namespace_does_not_include_the_topics_of_the_root(tmp_path: Path) -> None:
    root, other = SpeedRecord(STAMP, 1.0, 0.0), SpeedRecord(STAMP + 1, 2.0, 0.0)
    path = write(tmp_path / 'bag', [('/ato/speed', root), ('/t2/ato/speed', other)])
    with BagReader(path, 't2') as reader:
        assert list(reader.records()) == [other]
    with BagReader(path) as reader:
        assert list(reader.records()) == [root]


def test_wrong_type_on_a_topic_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / 'bag', [('ato/speed', ForceRecord(STAMP, 1.0))])
    expected = 'bag.mcap: topic ato/speed: type trainid_msgs/msg/AtoSpeed expected, trainid_msgs/msg/AtoForce'
    assert expected in error_of(path)


def test_a_type_with_another_definition_is_rejected(tmp_path: Path) -> None:
    text, _ = typestore().generate_msgdef(full_type('AtoSpeed'), ros_version=2)
    other = text.replace('float64 position', 'float32 position')
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/ato/speed', full_type('AtoSpeed'), msgdef=other, rihs01='RIHS01_0')
        writer.write(connection, STAMP, b'\0' * 32)
    error = error_of(tmp_path / 'bag')
    assert 'topic ato/speed: definition of trainid_msgs/msg/AtoSpeed differs: RIHS01_' in error
    assert error.endswith(' found')


def test_the_type_hash_replaces_a_missing_definition(tmp_path: Path) -> None:
    good, name = typestore().hash_rihs01(full_type('TrainMass')), full_type('TrainMass')
    record = MassRecord(STAMP, 2e5)
    payload = typestore().serialize_cdr(message_from_record(record), name)
    for path, stated in ((tmp_path / 'good', good), (tmp_path / 'bad', 'RIHS01_0')):
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            writer.write(writer.add_connection('/ato/mass', name, msgdef=' ', rihs01=stated), STAMP, payload)
    assert read_bag(tmp_path / 'good')[0] == [record]
    assert 'RIHS01_0 found' in error_of(tmp_path / 'bad')
    # The bare file has neither definition nor type hash.
    assert 'no definition found' in error_of(tmp_path / 'good' / 'good.mcap')


def test_foreign_topics_are_ignored(tmp_path: Path) -> None:
    store = typestore()
    store.register(get_types_from_msg('float64 x', 'other_msgs/msg/Odd'))
    record = MassRecord(STAMP, 2e5)
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_message('odd', 'other_msgs/msg/Odd', STAMP, store.types['other_msgs/msg/Odd'](x=1.0))
        writer.write_record(record)
    with BagReader(tmp_path / 'bag') as reader:
        assert list(reader.stored()) == [(STAMP, 'ato/mass', record)]


def test_unreadable_payload_is_skipped_and_counted(tmp_path: Path) -> None:
    record = MassRecord(STAMP, 2e5)
    payload = typestore().serialize_cdr(message_from_record(record), full_type('TrainMass'))
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/ato/mass', full_type('TrainMass'), typestore=typestore())
        writer.write(connection, STAMP, b'\0\1\0\0short')
        writer.write(connection, STAMP, payload)
        writer.write(connection, STAMP, b'')
    with BagReader(tmp_path / 'bag') as reader:
        for _ in range(2):  # each reading counts anew
            for found in (list(reader.records()), [content for _, _, content in reader.stored()]):
                assert found == [record]
            assert reader.warnings == [f'{tmp_path / "bag"}: topic ato/mass: 2 messages skipped that cannot be read']


def test_progress_is_reported_while_a_file_without_an_index_is_opened(tmp_path: Path) -> None:
    path, shares = tmp_path / 'large.mcap', list[float]()
    with path.open('wb') as file:
        writer = McapWriter(file, chunk_size=1 << 20, compression=CompressionType.NONE, index_types=IndexType.NONE)
        writer.start()
        channel = writer.register_channel('/camera', 'cdr', writer.register_schema('Image', 'ros2msg', b''))
        for log_ns in range(1, 9):
            writer.add_message(channel, log_ns, bytes(1 << 20), log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    with BagReader(path, opening=shares.append) as reader:
        assert reader.message_count == 8
    assert len(shares) >= 7
    assert 0.8 < math.fsum(shares) <= 1.0
    assert max(shares) < 0.3


@pytest.mark.parametrize(('count', 'reports'), [(499, 0), (500, 1), (1001, 2)])
def test_progress_of_a_stream_is_reported_every_500_records(tmp_path: Path, count: int, reports: int) -> None:
    file = TrainFile(Train(mass=1e5), Davis(1.5, 0.02, 0.001))
    records = (MassRecord(STAMP + k, 1e5) for k in range(count))
    with BagReader(write_bag(tmp_path / 'bag', records)) as reader:
        steps = list[float]()
        assert not list(reader.events(SampleStream(StreamConfig(file)), steps.append))
    assert steps == [500] * reports


@pytest.mark.parametrize('scanned', [0.0, 0.9, 1.0])
def test_opening_counts_as_far_as_a_bag_is_scanned(scanned: float) -> None:
    shares = list[float]()
    opening, reading = in_two(shares.append, 0.3)
    opening(scanned)
    reading(0.5)
    assert shares == pytest.approx([0.3 * scanned, 0.5 * (1.0 - 0.3 * scanned)])
    reading(0.5)
    assert math.fsum(shares) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('names', 'missing', 'where'),
    [
        (('ato/force',), 'ato/speed, ato/gradient, ato/brake_command', 'found: ato/force'),
        (
            ('/t1/ato/force', '/north/t2/ato/force', 'other'),
            'ato/speed, ato/force, ato/gradient, ato/brake_command',
            'they are in /north/t2, /t1; use --namespace',
        ),
    ],
)
def test_missing_topics_are_named_with_where_they_are(
    tmp_path: Path, names: tuple[str, ...], missing: str, where: str
) -> None:
    path = write(tmp_path / 'bag', [(name, ForceRecord(STAMP, 1.0)) for name in names])
    with BagReader(path) as reader, pytest.raises(InputError) as caught:
        require_topics(reader)
    assert str(caught.value) == f'{tmp_path / "bag"}: no messages on {missing} ({where})'
