# SPDX-License-Identifier: Apache-2.0
"""Message types, and messages as records of the core: one by one, or as columns of many input messages at once.

Our own definitions are the packaged ``.msg`` files that ROS compiles, so a RIHS01 digest computed here equals the type
hash of ROS; types of others are known by the definitions in a bag. rosbags is imported only to write, and to read
messages or definitions that are not in the usual form.

The payload of every input message is CDR: four bytes that give the byte order, then the header (stamp, frame) and then
its numbers, each float64 on a multiple of eight bytes, followed by at most one flag.
"""

from __future__ import annotations

import math
import re
import struct
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    NS_PER_S,
    Record,
    Row,
    input_topic,
    output_topic,
    output_values,
    record_values,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from mcap.records import Schema
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

    from trainid_ros.interface.results import Output

PACKAGE: Final = 'trainid_msgs'  # package of the messages
_FOLDER: Final = Path(__file__).parent / 'msg'
# The messages that ours contain.
_CONTAINED: Final = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
}
_SEPARATOR: Final = '=' * 80 + '\n'
_RULER: Final = re.compile(f'^{_SEPARATOR}', re.MULTILINE)  # a longer one, or one in a comment, separates nothing
_TITLE: Final = re.compile(r'(MSG|IDL):[ \t]*(\S*)[ \t]*(?:\n|$)')
# Strings of wide characters, which rosbags does not know, with two bytes a character in Jazzy or four before.
_WIDE_NAME: Final = 'wide_text/msg/WideText'
WIDE_CHARACTERS: Final = 'wide_characters'  # name of the field that holds a wide string
_WIDE: Final = (f'uint16[] {WIDE_CHARACTERS}', f'uint32[] {WIDE_CHARACTERS}')
_WIDE_FIELD: Final = re.compile(r'^[ \t]*wstring(?:<=\d+)?(\[[^\]]*\])?[ \t]+(\w+)[^\n]*$', re.MULTILINE)
# IDL that rosbags does not read, with a form of the same bytes: includes, wide strings, arrays of many dimensions. Wide
# characters have two or four bytes: they become a type that is not known.
_SAME_IDL: Final = (
    (re.compile(r'^[ \t]*#[^\n]*$', re.MULTILINE), ''),
    (re.compile(r'\bconst\s+wstring\b'), 'const string'),
    (re.compile(r'\bwstring\b(?:\s*<[^>]*>)?'), _WIDE_NAME.replace('/', '::')),
    (re.compile(r'\bwchar\b'), 'wide_text::msg::WideCharacter'),
    (re.compile(r'(?:\[\s*\d+\s*\]\s*){2,}'), lambda found: f'[{math.prod(map(int, re.findall("[0-9]+", found[0])))}]'),
)
_CONSTANT: Final = re.compile(r'^[ \t]*\S+[ \t]+[A-Z][A-Z0-9_]*[ \t]*=[^\n]*$', re.MULTILINE)


def full_type(name: str) -> str:
    """Return the full name of one of our messages, such as ``trainid_msgs/msg/AtoSpeed``."""
    return f'{PACKAGE}/msg/{name}'


@cache
def definition(message: str) -> str:
    """Return the text of the packaged definition of one of our messages, given its short name."""
    return (_FOLDER / f'{message}.msg').read_text(encoding='utf-8')


def fields_of(text: str) -> list[str]:
    """Return the fields in the text of a definition, such as ``float64 speed``, without constants and comments."""
    lines = (' '.join(line.partition('#')[0].split()) for line in text.splitlines())
    return [line for line in lines if line and not _CONSTANT.match(line)]


def is_packaged(text: str, message: str) -> bool:
    """Return whether the text of a definition, followed by those it contains, has the fields of the packaged one.

    Other texts may mean the same: compare their digest.
    """
    return fields_of(text) == fields_of(full_definition(message))


def plain_text(data: bytes) -> str:
    """Return the text of a definition without the line ends and marks of Windows."""
    return data.decode('utf-8', errors='replace').replace('\r\n', '\n').replace('\ufeff', '')


def type_name(name: str) -> str:
    """Return the full name of a type, which may be written without ``msg``."""
    return '/msg/'.join(name.split('/')) if name.count('/') == 1 else name


@cache
def typestore() -> Typestore:
    """Return a typestore of the packaged messages and those they contain."""
    # Imported here because reading a bag rarely needs it.
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    ours = {full_type(path.stem): definition(path.stem) for path in sorted(_FOLDER.glob('*.msg'))}
    contained = {name.replace('/', '/msg/'): text for name, text in _CONTAINED.items()}
    store = get_typestore(Stores.EMPTY)
    for name, text in (contained | ours).items():
        store.register(get_types_from_msg(text, name))
    return store


@cache
def full_definition(message: str) -> str:
    """Return the packaged definition of one of our messages with its comments, followed by those it contains."""
    contained = [f'MSG: {name}\n{text}' for name, text in reversed(_CONTAINED.items())]
    return _SEPARATOR.join((definition(message), *contained))


@cache
def digest(message: str) -> str:
    """Return the RIHS01 digest of one of our messages, given its short name."""
    return str(typestore().hash_rihs01(full_type(message)))


def message_from_record(record: Record) -> Any:
    """Return the message of a record, of the rosbags class of its type; InputError if ROS cannot hold its stamp."""
    return _build(input_topic(record).message, record.stamp_ns, record_values(record))


def estimate_message(output: Output[Any]) -> Any:
    """Return the message of an estimator output, as :func:`message_from_record`."""
    return _build(output_topic(output.estimate).message, output.stamp_ns, output_values(output))


def _build(name: str, stamp_ns: int, values: dict[str, Any]) -> Any:
    types = typestore().types
    sec, nanosec = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= sec < 2**31:  # int32 of builtin_interfaces/Time
        raise InputError(f'stamp {stamp_ns} ns does not fit a ROS time')
    stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='')
    arrays = {key: np.array(value, dtype=np.float64) for key, value in values.items() if isinstance(value, list)}
    return types[full_type(name)](header=header, **(values | arrays))


class StoredType:
    """A message type by the definition that a bag holds; without one it must be a standard type of ROS 2.

    What rosbags does not know but has the same bytes as something else is read as that. A field of an unknown type is
    left out, and so are those after it.
    """

    def __init__(self, path: Path, schema: Schema) -> None:
        """Read the definition; InputError, naming the file, if nothing of it can be read."""
        from rosbags.typesys import Stores, TypesysError, get_typestore  # noqa: PLC0415 - rarely needed

        self.name = type_name(schema.name)
        text = plain_text(schema.data)
        self._is_whole = True
        try:
            if not text.strip():
                self._stores = [_standard()]
            else:
                self._stores = [get_typestore(Stores.EMPTY) for _ in (_WIDE if 'wstring' in text else _WIDE[:1])]
            for store, wide in zip(self._stores, _WIDE, strict=False) if text.strip() else ():
                types = _parse(text, self.name, schema.encoding) | _parse(wide, _WIDE_NAME, 'ros2msg')
                self._is_whole = _complete(types, self.name)
                store.register(types)
            self._stores[0].get_msgdef(self.name)
        except (TypesysError, KeyError) as error:
            raise InputError(
                f'{path}: unreadable definition of {self.name} ({" ".join(str(error).split())[:200]})'
            ) from None

    @property
    def digest(self) -> str:
        """RIHS01 digest of the type."""
        return str(self._stores[0].hash_rihs01(self.name))

    def decode(self, payload: bytes) -> Any:
        """Return a message; SerdeError if it cannot be read."""
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        for store in self._stores[:-1]:
            with suppress(SerdeError):
                return self._decoded(store, payload)
        return self._decoded(self._stores[-1], payload)

    def _decoded(self, store: Typestore, payload: bytes) -> Any:
        from rosbags.serde import SerdeError  # noqa: PLC0415 - rarely needed

        if self._is_whole:
            return store.deserialize_cdr(payload, self.name)
        kind = store.get_msgdef(self.name)
        try:
            decode = kind.deserialize_cdr_le if payload[1] else kind.deserialize_cdr_be
            return decode(payload[4:], 0, kind.cls, store)[0]  # more follows, which is not known
        except (struct.error, ValueError, IndexError) as error:
            raise SerdeError(str(error)) from error


def _parse(text: str, name: str, encoding: str) -> Typesdict:
    """Return the fields by type of a definition, followed by those it contains, in any mix of both languages."""
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg  # noqa: PLC0415 - rarely needed

    types: Typesdict = {}
    for part in _RULER.split(text):
        title = _TITLE.match(part)
        kind, contained = title.groups() if title else ('IDL' if encoding in {'ros2idl', 'omgidl'} else 'MSG', name)
        body = part[title.end() :] if title else part
        if not (title or body.strip()):  # before the first ruler of IDL, or after a last one
            continue
        try:
            if kind == 'IDL':
                for pattern, same in _SAME_IDL:
                    body = pattern.sub(same, body)
                types |= get_types_from_idl(body) if body.strip() else {}
            elif contained:  # rosbag2 writes an empty title before the IDL of a service
                body = _WIDE_FIELD.sub(rf'{_WIDE_NAME}\1 \2', _CONSTANT.sub('', body))
                types |= get_types_from_msg(body, contained)
        except TypesysError:  # costs the fields of this type
            if type_name(contained) == name:
                raise
    return types


def _complete(types: Typesdict, name: str) -> bool:
    """Add the standard types that a type contains, and cut it at the first unknown field.

    Return whether all of it is known; KeyError if nothing is.
    """
    from rosbags.interfaces import Nodetype  # noqa: PLC0415 - rarely needed

    constants, fields = types[name]
    for place, (_, description) in enumerate(fields):
        item: Any = description
        while item[0] in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
            item = item[1][0]
        if item[0] is not Nodetype.NAME:
            continue
        inner = item[1]
        if inner not in types and inner in _standard().fielddefs:
            types[inner] = _standard().fielddefs[inner]
        if inner in types and _complete(types, inner):
            continue
        known = fields[: place + (inner in types and description[0] is Nodetype.NAME)]
        if not known:
            raise KeyError(inner)
        types[name] = constants, known
        return False
    return True


@cache
def _standard() -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - rarely needed

    return get_typestore(Stores.ROS2_JAZZY)


_CDR_START: Final = 4  # bytes; alignment counts from here
_STAMP: Final = np.dtype([('sec', '<i4'), ('nanosec', '<u4'), ('frame', '<u4')])
_ROWS_AT_ONCE: Final = 10_000
# Columns of a table of records, with their types.
_COLUMNS: Final[dict[str, type[np.generic]]] = {
    'log_ns': np.uint64, 'topic': np.int8, 'stamp_ns': np.int64, 'x': np.float64, 'y': np.float64, 'flag': np.bool_,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """The messages of one segment, in the order of the file, without a copy of any of them."""

    data: NDArray[np.uint8]  # The bytes they lie in, shape (m,)
    start: NDArray[np.intp]  # Where their payloads start in ``data``, shape (n,)
    end: NDArray[np.intp]  # Where they end, shape (n,)
    channel: NDArray[np.integer[Any]]  # Numbers of their channels, shape (n,)
    log_ns: NDArray[np.uint64]  # Log times, shape (n,)


class Segment(NamedTuple):
    """A part of a file with messages of needed topics."""

    first_ns: int  # First log time [ns]
    last_ns: int  # Last log time [ns]
    read: Callable[[], MessageBlock]  # Returns its messages; InputError if the file cannot be read any more


@dataclass(frozen=True, slots=True)
class RecordTable:
    """Records of input topics in the order of the log, one row each."""

    log_ns: NDArray[np.uint64]  # Log times, shape (n,)
    topic: NDArray[np.int8]  # Index of the topic in INPUT_TOPICS, shape (n,)
    stamp_ns: NDArray[np.int64]  # Stamps, shape (n,)
    # First number of each record (speed, force, gradient, target acceleration or mass), shape (n,)
    x: NDArray[np.float64]
    y: NDArray[np.float64]  # Second number (position or curve radius), 0 where there is none, shape (n,)
    flag: NDArray[np.bool_]  # Tunnel or emergency, shape (n,)

    def __len__(self) -> int:
        return int(self.log_ns.size)

    def __getitem__(self, rows: slice | NDArray[np.intp]) -> RecordTable:
        """Return some of the rows, in the order given."""
        return RecordTable(*(getattr(self, name)[rows] for name in _COLUMNS))

    def rows(self) -> Iterator[Row]:
        """Yield each row as numbers."""
        columns = (self.topic, self.stamp_ns, self.x, self.y, self.flag)
        for first in range(0, len(self), _ROWS_AT_ONCE):
            yield from zip(*(column[first : first + _ROWS_AT_ONCE].tolist() for column in columns), strict=True)


def table_of(rows: Iterable[tuple[int, Row]]) -> RecordTable:
    """Return the table of rows with their log times [ns]."""
    whole = [(log_ns, *row) for log_ns, row in rows]
    return RecordTable(*(np.array([row[k] for row in whole], kind) for k, kind in enumerate(_COLUMNS.values())))


EMPTY: Final = table_of(())


@cache
def _layout(message: str) -> tuple[int, int]:
    """Return the numbers of floats and flags after the header of an input message, by its packaged definition."""
    kinds = [field.partition(' ')[0] for field in fields_of(definition(message))]
    return kinds.count('float64'), kinds.count('bool')


def values_at(data: bytes | NDArray[np.uint8], at: NDArray[np.intp], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the values that start at each place of a block of bytes, shape (n,)."""
    if not at.size:
        return np.empty(0, dtype=kind)
    everywhere: NDArray[Any] = np.ndarray((len(data) - kind.itemsize + 1,), kind, data, strides=(1,))
    return everywhere[at]


def decode(block: MessageBlock, messages: NDArray[np.intp], topic: int) -> tuple[RecordTable, NDArray[np.bool_]]:
    """Return the table of those messages of one topic that can be read, and which these are, shape (n,).

    The messages are given by their places in the block, shape (n,), the topic by its place in INPUT_TOPICS.
    """
    data, start, end, log_ns = block.data, block.start[messages], block.end[messages], block.log_ns[messages]
    floats, flags = _layout(INPUT_TOPICS[topic].message)
    count = start.size
    stamp_ns, x, y, flag = np.zeros(count, np.int64), np.zeros(count), np.zeros(count), np.zeros(count, np.bool_)
    decoded = np.zeros(count, np.bool_)
    whole = np.flatnonzero(end - start >= _CDR_START + _STAMP.itemsize)
    whole = whole[data[start[whole]] == 0]
    # The second byte gives the byte order.
    for order, (stamp, number) in enumerate(((_STAMP.newbyteorder('>'), np.dtype('>f8')), (_STAMP, np.dtype('<f8')))):
        rows = whole[data[start[whole] + 1] == order]
        when = values_at(data, start[rows] + _CDR_START, stamp)
        body = -(-(_STAMP.itemsize + when['frame'].astype(np.int64)) // 8) * 8
        excess = end[rows] - start[rows] - (_CDR_START + body + 8 * floats + flags)
        fits = (excess >= 0) & (excess <= 3)  # a serializer may pad to a multiple of four bytes
        rows, when, body = rows[fits], when[fits], body[fits]
        first = start[rows] + _CDR_START + body
        x[rows] = values_at(data, first, number)
        if floats > 1:
            y[rows] = values_at(data, first + 8, number)
        if flags:
            flag[rows] = data[first + 8 * floats] != 0
        stamp_ns[rows] = when['sec'].astype(np.int64) * NS_PER_S + when['nanosec']
        decoded[rows] = True
    table = RecordTable(log_ns, np.full(count, topic, np.int8), stamp_ns, x, y, flag)
    return (table if decoded.all() else table[np.flatnonzero(decoded)]), decoded


def joined(tables: Sequence[RecordTable]) -> RecordTable:
    """Return the rows of several tables as one, in the order of log times; on equal times in that of the tables."""
    table = concatenated(tables)
    if bool(np.all(table.log_ns[1:] >= table.log_ns[:-1])):
        return table
    return table[np.argsort(table.log_ns, kind='stable')]


def concatenated(tables: Sequence[RecordTable]) -> RecordTable:
    """Return the rows of several tables as one, in the order of the tables."""
    if len(tables) == 1:
        return tables[0]
    return RecordTable(*(np.concatenate([getattr(table, name) for table in tables]) for name in _COLUMNS))
