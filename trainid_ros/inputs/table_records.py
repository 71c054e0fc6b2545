# SPDX-License-Identifier: Apache-2.0
"""From the rows of a table to the records of a train, by a mapping."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.inputs.mapping import QUANTITIES, UNKNOWN_EFFORT, Signal, TimeColumn, find_unit, unit_names
from trainid_ros.inputs.tables import ROWS_AT_ONCE, Block, Column, joined, open_table
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.inputs.mapped_inputs import MappedInputs


_UNIT_SIGNS: Final = {'‰': 'per_mille', '%': 'percent', '°': 'deg', 'm/s²': 'm/s^2', 'km/hr': 'km/h', 'kmh': 'km/h'}
# A position at the stamp of a speed must be known before that.
_QUANTITIES: Final = ('position', 'speed', 'force', 'gradient', 'brake_command', 'mass')
_DAY_NS: Final = 86400 * NS_PER_S


class Clock:
    """Turns the times of a table into stamps."""

    def __init__(self, time: TimeColumn) -> None:
        self._start_ns = time.start_ns  # what numbers count from [ns], None if that is not known yet
        self._time = time
        self._midnights = 0
        self._time_of_day_ns = 0

    def stamps(
        self, columns: dict[str, Column], where: object, rows_before: int
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the stamps of rows [ns], shape (n,), and which rows have one, shape (n,).

        ``where`` and ``rows_before`` are for the InputError of a time that ROS cannot hold.
        """
        if self._time.function is None:
            values = columns[self._time.columns[0]]
        else:
            values = self._time.function.of_columns([numbers(columns[name]) for name in self._time.columns])
        known = np.isfinite(values)
        since_ns = self._since_ns(values, known)
        if values.dtype.kind != 'M' and self._start_ns is None and known.any():
            # Times below a year count from the start of a recording, which is put at 2000-01-01 unless it is stated.
            is_relative = abs(int(since_ns[known][0])) < 366 * _DAY_NS
            self._start_ns = 946_684_800 * NS_PER_S if is_relative else 0
        stamps = since_ns + (0 if values.dtype.kind == 'M' else self._start_ns or 0)
        wrong = known & ((stamps <= 0) | (stamps >= 2**31 * NS_PER_S))  # a ROS time holds no later one
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f'{where}: row {rows_before + row + 1}: column {shown(", ".join(self._time.columns))} = {values[row]} '
                'is no time between 1970 and 2038; time: {unit, start} in the mapping may be wrong'
            )
        return stamps, known

    def _since_ns(self, values: Column, known: NDArray[np.bool_]) -> NDArray[np.int64]:
        if values.dtype.kind == 'M':
            return np.where(known, values.astype('datetime64[ns]').astype(np.int64), 0)
        if values.dtype.kind == 'm':
            return self._through_midnight(np.where(known, values.astype('timedelta64[ns]').astype(np.int64), 0), known)
        # A function returns seconds.
        ns = (1.0 if self._time.function is not None else self._time.unit.factor) * NS_PER_S
        limit = 2**61 // round(ns)  # which is no stamp either, and leaves room for a start
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


class _Feed(NamedTuple):
    """Values of one source of a quantity, or with place -1 of the quantity itself, shape (n,)."""

    quantity: str
    place: int
    values: NDArray[np.float64]


class TableRecords:
    """The records of a table, in the order of its rows."""

    def __init__(self, path: Path, inputs: MappedInputs) -> None:
        """Prepare a file for inputs whose mapping is one of a table; InputError if it cannot be used."""
        self.rows = 0  # read so far
        self.steps_back = 0  # rows that are earlier than one before
        self.repeated = 0  # speeds at the time of the one before
        self.blank: Counter[str] = Counter()  # rows without a value by quantity; those without a time are left out
        self.warnings: tuple[str, ...] = ()  # where the file states another unit than the mapping
        self.unlisted: Counter[tuple[str, float]] = Counter()  # cells by column and number, not in ``table``
        self._path, self._inputs, self._mapping = path, inputs, inputs.mapping
        self._table = open_table(path, inputs.mapping)
        if self._mapping.time is None:
            raise InputError(f'{path}: the mapping does not say which column is the time')
        self._time = self._mapping.time
        self._clock = Clock(self._time)
        self._signals = {
            name: signal for name in _QUANTITIES if isinstance(signal := getattr(self._mapping, name), Signal)
        }
        self._held = math.nan
        self._newest_ns = self._speed_ns = 0
        self._speeds = 0
        self._first_repeated = ''
        self._rows_before = 0

    def blocks(self) -> Iterator[tuple[float, list[tuple[int, Record]]]]:
        """Yield blocks of records: the share of the file read for it, and each with the newest stamp of its row [ns].

        InputError if the file cannot be read, or does not fit the mapping.
        """
        functions = (self._time.function, *(signal.function for signal in self._signals.values()))
        sources = chain.from_iterable(signal.sources for signal in self._signals.values())
        names = tuple(dict.fromkeys((*self._time.columns, *(str(source.path[0]) for source in sources))))
        blocks = self._table.blocks(names)
        if any(function is not None for function in functions):  # which sees whole columns
            blocks = iter([Block(joined(blocks, names), 1.0)])
        for block in blocks:
            if not len(block.columns[names[0]]):
                continue
            self.warnings = tuple(self._other_units())
            stamps, known = self._clock.stamps(block.columns, self._path, self.rows)
            self._rows_before = self.rows
            self.rows += len(stamps)
            self.blank['time'] += int(np.count_nonzero(~known))
            feeds = self._all_feeds(block.columns, known)
            rows = np.flatnonzero(known)
            for start in range(0, len(rows), ROWS_AT_ONCE):
                some = rows[start : start + ROWS_AT_ONCE]
                self._check_times(stamps, feeds, some)
                yield block.share * len(some) / len(rows), self._records(stamps, feeds, some)

    def _other_units(self) -> Iterator[str]:
        """Yield a warning for each column of which the file states another unit than the mapping."""
        columns = [(self._time.columns[0], self._time.unit, 'time')] if self._time.function is None else []
        for key, signal in self._signals.items():
            if signal.function is None:
                columns += [(str(source.path[0]), source.unit, QUANTITIES[key].kind) for source in signal.sources]
        for name, unit, quantity in columns:
            stated = self._table.units.get(name, '')
            with suppress(ValueError):
                text = _UNIT_SIGNS.get(stated.lower(), stated)
                # A file may write another case, such as KM/H.
                read = find_unit(next((n for n in unit_names(quantity) if n.lower() == text.lower()), text), quantity)
                if read.factor != unit.factor:
                    yield f'{self._path}: column {shown(name)}: the file says {stated}, the mapping {unit.name}'

    def _check_times(self, stamps: NDArray[np.int64], feeds: list[_Feed], rows: NDArray[np.intp]) -> None:
        """Count speeds at the time of the one before; InputError if they are many: the times are too coarse."""
        speeds = [feed.values for feed in feeds if feed.quantity == 'speed' and feed.place <= 0]
        known = rows[np.isfinite(speeds[0][rows])] if speeds else rows
        repeats = known[np.diff(stamps[known], prepend=self._speed_ns) == 0]
        if not known.size:
            return
        self._speed_ns = int(stamps[known[-1]])
        self._speeds += known.size
        self.repeated += repeats.size
        if repeats.size and not self._first_repeated:
            self._first_repeated = f'row {self._rows_before + int(repeats[0]) + 1}'
        if self.repeated > 0.3 * self._speeds:
            raise InputError(
                f'{self._path}: {self._first_repeated}: column {shown(", ".join(self._time.columns))} has the time of '
                f'the row before, as {self.repeated} of {self._speeds} rows have: its resolution is too coarse for '
                'their rate; take a finer column, or a function for the time'
            )

    def _records(
        self, stamps: NDArray[np.int64], feeds: list[_Feed], rows: NDArray[np.intp]
    ) -> list[tuple[int, Record]]:
        records: list[tuple[int, Record]] = []
        columns = [(feed.quantity, feed.place, feed.values[rows].tolist()) for feed in feeds]
        for place, stamp_ns in enumerate(stamps[rows].tolist()):
            self.steps_back += stamp_ns < self._newest_ns
            # Records are logged in the order of the rows, so that a clock that was set back stays visible.
            self._newest_ns = max(self._newest_ns, stamp_ns)
            for quantity, index, values in columns:
                value = values[place]
                if not (math.isfinite(value) or (quantity == 'brake_command' and value == UNKNOWN_EFFORT)):
                    continue
                if index >= 0:
                    made = self._inputs.add(quantity, index, stamp_ns, value)
                else:
                    made = self._inputs.put(quantity, stamp_ns, value)
                # A sum lacks a value where one of its parts is blank for long.
                records += [(self._newest_ns, record) for record in made if math.isfinite(record.row()[2])]
        return records

    def _all_feeds(self, columns: dict[str, Column], known: NDArray[np.bool_]) -> list[_Feed]:
        feeds = [feed for name, signal in self._signals.items() for feed in self._feeds(name, signal, columns)]
        for feed in feeds:
            if feed.place <= 0:
                blank = ~np.isfinite(feed.values) & (feed.values != UNKNOWN_EFFORT)
                self.blank[feed.quantity] += int(np.count_nonzero(blank & known))
        return feeds

    def _feeds(self, quantity: str, signal: Signal, columns: dict[str, Column]) -> Iterator[_Feed]:
        raw = [numbers(columns[str(source.path[0])]) for source in signal.sources]
        if signal.function is not None:
            yield _Feed(quantity, -1, signal.function.of_columns(raw))
            return
        is_held = self._mapping.on_change and quantity == 'brake_command'
        for index, (source, column) in enumerate(zip(signal.sources, raw, strict=True)):
            cells = self._hold(column) if is_held else column
            values = np.array([source.value(number) for number in cells.tolist()], dtype=np.float64)
            if source.table:
                left_out = column[np.isfinite(column) & np.isnan(values)]
                self.unlisted.update((str(source.path[0]), number) for number in left_out.tolist())
            yield _Feed(quantity, index, values)

    def _hold(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a column in which each blank cell repeats the number before it."""
        whole = np.concatenate(([self._held], column))
        last = np.maximum.accumulate(np.where(np.isnan(whole), 0, np.arange(whole.size)))
        self._held = float(whole[last[-1]])
        return np.asarray(whole[last][1:])
