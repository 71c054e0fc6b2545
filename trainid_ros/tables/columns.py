# SPDX-License-Identifier: Apache-2.0
"""Columns of a table, in blocks of rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.fields import did_you_mean, shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from trainid_ros.mapping.mapping import TimeColumn

Column: TypeAlias = NDArray[Any]
"""Numbers as float64, whole numbers as int64, times as datetime64[ns], or times of day as timedelta64[ns]; NaN or NaT
where a cell is blank."""
ROWS_AT_ONCE: Final = 10_000
_DATE_TIMES: Final = np.dtype('datetime64[ns]')
_DAY_NS: Final = 86400 * NS_PER_S
_YEAR_NS: Final = 366 * 86400 * NS_PER_S
_RELATIVE_START_NS: Final = 946_684_800 * NS_PER_S
"""Where times that count from the start of a recording are put unless the mapping says when that was: 2000-01-01."""
_LAST_NS: Final = 2**31 * NS_PER_S  # a ROS time holds no later one
_MOST_NS: Final = 2**61


@dataclass(frozen=True, slots=True)
class Block:
    """Some rows of a table."""

    columns: dict[str, Column]  # Columns by name, each of shape (n,)
    share: float  # Share of the file that was read for them [1]


class Table(Protocol):
    """A file with columns."""

    units: dict[str, str]  # Units that the file states, by column; known once a block is read

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield the columns of these names, rows in their order.

        Raises:
            InputError: The file cannot be read or a column is missing; the error names file, column and row.
        """


def check_columns(where: object, wanted: Iterable[str], known: Sequence[str]) -> None:
    """Raise InputError for the first wanted column that is not among the known ones, or is there twice."""
    for name in wanted:
        if known.count(name) > 1:
            raise InputError(f'{where}: column {shown(name)} is there {known.count(name)} times')
        if name not in known:
            columns = ', '.join(map(shown, known[:20])) + (', ...' if len(known) > 20 else '')
            hint = did_you_mean(name, known) if known else ''
            hint = f'; {hint}' if hint.startswith('did') else ''
            raise InputError(f'{where}: no column {shown(name)}{hint} (columns: {columns or "none"})')


def joined(blocks: Iterable[Block], names: Iterable[str]) -> dict[str, Column]:
    """Return the columns of all blocks."""
    found = [block.columns for block in blocks]
    return {name: np.concatenate([columns[name] for columns in found]) if found else np.empty(0) for name in names}


class Clock:
    """Turns the times of a table into stamps.

    Attributes:
        start_ns: What numbers count from [ns]; None before the first one.
    """

    def __init__(self, time: TimeColumn) -> None:
        self.start_ns = time.start_ns
        self._time = time
        self._midnights = 0
        self._time_of_day_ns = 0

    def stamps(
        self, columns: dict[str, Column], where: object, rows_before: int
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the stamps of rows [ns], shape (n,), and which rows have one, shape (n,).

        Args:
            columns: Columns of the time, each of shape (n,).
            where: The file, for errors.
            rows_before: Number of rows before these.

        Raises:
            InputError: ROS cannot hold a time.
        """
        values = self._values(columns)
        known = np.isfinite(values)
        since_ns = self._since_ns(values, known)
        if values.dtype.kind != 'M' and self.start_ns is None and known.any():
            relative = abs(int(since_ns[known][0])) < _YEAR_NS
            self.start_ns = _RELATIVE_START_NS if relative else 0
        stamps = since_ns + (0 if values.dtype.kind == 'M' else self.start_ns or 0)
        wrong = known & ((stamps <= 0) | (stamps >= _LAST_NS))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f'{where}: row {rows_before + row + 1}: column {shown(", ".join(self._time.columns))} = {values[row]} '
                'is no time between 1970 and 2038; time: {unit, start} in the mapping may be wrong'
            )
        return stamps, known

    def _values(self, columns: dict[str, Column]) -> Column:
        """Return the times of rows as they are in the file, or as the function of the mapping makes them."""
        if self._time.function is None:
            return columns[self._time.columns[0]]
        return self._time.function.of_columns([numbers(columns[name]) for name in self._time.columns])

    def _since_ns(self, values: Column, known: NDArray[np.bool_]) -> NDArray[np.int64]:
        if values.dtype.kind == 'M':
            return np.where(known, values.astype(_DATE_TIMES).astype(np.int64), 0)
        if values.dtype.kind == 'm':
            return self._through_midnight(np.where(known, values.astype('timedelta64[ns]').astype(np.int64), 0), known)
        # A function returns seconds.
        ns = (1.0 if self._time.function is not None else self._time.unit.factor) * NS_PER_S
        limit = _MOST_NS // round(ns)
        if values.dtype.kind == 'i':
            return np.asarray(np.clip(values, -limit, limit) * round(ns))
        return np.rint(np.clip(np.where(known, values, 0.0), -limit, limit) * ns).astype(np.int64)

    def _through_midnight(self, since_ns: NDArray[np.int64], known: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return times of day as times since the first midnight [ns]; a step back by half a day is another midnight."""
        times = since_ns[known]
        passed = np.diff(times, prepend=self._time_of_day_ns) < -_DAY_NS // 2
        days = self._midnights + np.cumsum(passed)
        if times.size:
            self._time_of_day_ns, self._midnights = int(times[-1]), int(days[-1])
        since_ns[known] = times + _DAY_NS * days
        return since_ns


def numbers(column: Column) -> NDArray[np.float64]:
    """Return a column as numbers; times in seconds since 1970, times of day since midnight."""
    if column.dtype.kind not in {'M', 'm'}:
        return np.asarray(column, dtype=np.float64)
    seconds = column.astype(f'{column.dtype.kind}8[ns]').astype(np.int64) / NS_PER_S
    return np.where(np.isnat(column), np.nan, seconds)
