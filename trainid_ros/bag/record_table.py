# SPDX-License-Identifier: Apache-2.0
"""Input messages of a chunk as columns: decoded all at once instead of one by one.

The payload of every input message is CDR: four bytes that give the byte order, then the header (stamp, frame) and then
its numbers, each float64 on a multiple of eight bytes, followed by at most one flag.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.bag.record_file import values_at
from trainid_ros.bag.types import definition, fields_of
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from trainid_ros.interface.records import Row

Bytes = NDArray[np.uint8]
Places = NDArray[np.intp]

_CDR_START: Final = 4  # alignment counts from here
_STAMP: Final = np.dtype([('sec', '<i4'), ('nanosec', '<u4'), ('frame', '<u4')])
_NUMBER: Final = np.dtype('<f8')
_FORMS: Final = ((_STAMP.newbyteorder('>'), _NUMBER.newbyteorder('>')), (_STAMP, _NUMBER))
"""Types of stamps and numbers by the second byte, which gives the byte order."""
# A serializer may pad to a multiple of four bytes.
_MAX_PADDING: Final = 3
_ROWS_AT_ONCE: Final = 10_000


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """The messages of one segment, in the order of the file, without a copy of any of them."""

    data: Bytes  # The bytes they lie in, shape (m,)
    start: Places  # Where their payloads start in ``data``, shape (n,)
    end: Places  # Where they end, shape (n,)
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
        """Return the number of rows."""
        return int(self.log_ns.size)

    def __getitem__(self, rows: slice | NDArray[np.intp]) -> RecordTable:
        """Return some of the rows, in the order given."""
        return RecordTable(
            self.log_ns[rows], self.topic[rows], self.stamp_ns[rows], self.x[rows], self.y[rows], self.flag[rows]
        )

    def rows(self) -> Iterator[Row]:
        """Yield each row as numbers."""
        columns = (self.topic, self.stamp_ns, self.x, self.y, self.flag)
        for first in range(0, len(self), _ROWS_AT_ONCE):
            yield from zip(*(column[first : first + _ROWS_AT_ONCE].tolist() for column in columns), strict=True)


def table_of(rows: Sequence[tuple[int, Row]]) -> RecordTable:
    """Return the table of rows with their log times [ns]."""
    log_ns, numbers = [log for log, _ in rows], [row for _, row in rows]
    topic, stamp_ns, x, y, flag = zip(*numbers, strict=True) if numbers else ((),) * 5
    return RecordTable(
        np.array(log_ns, np.uint64),
        np.array(topic, np.int8),
        np.array(stamp_ns, np.int64),
        np.array(x, np.float64),
        np.array(y, np.float64),
        np.array(flag, np.bool_),
    )


EMPTY: Final = RecordTable(
    np.empty(0, np.uint64), np.empty(0, np.int8), np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0, np.bool_)
)


@dataclass(frozen=True, slots=True)
class Layout:
    """Fields of an input message after its header: numbers, then flags."""

    floats: int
    flags: int


@cache
def layout(message: str) -> Layout:
    """Return the layout of an input message, given its short type name, from its packaged definition."""
    kinds = [field.partition(' ')[0] for field in fields_of(definition(message))]
    expected = ['std_msgs/Header', *['float64'] * kinds.count('float64'), *['bool'] * kinds.count('bool')]
    if kinds != expected or not 1 <= kinds.count('float64') <= 2 or kinds.count('bool') > 1:
        raise ValueError(f'{message}.msg: a header, one or two float64 and at most one bool expected, {kinds} found')
    return Layout(kinds.count('float64'), kinds.count('bool'))


def decode(
    data: Bytes, start: Places, end: Places, log_ns: NDArray[np.uint64], topic: int
) -> tuple[RecordTable, NDArray[np.bool_]]:
    """Return the table of those messages of one topic that can be read, and which these are, shape (n,).

    Args:
        data: The bytes that the messages lie in.
        start: Where their payloads start, shape (n,).
        end: Where they end, shape (n,).
        log_ns: Log times, shape (n,).
        topic: Index of the topic in INPUT_TOPICS.
    """
    form, count = layout(INPUT_TOPICS[topic].message), start.size
    stamp_ns, x, y, flag = np.zeros(count, np.int64), np.zeros(count), np.zeros(count), np.zeros(count, np.bool_)
    decoded = np.zeros(count, np.bool_)
    whole = np.flatnonzero(end - start >= _CDR_START + _STAMP.itemsize)
    whole = whole[data[start[whole]] == 0]
    for order, (stamp, number) in enumerate(_FORMS):
        rows = whole[data[start[whole] + 1] == order]
        when = values_at(data, start[rows] + _CDR_START, stamp)
        body = -(-(_STAMP.itemsize + when['frame'].astype(np.int64)) // 8) * 8
        excess = end[rows] - start[rows] - (_CDR_START + body + 8 * form.floats + form.flags)
        fits = (excess >= 0) & (excess <= _MAX_PADDING)
        rows, when, body = rows[fits], when[fits], body[fits]
        first = start[rows] + _CDR_START + body
        x[rows] = values_at(data, first, number)
        if form.floats > 1:
            y[rows] = values_at(data, first + 8, number)
        if form.flags:
            flag[rows] = data[first + 8 * form.floats] != 0
        stamp_ns[rows] = when['sec'].astype(np.int64) * NS_PER_S + when['nanosec']
        decoded[rows] = True
    table = RecordTable(log_ns, np.full(count, topic, np.int8), stamp_ns, x, y, flag)
    return (table if decoded.all() else table[np.flatnonzero(decoded)]), decoded


def in_order_of(places: Places, tables: Sequence[RecordTable]) -> RecordTable:
    """Return the rows of several tables by their places in a file, one for each row, shape (n,)."""
    return _concatenated(tables)[np.argsort(places)]


def joined(tables: Sequence[RecordTable]) -> RecordTable:
    """Return the rows of several tables as one, in the order of log times; on equal times in that of the tables."""
    table = _concatenated(tables)
    if bool(np.all(table.log_ns[1:] >= table.log_ns[:-1])):
        return table
    return table[np.argsort(table.log_ns, kind='stable')]


def _concatenated(tables: Sequence[RecordTable]) -> RecordTable:
    if len(tables) == 1:
        return tables[0]
    names = ('log_ns', 'topic', 'stamp_ns', 'x', 'y', 'flag')
    return RecordTable(*(np.concatenate([getattr(table, name) for table in tables]) for name in names))
