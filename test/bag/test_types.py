# SPDX-License-Identifier: Apache-2.0
"""Message types and definitions; columns of messages, whatever frame, byte order and padding they have."""

from __future__ import annotations

import math
import struct
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Schema
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.serde import SerdeError

from test.own_bag import read_bag
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import (
    EMPTY,
    StoredType,
    digest,
    estimate_message,
    full_type,
    joined,
    message_from_record,
    table_of,
    typestore,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
    record_from_message,
)
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Estimate,
    Output,
    Reason,
    Rejection,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)

TOPICS = {topic.message: topic for topic in INPUT_TOPICS}
STAMP = 1_700_000_000_123_456_789
RECORDS: list[tuple[str, Record]] = [
    ('AtoSpeed', SpeedRecord(STAMP, 12.5, 1450.25)),
    ('AtoForce', ForceRecord(STAMP, -1.5e5)),
    ('TrackGradient', GradientRecord(STAMP, -12.5, 400.0, tunnel=True)),
    ('BrakeCommand', BrakeRecord(STAMP, -0.75, emergency=True)),
    ('TrainMass', MassRecord(STAMP, 194e3)),
]


@pytest.mark.parametrize(('name', 'record'), RECORDS)
def test_record_survives_serialisation(name: str, record: Record) -> None:
    store, kind = typestore(), full_type(name)
    message = store.deserialize_cdr(store.serialize_cdr(message_from_record(record), kind), kind)
    assert record_from_message(TOPICS[name], message) == record


def test_numpy_scalars_become_plain_numbers() -> None:
    message = message_from_record(ForceRecord(STAMP, np.float32(1.5)))  # type: ignore[arg-type]
    assert type(message.force) is float


def numbered(kind: type[Estimate], width: int) -> Estimate:
    """Return an estimate in which each field has a different value."""
    values: dict[str, object] = {item.name: float(i) for i, item in enumerate(fields(kind), 1)}
    if width:
        values['covariance'] = tuple(float(i) for i in range(width))
    if kind is BrakeRateEstimate:
        values['observable'] = True
    return kind(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize(('kind', 'width'), [(ResistanceEstimate, 9), (SpeedModelEstimate, 16), (BrakeRateEstimate, 0)])
def test_estimate_fills_every_field_of_its_message(kind: type[Estimate], width: int) -> None:
    estimate = numbered(kind, width)
    rejection = Rejection(STAMP, Reason.OUTLIER, 9.0, 4.0)
    output = Output(STAMP, estimate, Status.HOLDING, 7, 3, rejection)
    store, name = typestore(), full_type(kind.__name__)
    message = store.deserialize_cdr(store.serialize_cdr(estimate_message(output), name), name)
    for item in fields(kind):
        expected = getattr(estimate, item.name)
        actual = getattr(message, item.name)
        assert (tuple(actual) if isinstance(expected, tuple) else actual) == expected, item.name
    assert (message.status, message.used, message.rejected) == (3, 7, 3)  # type: ignore[attr-defined]
    assert message.last_reject_reason == Reason.OUTLIER.value  # type: ignore[attr-defined]
    assert message.last_reject_text == str(rejection)  # type: ignore[attr-defined]


def test_an_output_without_rejection_has_reason_zero() -> None:
    message = estimate_message(Output(STAMP, numbered(BrakeRateEstimate, 0), Status.VALID, 1, 0, None))
    assert (message.last_reject_reason, message.last_reject_text) == (0, '')


@pytest.mark.parametrize('stamp', [-1, 2**31 * 10**9])
def test_a_stamp_outside_ros_time_is_rejected(stamp: int) -> None:
    with pytest.raises(InputError, match=str(stamp)):
        message_from_record(MassRecord(stamp, 1.0))


@pytest.mark.parametrize(('sec', 'nanosec'), [(0, 0), (0, 999_999_999), (2**31 - 1, 999_999_999)])
def test_a_stamp_within_ros_time_is_split(sec: int, nanosec: int) -> None:
    stamp = message_from_record(MassRecord(sec * 10**9 + nanosec, 1.0)).header.stamp
    assert (stamp.sec, stamp.nanosec) == (sec, nanosec)


def test_every_definition_is_packaged() -> None:
    root = Path(__file__).parents[2] / 'msg_defs' / 'msg'
    names = [path.stem for path in root.glob('*.msg')]
    assert len(names) >= 8
    assert len({digest(name) for name in names if name != 'RejectReason'}) == len(names) - 1


def test_reject_reasons_have_the_numbers_of_the_core() -> None:
    kind = typestore().types[full_type('RejectReason')]
    assert {reason.name: reason.value for reason in Reason} == {
        name: getattr(kind, name) for name in dir(kind) if name.isupper()
    }


@pytest.mark.parametrize('name', ['ResistanceEstimate', 'SpeedModelEstimate', 'BrakeRateEstimate'])
def test_status_has_the_numbers_of_the_core(name: str) -> None:
    kind = typestore().types[full_type(name)]
    assert {status.name: getattr(kind, status.name) for status in Status} == {s.name: s.value for s in Status}


RULER = '=' * 80 + '\n'
HEADER_MSG = f'{RULER}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n'
TIME_MSG = f'{RULER}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n'
HEADER_IDL = f"""{RULER}IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs {{ module msg {{ struct Header {{ builtin_interfaces::msg::Time stamp; string frame_id; }}; }}; }};
"""
TIME_IDL = f"""{RULER}IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{ struct Time {{ int32 sec; uint32 nanosec; }}; }}; }};
"""


def in_idl(fields: str, includes: str = '#include "std_msgs/msg/Header.idl"\n') -> str:
    text = f'module my_msgs {{ module msg {{ struct Odo {{ {fields} }}; }}; }};\n'
    return f'{RULER}IDL: my_msgs/msg/Odo\n{includes}{text}'


def stored_type(encoding: str, text: str, name: str = 'my_msgs/msg/Odo') -> StoredType:
    return StoredType(Path('x.mcap'), Schema(1, text.encode(), encoding, name))


FIELDS_IDL = 'std_msgs::msg::Header header; double v;'
BOTH_IDL = HEADER_IDL + TIME_IDL
BOTH_MSG = HEADER_MSG + TIME_MSG
FIELDS_MSG = 'std_msgs/Header header\nfloat64 v\n'
# Header with a frame of three characters, and speed.
ODO = b'\0\1\0\0' + struct.pack('<iII4sd', 7, 8, 4, b'map', 2.5)
ODO_DEFINITIONS = {
    'msg': ('ros2msg', FIELDS_MSG + BOTH_MSG),
    'CR LF': ('ros2msg', (FIELDS_MSG + BOTH_MSG).replace('\n', '\r\n')),
    'CR LF in the main part': ('ros2msg', FIELDS_MSG.replace('\n', '\r\n') + BOTH_MSG),
    'byte order mark': ('ros2msg', '\ufeff' + FIELDS_MSG + BOTH_MSG),
    'titles with msg': ('ros2msg', FIELDS_MSG + BOTH_MSG.replace('s/', 's/msg/', 2)),
    'no definition of the header': ('ros2msg', FIELDS_MSG),
    'IDL': ('ros2idl', in_idl(FIELDS_IDL) + BOTH_IDL),
    'IDL as another middleware names it': ('omgidl', in_idl(FIELDS_IDL) + BOTH_IDL),
    'IDL, other includes': ('ros2idl', in_idl(FIELDS_IDL, ' #include <x/Header.idl>\n#pragma once\n') + BOTH_IDL),
    'IDL, CR LF': ('ros2idl', (in_idl(FIELDS_IDL) + BOTH_IDL).replace('\n', '\r\n')),
    'IDL after an empty title': ('ros2msg', f'{RULER}MSG: \n' + in_idl(FIELDS_IDL) + BOTH_IDL),
    'msg with a dependency in IDL': ('ros2msg', FIELDS_MSG + BOTH_IDL),
    'IDL with a dependency in msg': ('ros2idl', in_idl(FIELDS_IDL) + BOTH_MSG),
    'rulers in comments': ('ros2msg', FIELDS_MSG.replace('float', f'# {RULER}## A{RULER}float') + BOTH_MSG),
    'ruler at the end': ('ros2msg', FIELDS_MSG + BOTH_MSG + RULER),
    'no last line end': ('ros2msg', f'{FIELDS_MSG}{BOTH_MSG}{RULER}MSG: std_msgs/Empty'),
    'constants': ('ros2msg', f'string A=\nint8 B=1_0\nstring<=3 C="=" # D=1\nwstring W=x\n{FIELDS_MSG}{BOTH_MSG}'),
    'constants in IDL': ('ros2idl', in_idl(FIELDS_IDL).replace('struct', 'const wstring W = "x"; struct') + BOTH_IDL),
    'a part that is no definition': ('ros2msg', f'{FIELDS_MSG}{BOTH_MSG}{RULER}MSG: my_msgs/Lost\n???\n'),
}


@pytest.mark.parametrize(('encoding', 'text'), ODO_DEFINITIONS.values(), ids=ODO_DEFINITIONS)
@pytest.mark.parametrize('name', ['my_msgs/msg/Odo', 'my_msgs/Odo'])
def test_definitions_that_ros_accepts_are_read(encoding: str, text: str, name: str) -> None:
    stored = stored_type(encoding, text, name)
    message = stored.decode(ODO)
    assert stored.name == 'my_msgs/msg/Odo'
    assert (message.header.stamp.sec, message.header.frame_id, message.v) == (7, 'map', 2.5)


@pytest.mark.parametrize('unit', ['H', 'I'])
@pytest.mark.parametrize(
    ('encoding', 'text'),
    [
        ('ros2msg', 'wstring W=x\nwstring<=9 w "none" # wide\nwstring[] more\nfloat64 v\n'),
        ('ros2idl', in_idl('wstring<9> w; sequence<wstring> more; double v;')),
    ],
    ids=['msg', 'IDL'],
)
def test_numbers_beside_wide_strings_are_read(unit: str, encoding: str, text: str) -> None:
    body = struct.pack(f'<I3{unit}', 3, *map(ord, 'abc'))
    for content in (struct.pack('<I', 2), *2 * [struct.pack(f'<I1{unit}', 1, 120)]):
        body += bytes(-len(body) % 4) + content
    body += bytes(-len(body) % 8)
    message = stored_type(encoding, text).decode(b'\0\1\0\0' + body + struct.pack('<d', 2.5))
    assert message.v == 2.5
    assert ''.join(map(chr, message.w.wide_characters)) == 'abc'


def test_a_name_that_begins_as_a_type_stays() -> None:
    stored = stored_type('ros2msg', 'float64 wstring_length\nwstring w\n')
    assert stored.decode(b'\0\1\0\0' + struct.pack('<dI', 2.5, 0)).wstring_length == 2.5


@pytest.mark.parametrize('shape', ['[6]', '[2][3]', '[1] [2][ 3 ]'])
def test_an_array_of_many_dimensions_is_read_as_one_of_one(shape: str) -> None:
    stored = stored_type('ros2idl', in_idl(f'double m{shape}; double v;'))
    message = stored.decode(b'\0\1\0\0' + struct.pack('<7d', *range(7)))
    assert message.m.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert message.v == 6.0


@pytest.mark.parametrize(
    ('field', 'part'),
    [('wchar c', ''), ('my_msgs::msg::U u', f'{RULER}IDL: my_msgs/msg/U\nunion U switch (long) {{}};')],
)
def test_a_field_that_cannot_be_read_costs_no_field_before_it(field: str, part: str) -> None:
    stored = stored_type('ros2idl', in_idl(f'double v; {field}; double after;') + part)
    message = stored.decode(b'\0\1\0\0' + struct.pack('<3d', 2.5, 0.0, 0.0))
    assert message.v == 2.5
    assert not hasattr(message, 'after')


@pytest.mark.parametrize('field', ['my_msgs/Lost lost', 'my_msgs/Lost[] lost', 'my_msgs/Part part'])
def test_an_unknown_field_costs_no_field_before_it(field: str) -> None:
    text = f'float64 v\n{field}\nfloat64 after\n{RULER}MSG: my_msgs/Part\nfloat64 a\nmy_msgs/Lost lost\n'
    stored = stored_type('ros2msg', text)
    message = stored.decode(b'\0\1\0\0' + struct.pack('<9d', *range(9)))
    assert message.v == 0.0
    assert not hasattr(message, 'after')
    assert hasattr(message, 'part') == ('Part' in field)
    with pytest.raises(SerdeError):
        stored.decode(b'\0\1\0\0\0\0')


@pytest.mark.parametrize(
    ('encoding', 'text'), [('ros2msg', 'my_msgs/Lost lost\nfloat64 v'), ('ros2msg', 'no definition'), ('', 'IDL: ')]
)
def test_a_definition_of_which_nothing_can_be_read_is_named(encoding: str, text: str) -> None:
    with pytest.raises(InputError, match=r'x\.mcap: unreadable definition of my_msgs/msg/Odo'):
        stored_type(encoding, text, 'my_msgs/Odo')


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
        rows = [row for table in reader.tables() for row in table.rows()]
    assert rows == [record.row() for record in expected]


def test_numbers_that_are_not_finite_pass_as_they_are(tmp_path: Path) -> None:
    records: list[Record] = [SpeedRecord(START, math.inf, math.nan), ForceRecord(START + 1, math.nan)]
    write(tmp_path / 'bag', records, np.random.default_rng(92))
    with BagReader(tmp_path / 'bag') as reader:
        assert sorted(map(repr, reader.records())) == sorted(map(repr, records))


@pytest.mark.parametrize('cut', [1, 3, 8, 12])
def test_a_message_that_is_too_short_is_skipped_and_counted(tmp_path: Path, cut: int) -> None:
    name, record = full_type('TrackGradient'), GradientRecord(START, 1.0, 2.0, False)
    payload = bytes(typestore().serialize_cdr(message_from_record(record), name))
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/ato/gradient', name, typestore=typestore())
        for content in (payload[:-cut], payload):
            writer.write(connection, START, content)
    found, (warning,) = read_bag(tmp_path / 'bag')
    assert found == [record]
    assert 'topic ato/gradient: 1 message skipped that cannot be read' in warning


def test_no_tables_join_to_an_empty_one() -> None:
    assert len(joined((EMPTY, table_of([])))) == 0
