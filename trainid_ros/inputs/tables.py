# SPDX-License-Identifier: Apache-2.0
"""The rows of a table as the records of a train, by a mapping."""

from __future__ import annotations

import math
import re
from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.mapping import QUANTITIES, UNKNOWN_EFFORT, Source, TimeColumn
from trainid_ros.inputs.table_files import ROWS_AT_ONCE, Block, Column, joined, open_table
from trainid_ros.inputs.times import CLOCK, EXCEL, LocalClock
from trainid_ros.inputs.units import unit_factors, written_unit
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import DAY_NS, NS_PER_S, Record
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from trainid_ros.inputs.mapped_inputs import MappedInputs


class Clock:
    """Turns the times of a table into stamps."""

    def __init__(self, time: TimeColumn) -> None:
        self._start_ns = time.start_ns  # what numbers count from [ns], None if that is not known yet
        self._time = time
        self._local = LocalClock(time.zone)
        self._periods = 0  # days, or hours of a clock without them, that are over
        self._time_of_day_ns = 0

    def stamps(
        self, columns: dict[str, Column], where: object, rows_before: int, *, has_zone: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the stamps of rows [ns], shape (n,), and which rows have one, shape (n,).

        ``where`` and ``rows_before`` are for the InputError of a time that ROS cannot hold, or that may be several.
        With ``has_zone`` dates with time are in UTC.
        """
        place = f'column {shown(", ".join(self._time.columns))}'
        if self._time.function is None:
            clock, *dates = (columns[name] for name in self._time.columns)
            form = '' if dates and '%' in self._time.format else self._time.format
            values = _of_form(clock, form, f'{where}: {place}')
            for day in dates:
                if not (_are(values, 'm') and _are(day, 'M')):
                    raise InputError(f'{where}: {place}: time: {{field, date}} must be times of day and dates')
                values = np.asarray(day.astype('datetime64[D]') + values.astype('timedelta64[ns]'))
        else:
            values = self._time.function.of_columns([numbers(columns[name]) for name in self._time.columns])
        known = np.isfinite(values)
        since_ns = self._since_ns(values, known)
        if values.dtype.kind != 'M' and self._start_ns is None and known.any():
            # Times below a year count from the start of a recording, which is put at 2000-01-01 unless it is stated.
            is_relative = abs(int(since_ns[known][0])) < 366 * DAY_NS
            self._start_ns = 946_684_800 * NS_PER_S if is_relative else 0
        stamps = since_ns + (0 if values.dtype.kind == 'M' else self._start_ns or 0)
        wrong = known & ((stamps <= 0) | (stamps >= 2**31 * NS_PER_S))  # a ROS time holds no later one
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f'{where}: row {rows_before + row + 1}: {place} = {values[row]} '
                'is no time between 1970 and 2038; time: {unit, start} in the mapping may be wrong'
            )
        is_zoned = self._time.zone is not None and self._time.start_ns is not None
        if is_zoned or (values.dtype.kind == 'M' and not has_zone):
            rows = np.flatnonzero(known)
            stamps[rows] = self._local.utc(stamps[rows], lambda i: f'{where}: row {rows_before + rows[i] + 1}: {place}')
        return stamps, known

    def _since_ns(self, values: Column, known: NDArray[np.bool_]) -> NDArray[np.int64]:
        if values.dtype.kind == 'M':
            return np.where(known, values.astype('datetime64[ns]').astype(np.int64), 0)
        if values.dtype.kind == 'm':
            return self._through_periods(np.where(known, values.astype('timedelta64[ns]').astype(np.int64), 0), known)
        # A function returns seconds.
        ns = (1.0 if self._time.function is not None else self._time.unit.factor) * NS_PER_S
        limit = 2**61 // round(ns)  # which is no stamp either, and leaves room for a start
        if values.dtype.kind == 'i':
            return np.asarray(np.clip(values, -limit, limit) * round(ns))
        return np.rint(np.clip(np.where(known, values, 0.0), -limit, limit) * ns).astype(np.int64)

    def _through_periods(self, since_ns: NDArray[np.int64], known: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return times of day as times since the first midnight [ns]; a step back by half a day is another midnight.

        Where the form has minutes and no hour, the same holds of hours.
        """
        form = self._time.format
        period_ns = 3600 * NS_PER_S if '%M' in form and '%H' not in form and '%I' not in form else DAY_NS
        times = since_ns[known]
        passed = np.diff(times, prepend=self._time_of_day_ns) < -period_ns // 2
        periods = self._periods + np.cumsum(passed)
        if times.size:
            self._time_of_day_ns, self._periods = int(times[-1]), int(periods[-1])
        since_ns[known] = times + period_ns * periods
        return since_ns


def _are(times: Column, kind: str) -> bool:
    """Return whether times are of a kind; blank cells alone are numbers, which are NaN."""
    return times.dtype.kind == kind or bool(times.dtype.kind == 'f' and np.isnan(times).all())


def _of_form(values: Column, form: str, where: str) -> Column:
    """Return numbers of a form as times; other columns as they are."""
    if not form or values.dtype.kind in 'mM':
        return values
    if form == EXCEL:
        days = np.asarray(values, dtype=np.float64) - 25569.0  # 1970-01-01
        return np.where(np.isnan(days), np.nan, np.rint(days * DAY_NS)).astype('datetime64[ns]')
    if form != CLOCK:
        raise InputError(f'{where} holds numbers, and time.format = {shown(form)} in the mapping is one of texts')
    minutes, hours = values // 100 % 100, values // 10_000
    if np.any((values < 0) | (hours > 23) | (minutes > 59) | (values % 100 >= 61)):
        raise InputError(f'{where} holds numbers that are no times like {CLOCK}')
    seconds = values % 100 + 60.0 * minutes + 3600.0 * hours
    return np.where(np.isnan(seconds), np.nan, np.rint(seconds * NS_PER_S)).astype('timedelta64[ns]')


def numbers(column: Column) -> NDArray[np.float64]:
    """Return a column as numbers; times in seconds since 1970, times of day since midnight."""
    if column.dtype.kind not in {'M', 'm'}:
        return np.asarray(column, dtype=np.float64)
    seconds = column.astype(f'{column.dtype.kind}8[ns]').astype(np.int64) / NS_PER_S
    return np.where(np.isnat(column), np.nan, seconds)


_Feed: TypeAlias = tuple[str, int, NDArray[np.float64]]
"""Quantity, place of a source of it, or -1 for the quantity itself, and values, shape (n,)."""


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
        signals = self._mapping.signals
        # A position at the stamp of a speed must be known before that.
        self._signals = {name: signals[name] for name in ('position', *signals) if name in signals}
        # Numbers that hold no value.
        self._codes = [float(x) for x in self._mapping.missing if re.fullmatch(r'[+-]?\d+(\.\d*)?', x)]
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
        names = tuple(dict.fromkeys((*self._time.columns, *(source.field for source in sources))))
        blocks = self._table.blocks(names)
        if any(function is not None for function in functions):  # which sees whole columns
            blocks = iter([Block(joined(blocks, names), 1.0)])
        for block in blocks:
            if not len(block.columns[names[0]]):
                continue
            self.warnings = tuple(self._other_units())
            text = self._table.times.get(self._time.columns[0])
            has_zone = text is not None and text.has_zone
            stamps, known = self._clock.stamps(block.columns, self._path, self.rows, has_zone=has_zone)
            self._rows_before = self.rows
            self.rows += len(stamps)
            self.blank['time'] += int(np.count_nonzero(~known))
            feeds = self._feeds(block.columns, known)
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
                columns += [(source.field, source.unit, QUANTITIES[key].kind) for source in signal.sources]
        for name, unit, quantity in columns:
            stated = self._table.units.get(name, '')
            read = unit_factors(quantity).get(written_unit(stated, quantity))
            if read is not None and read != unit.factor:
                yield f'{self._path}: column {shown(name)}: the file says {stated}, the mapping {unit.name}'

    def _check_times(self, stamps: NDArray[np.int64], feeds: list[_Feed], rows: NDArray[np.intp]) -> None:
        """Count speeds at the time of the one before; InputError if they are many: the times are too coarse."""
        speeds = [values for quantity, place, values in feeds if quantity == 'speed' and place <= 0]
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
        columns = [(quantity, place, values[rows].tolist()) for quantity, place, values in feeds]
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

    def _feeds(self, columns: dict[str, Column], known: NDArray[np.bool_]) -> list[_Feed]:
        feeds: list[_Feed] = []
        for quantity, signal in self._signals.items():
            raw = [numbers(columns[source.field]) for source in signal.sources]
            if self._codes:
                raw = [np.where(np.isin(column, self._codes), np.nan, column) for column in raw]
            if signal.function is not None:
                made = [(quantity, -1, signal.function.of_columns(raw))]
            else:
                pairs = enumerate(zip(signal.sources, raw, strict=True))
                made = [(quantity, index, self._values(quantity, *pair)) for index, pair in pairs]
            first = made[0][2]
            blank = ~np.isfinite(first) & (first != UNKNOWN_EFFORT)
            self.blank[quantity] += int(np.count_nonzero(blank & known))
            feeds += made
        return feeds

    def _values(self, quantity: str, source: Source, column: NDArray[np.float64]) -> NDArray[np.float64]:
        cells = self._hold(column) if self._mapping.on_change and quantity == 'brake_command' else column
        values = np.array([source.value(number) for number in cells.tolist()], dtype=np.float64)
        if source.table:
            left_out = column[np.isfinite(column) & np.isnan(values)]
            self.unlisted.update((source.field, number) for number in left_out.tolist())
        return values

    def _hold(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a column in which each blank cell repeats the number before it."""
        whole = np.concatenate(([self._held], column))
        last = np.maximum.accumulate(np.where(np.isnan(whole), 0, np.arange(whole.size)))
        self._held = float(whole[last[-1]])
        return np.asarray(whole[last][1:])
