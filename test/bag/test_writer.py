# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

import pytest
import yaml
from mcap.opcode import Opcode
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability, QosHistory, QosReliability

from test.own_bag import START_NS as STAMP
from test.own_bag import messages_of
from trainid_ros.bag.mcap_file import MAGIC
from trainid_ros.bag.types import digest, message_from_record
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import MassRecord, Record, SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, Output, Status

if TYPE_CHECKING:
    from pathlib import Path

ESTIMATE = BrakeRateEstimate(0.9, 0.1, 1.0, 2.0, -0.3, -0.4, 150.0, True, 0.01, 0.02, 0.03)


def output(status: Status, stamp_ns: int = STAMP) -> Output[BrakeRateEstimate]:
    return Output(stamp_ns, ESTIMATE, status, 5, 2, None)


def test_another_reader_reads_messages_digests_and_qos(bag: Path, records: list[Record]) -> None:
    with AnyReader([bag]) as reader:
        assert reader.message_count == len(records)
        for connection in reader.connections:
            assert connection.digest == digest(connection.msgtype.rpartition('/')[2])
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            (qos,) = connection.ext.offered_qos_profiles
            assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.VOLATILE)
            assert (qos.history, qos.depth) == (QosHistory.KEEP_LAST, 10)
    speeds = [message.speed for message in messages_of(bag, 'ato/speed')]
    assert speeds == [record.speed for record in records if isinstance(record, SpeedRecord)]


def test_metadata_is_that_of_a_jazzy_bag(bag: Path) -> None:
    info = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert (info['version'], info['storage_identifier']) == (9, 'mcap')
    # Chunks are compressed inside the file; compression of the whole bag would need a different player.
    assert (info['compression_mode'], info['compression_format']) == ('', '')


def test_chunks_are_compressed(bag: Path) -> None:
    with (bag / 'bag.mcap').open('rb') as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        assert chunk.compression == 'zstd'
        assert chunk.compressed_size < 0.7 * chunk.uncompressed_size


def test_messages_and_summary_carry_their_checksums(bag: Path) -> None:
    """As in the specification: up to the end of the data, and from the start of the summary on to its checksum."""
    content = (bag / 'bag.mcap').read_bytes()
    start, _, crc = struct.unpack_from('<QQI', content, len(content) - len(MAGIC) - 20)
    assert crc == zlib.crc32(content[start : -len(MAGIC) - 4]) != 0
    opcode, _, data_crc = struct.unpack_from('<BQI', content, start - 13)
    assert (opcode, data_crc) == (Opcode.DATA_END, zlib.crc32(content[: start - 13]))


def test_valid_estimate_is_latched_for_late_joiners(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'out') as writer:
        writer.on_output(output(Status.CONVERGING))
        writer.on_output(output(Status.VALID, STAMP + 1))
    with AnyReader([tmp_path / 'out']) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        latched = next(c for c in reader.connections if c.topic == '/trainid/last_valid/brake_rate')
        assert isinstance(latched.ext, ConnectionExtRosbag2)
        (qos,) = latched.ext.offered_qos_profiles
    assert counts == {'/trainid/brake_rate': 2, '/trainid/last_valid/brake_rate': 1}
    assert (qos.durability, qos.depth) == (QosDurability.TRANSIENT_LOCAL, 1)


def test_existing_path_is_not_touched(tmp_path: Path) -> None:
    path = tmp_path / 'bag'
    path.write_text('precious')
    with pytest.raises(InputError, match='bag: exists already'), BagWriter(path):
        pass
    assert path.read_text() == 'precious'


def test_a_failed_block_removes_the_bag(tmp_path: Path, records: list[Record]) -> None:
    def write_half() -> None:
        with BagWriter(tmp_path / 'bag') as writer:
            writer.write_record(records[0])
            raise RuntimeError('boom')

    with pytest.raises(RuntimeError, match='boom'):
        write_half()
    assert list(tmp_path.iterdir()) == []


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match='file/bag: cannot be written'), BagWriter(tmp_path / 'file' / 'bag'):
        pass


@pytest.mark.parametrize('stamp_ns', [-1, 2**63])
def test_a_log_time_that_cannot_be_stored_is_rejected(tmp_path: Path, stamp_ns: int) -> None:
    message = message_from_record(MassRecord(STAMP, 1e5))
    with pytest.raises(InputError, match=f'ato/mass: log time {stamp_ns} ns'), BagWriter(tmp_path / 'bag') as writer:
        writer.write_message('ato/mass', 'TrainMass', stamp_ns, message)


def test_a_log_time_may_be_zero(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_message('ato/mass', 'TrainMass', 0, message_from_record(MassRecord(STAMP, 1e5)))
        assert writer.message_count == 1


def test_writing_outside_the_context_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='not open'):
        BagWriter(tmp_path / 'bag').write_record(MassRecord(STAMP, 1e5))
