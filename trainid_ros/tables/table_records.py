# SPDX-License-Identifier: Apache-2.0
"""From the rows of a table to the records of a train, by a mapping."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import suppress
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.mapping import UNKNOWN_EFFORT, Signal
from trainid_ros.mapping.mapping_file import QUANTITIES
from trainid_ros.mapping.units import find_unit, spelled
from trainid_ros.tables.columns import ROWS_AT_ONCE, Block, Clock, joined, numbers
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from trainid_ros.interface.records import Record
    from trainid_ros.mapping.mapped_inputs import MappedInputs
    from trainid_ros.mapping.mapping import Mapping
    from trainid_ros.tables.columns import Column, Table

CSV_SUFFIXES: Final = ('.csv', '.tsv', '.txt', '.dat', '.log')
_UNIT_SIGNS: Final = {'‰': 'per_mille', '%': 'percent', '°': 'deg', 'm/s²': 'm/s^2', 'km/hr': 'km/h', 'kmh': 'km/h'}
_PARQUET_SUFFIXES: Final = ('.parquet', '.pq')
# Share of the speeds that may have the time of the one before [1].
_MOST_REPEATED: Final = 0.3
# A position at the stamp of a speed must be known before that.
_QUANTITIES: Final = ('position', 'speed', 'force', 'gradient', 'brake_command', 'mass')


class _Feed(NamedTuple):
    """Values of one source of a quantity, or with place -1 of the quantity itself, shape (n,)."""

    quantity: str
    place: int
    values: NDArray[np.float64]


def open_table(path: Path, mapping: Mapping) -> Table:
    """Return the table in a file, by its suffix.

    Raises:
        InputError: There is no such file, or its suffix is not known.
    """
    if not path.is_file():
        raise InputError(f'{path}: is not a file' if path.exists() else f'{path}: no such file')
    # Imported here because Parquet needs an optional package.
    if path.suffix.lower() in CSV_SUFFIXES:
        from trainid_ros.tables.csv_table import CsvTable  # noqa: PLC0415

        return CsvTable(path, mapping.csv)
    if path.suffix.lower() in _PARQUET_SUFFIXES:
        from trainid_ros.tables.parquet_table import ParquetTable  # noqa: PLC0415

        return ParquetTable(path)
    if path.suffix.lower() == '.npz':
        from trainid_ros.tables.npz_table import NpzTable  # noqa: PLC0415

        return NpzTable(path)
    raise InputError(f'{path}: not a table: {", ".join((*CSV_SUFFIXES, *_PARQUET_SUFFIXES, ".npz"))} expected')


class TableRecords:
    """The records of a table, in the order of its rows.

    Attributes:
        rows: Number of rows read.
        blank: Number of rows without a value, by quantity, and without a ``time``; those are left out.
        steps_back: Number of rows that are earlier than one before.
        repeated: Number of speeds at the time of the one before.
        warnings: Where the file states another unit than the mapping.
        unlisted: Number of cells by column and number, where that is not in ``table`` of the mapping.
    """

    def __init__(self, path: Path, inputs: MappedInputs) -> None:
        """Prepare.

        Args:
            path: The file.
            inputs: What makes records; its mapping is one of a table.

        Raises:
            InputError: The file cannot be used.
        """
        self.rows = self.steps_back = 0
        self.blank: Counter[str] = Counter()
        self.warnings: tuple[str, ...] = ()
        self.unlisted: Counter[tuple[str, float]] = Counter()
        self.repeated = 0
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

        Raises:
            InputError: The file cannot be read, or does not fit the mapping.
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
                columns += [(str(source.path[0]), source.unit, QUANTITIES[key][0]) for source in signal.sources]
        for name, unit, quantity in columns:
            stated = self._table.units.get(name, '')
            with suppress(ValueError):
                if (
                    find_unit(spelled(_UNIT_SIGNS.get(stated.lower(), stated), quantity), quantity).factor
                    != unit.factor
                ):
                    yield f'{self._path}: column {shown(name)}: the file says {stated}, the mapping {unit.name}'

    def _check_times(self, stamps: NDArray[np.int64], feeds: list[_Feed], rows: NDArray[np.intp]) -> None:
        """Count speeds at the time of the one before.

        Raises:
            InputError: That is the rule, so the times do not say when a speed was measured.
        """
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
        if self.repeated > _MOST_REPEATED * self._speeds:
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
                made = (
                    self._inputs.add(quantity, index, stamp_ns, value)
                    if index >= 0
                    else self._inputs.put(quantity, stamp_ns, value)
                )
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
