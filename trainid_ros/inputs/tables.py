# SPDX-License-Identifier: Apache-2.0
"""Tables in files, in blocks of rows: CSV as loggers write it, Parquet and npz; their records, by a mapping."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias
from zipfile import BadZipFile, is_zipfile

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.mapping import (
    QUANTITIES,
    UNKNOWN_EFFORT,
    CsvFormat,
    Mapping,
    Source,
    TimeColumn,
    date_time_ns,
    find_unit,
    time_of_day_ns,
    unit_factors,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.train.fields import did_you_mean, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    import pyarrow as pa

    from trainid_ros.inputs.mapped_inputs import MappedInputs

Column: TypeAlias = NDArray[Any]
"""Numbers as float64, whole numbers as int64, times as datetime64[ns], times of day and durations as timedelta64[ns];
NaN or NaT where a cell is blank."""
ROWS_AT_ONCE: Final = 10_000
CSV_SUFFIXES: Final = ('.csv', '.tsv', '.txt', '.dat', '.log')
_PARQUET_SUFFIXES: Final = ('.parquet', '.pq')


@dataclass(frozen=True, slots=True)
class Block:
    """Some rows of a table."""

    columns: dict[str, Column]  # Columns by name, each of shape (n,)
    share: float  # Share of the file that was read for them [1]


class Table(ABC):
    """A file with columns."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.units: dict[str, str] = {}  # that the file states, by column; known once a block is read

    @abstractmethod
    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield the columns of these names; InputError, naming file, column and row, if they cannot be read."""


def open_table(path: Path, mapping: Mapping) -> Table:
    """Return the table in a file, by its suffix; InputError if there is no such file, or the suffix is not known."""
    if not path.is_file():
        raise InputError(f'{path}: is not a file' if path.exists() else f'{path}: no such file')
    suffix = path.suffix.lower()
    if suffix in CSV_SUFFIXES:
        return CsvTable(path, mapping.csv)
    if suffix in _PARQUET_SUFFIXES:
        return ParquetTable(path)
    if suffix == '.npz':
        return NpzTable(path)
    raise InputError(f'{path}: not a table: {", ".join((*CSV_SUFFIXES, *_PARQUET_SUFFIXES, ".npz"))} expected')


def joined(blocks: Iterable[Block], names: Iterable[str]) -> dict[str, Column]:
    """Return the columns of all blocks; blank cells are NaN in a block without times, NaT beside times."""
    found, whole = list(blocks), {}
    for name in names:
        parts = [block.columns[name] for block in found]
        if times := [part.dtype for part in parts if part.dtype.kind in 'mM']:
            blank = np.array('NaT', times[0])
            parts = [
                np.full(len(part), blank) if part.dtype.kind == 'f' and np.isnan(part).all() else part for part in parts
            ]
        whole[name] = np.concatenate(parts) if parts else np.empty(0)
    return whole


def _check_columns(path: Path, wanted: Iterable[str], known: Sequence[str]) -> None:
    for name in wanted:
        if known.count(name) > 1:
            raise InputError(f'{path}: column {shown(name)} is there {known.count(name)} times')
        if name not in known:
            columns = ', '.join(map(shown, known[:20])) + (', ...' if len(known) > 20 else '')
            hint = did_you_mean(name, known) if known else ''
            hint = f'; {hint}' if hint.startswith('did') else ''
            raise InputError(f'{path}: no column {shown(name)}{hint} (columns: {columns or "none"})')


_BLANK: Final = frozenset({'', '-', '--', 'na', 'n/a', '#n/a', 'nan', 'null', 'none'})
_EXCEL_ERROR: Final = re.compile(r'#(nv|n/d|\S+[!?])')  # such as #DIV/0!; #N/A in other languages
# Numbers with thousands marks by decimal sign: point, comma, apostrophe or space before each three digits.
_GROUPED: Final = {
    decimal: re.compile(
        rf"[+-]?[1-9]\d{{0,2}}([{other}'\u2019\u00a0\u202f ])\d{{3}}(\1\d{{3}})*({re.escape(decimal)}\d*)?"
    )
    for decimal, other in (('.', ','), (',', '.'))
}
_LIKE: Final = '2024-03-08T12:00:00, 08.03.2024 12:00:00 or 12:00:00'
_WHOLE: Final = re.compile(r'[+-]?(\d{1,18}|1\d{18})')  # of 64 bits


def _is_blank(cell: str) -> bool:
    text = cell.strip().lower()
    return text in _BLANK or _EXCEL_ERROR.fullmatch(text) is not None


def _number(cell: str, decimal: str) -> float | None:
    """Return the number in a cell, NaN if it is blank, None if it holds something else."""
    text = cell.strip().replace('\u2212', '-')  # the minus sign of Unicode
    if _is_blank(text):
        return math.nan
    if grouped := _GROUPED[decimal].fullmatch(text):
        text = text.replace(grouped[1], '')
    # float() would take a point for the decimal sign, and underscores.
    if (decimal == ',' and '.' in text) or '_' in text:
        return None
    try:
        return float(text.replace(decimal, '.'))
    except ValueError:
        return {'true': 1.0, 'false': 0.0}.get(text.lower())


def _is_value(cell: str) -> bool:
    text = cell.strip()
    found = (date_time_ns(text), time_of_day_ns(text), *(_number(text, decimal) for decimal in _GROUPED))
    return not _is_blank(text) and any(value is not None for value in found)


def _times(cells: Sequence[str], where: Callable[[int], str], hint: str = '') -> Column | None:
    """Return the times in texts, by the kind of the first, None if that is no time.

    InputError, naming ``where`` by index, for a later cell that is no such time.
    """
    first = next((cell.strip() for cell in cells if not _is_blank(cell)), '')
    for of_text, kind, what in (
        (date_time_ns, 'datetime64[ns]', 'date with time'),
        (time_of_day_ns, 'timedelta64[ns]', 'time of day'),
    ):
        if of_text(first) is None:
            continue
        stamps = [None if _is_blank(cell) else of_text(cell.strip()) for cell in cells]
        for index, (cell, stamp) in enumerate(zip(cells, stamps, strict=True)):
            if stamp is None and not _is_blank(cell):
                raise InputError(f'{where(index)} = {shown(cell)} is not a {what}{hint}')
        return np.array(['NaT' if stamp is None else stamp for stamp in stamps], dtype=kind)
    return None


_COMMENT: Final = '#'


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a file is written: encoding, separator, number of its columns, those read, and rows before the numbers."""

    encoding: str
    separator: str
    width: int
    places: tuple[int, ...]
    skipped: int


class CsvTable(Table):
    """A CSV file; comments, and whatever stands above the names of the columns, are skipped.

    The names that the mapping gives show the separator and the row of the names. The decimal sign is that of the first
    number in the file which only one sign explains.
    """

    def __init__(self, path: Path, form: CsvFormat) -> None:
        super().__init__(path)
        self._form = form

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        layout = self._layout(names)
        decimal = self._form.decimal or self._decimal(layout)
        for lines, cells, share in self._rows(layout):
            columns = zip(names, zip(*cells, strict=True), strict=True)
            yield Block({name: self._column(name, lines, column, decimal) for name, column in columns}, share)

    def _rows(self, layout: _Layout) -> Iterator[tuple[Sequence[int], Sequence[Sequence[str]], float]]:
        """Yield blocks of the rows below the names: line numbers, cells of the columns, share of the file read."""
        size, reached = max(1, self.path.stat().st_size), 0
        with self.path.open('rb') as raw, io.TextIOWrapper(raw, layout.encoding, errors='replace', newline='') as text:
            reader = csv.reader(text, delimiter=layout.separator)
            full = ((reader.line_num, row) for row in self._closed(reader, layout) if any(map(str.strip, row)))
            data = (item for item in full if not self._is_comment(item[1]) or self._holds_numbers(*item, layout.places))
            rows = islice(data, layout.skipped, None)
            try:
                while some := list(islice(rows, ROWS_AT_ONCE)):
                    lines, cells = zip(*((line, self._cells(line, row, layout)) for line, row in some), strict=True)
                    before, reached = reached, raw.tell()
                    yield lines, cells, (reached - before) / size
            except csv.Error as error:
                raise InputError(f'{self.path}: line {reader.line_num}: {error}') from None

    def _closed(self, reader: Any, layout: _Layout) -> Iterator[list[str]]:
        """Yield the rows; InputError for a text in quotes that holds whole rows: its second quote is missing."""
        before, others = 0, layout.width - 1
        for row in reader:
            if reader.line_num > before + 1:
                inside = [line for cell in row for line in cell.splitlines()[1:]]
                if others and any(line.count(layout.separator) >= others for line in inside):
                    raise InputError(
                        f'{self.path}: lines {before + 1} to {reader.line_num} are one row by their quotes: one is not '
                        'closed'
                    )
            before = reader.line_num
            yield row

    def _cells(self, line: int, row: list[str], layout: _Layout) -> list[str]:
        """Return the cells of the columns in a row, blank where it ends early."""
        # No one can say which of more cells than names belongs to which.
        if len(row) > layout.width and any(map(str.strip, row[layout.width :])):
            raise InputError(
                f'{self.path}: line {line} has {len(row)} cells, {layout.width} columns have names; a text with the '
                f'separator {layout.separator!r} must be in quotes'
            )
        return [row[place] if place < len(row) else '' for place in layout.places]

    def _is_comment(self, row: list[str]) -> bool:
        return self._form.comments is not False and row[0].startswith(_COMMENT) and not _is_blank(row[0])

    def _holds_numbers(self, line: int, row: list[str], places: Sequence[int]) -> bool:
        """Return False for a comment; one with numbers where they are read is an error until the mapping says so."""
        cells = [row[place] for place in places if place < len(row)]
        is_data = any(map(_is_value, cells)) and all(_is_value(cell) or _is_blank(cell) for cell in cells)
        if self._form.comments is None and is_data:
            raise InputError(
                f'{self.path}: line {line} starts with {shown(row[0])} like a comment, but holds numbers; '
                'csv: {comments: true} in the mapping leaves such rows out, {comments: false} reads them'
            )
        return False

    def _layout(self, names: Sequence[str]) -> _Layout:
        with self.path.open('rb') as file:
            head = file.read(1 << 18)
        encoding = self._form.encoding or _encoding(head)
        separators = (self._form.separator,) if self._form.separator else (';', '\t', ',', '|')
        separator, rows, place = _find_names(head.decode(encoding, errors='replace'), separators, names)
        known = _names(rows[place]) if rows else []
        _check_columns(self.path, names, known)
        above = sum(not self._is_comment(row) for row in rows[:place])
        places = tuple(known.index(name) for name in names)
        below = [row for row in rows[place:] if not self._is_comment(row)]
        cells = [[row[i] if i < len(row) else '' for i in places] for row in below]
        named = int(not self._is_comment(rows[place]))
        if below[named:] and not any(_is_value(cell) for row in cells[named:] for cell in row):
            raise InputError(f'{self.path}: no numbers below the names of its columns {", ".join(map(shown, names))}')
        skipped = self._form.header_rows or named + _unit_rows(cells[named:])
        for row in ([*map(_in_brackets, names)], *cells[named:skipped]):
            self.units |= {name: cell.strip(' []()') for name, cell in zip(names, row, strict=True) if cell.strip()}
        return _Layout(encoding, separator, len(known), places, above + skipped)

    def _decimal(self, layout: _Layout) -> str:
        """Return the decimal sign of a file; InputError where a comma may also mark thousands."""
        unclear = ''
        for _, rows, _ in self._rows(layout):
            for cell in (cell.strip() for row in rows for cell in row if ',' in cell or '.' in cell):
                with_comma, with_point = _number(cell, ','), _number(cell, '.')
                if (with_comma is None) != (with_point is None):
                    return '.' if with_comma is None else ','
                if with_comma is not None and ',' in cell:
                    unclear = unclear or cell
        if unclear:
            raise InputError(
                f'{self.path}: {shown(unclear)} may be {_number(unclear, ",")} or {_number(unclear, ".")}: a comma '
                'before three digits in every cell that has one; csv: {decimal: ","} or {decimal: "."} in the mapping '
                'says which'
            )
        return '.'

    def _column(self, name: str, lines: Sequence[int], cells: Sequence[str], decimal: str) -> Column:
        if all(map(_WHOLE.fullmatch, cells)):
            return np.array([int(cell) for cell in cells], dtype=np.int64)
        if (decimal == '.' or not any('.' in cell for cell in cells)) and not any('_' in cell for cell in cells):
            with suppress(ValueError):
                return np.array([float(cell.replace(decimal, '.')) for cell in cells], dtype=np.float64)

        def where(index: int) -> str:
            return f'{self.path}: line {lines[index]}: column {shown(name)}'

        footer = '; lines of text below the numbers must go, or start with #'
        if (times := _times(cells, where, footer)) is not None:
            return times
        values = [_number(cell, decimal) for cell in cells]
        if None in values:
            cell = cells[index := values.index(None)]
            problem = f'is not a number with the decimal sign {decimal!r}; csv: {{separator, decimal, header_rows}} in '
            problem += f'the mapping says how the file is written{footer}'
            raise InputError(f'{where(index)} = {shown(cell)} {f"is no time like {_LIKE}" if ":" in cell else problem}')
        return np.array(values, dtype=np.float64)


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return 'utf-16'
    try:
        codecs.getincrementaldecoder('utf-8')().decode(head)
    except UnicodeDecodeError:
        return 'cp1252'  # latin-1 with what Windows adds
    return 'utf-8-sig'


def _find_names(text: str, separators: Sequence[str], names: Sequence[str]) -> tuple[str, list[list[str]], int]:
    """Return separator, first rows, and the place of the one with most of the names, or else with most cells."""
    best: tuple[int, int, str, list[list[str]], int] = (-1, 0, separators[0], [], 0)
    for separator in separators:
        rows: list[list[str]] = []
        with suppress(csv.Error):  # where the text is cut off
            reader = csv.reader(io.StringIO(text, newline=''), delimiter=separator)
            rows.extend(islice((row for row in reader if any(map(str.strip, row))), 200))
        for place, row in enumerate(rows):
            found = sum(name in _names(row) for name in names)
            if (found, len(row)) > best[:2]:
                best = found, len(row), separator, rows, place
    return best[2:]


def _names(row: list[str]) -> list[str]:
    """Return the names of the columns in a row, which some programs write as a comment."""
    return [row[0].lstrip(_COMMENT).strip(), *map(str.strip, row[1:])]


def _in_brackets(name: str) -> str:
    """Return the text in brackets at the end of a name, such as a unit."""
    found = re.search(r'[\[(]([^\[\]()]+)[\])]$', name)
    return found[1] if found else ''


def _unit_rows(rows: list[list[str]]) -> int:
    """Return the number of rows, up to five, between the names and the first numbers, such as units.

    The first cell of each is that of the time: no units stand beside one.
    """
    head = rows[:6]
    for count, row in enumerate(head):
        if _is_value(row[0]) or (any(map(_is_value, row)) and all(_is_value(cell) or _is_blank(cell) for cell in row)):
            return count
    # Such as a date that cannot be read beside numbers: it is then named, and not the units above it.
    return next((count for count, row in enumerate(head) if any(map(_is_value, row))), 0)


class ParquetTable(Table):
    """A Parquet file, read by row groups."""

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        import pyarrow as pa  # noqa: PLC0415 - an optional package
        from pyarrow import parquet  # noqa: PLC0415

        rows = 0
        try:
            with parquet.ParquetFile(self.path) as file:
                _check_columns(self.path, names, file.schema_arrow.names)
                stated = ((name, (file.schema_arrow.field(name).metadata or {}).get(b'unit', b'')) for name in names)
                self.units = {name: unit.decode(errors='replace') for name, unit in stated if unit}
                count = max(1, file.metadata.num_rows)
                for batch in file.iter_batches(batch_size=ROWS_AT_ONCE, columns=list(names)):
                    columns = {name: self._column(name, batch.column(name), rows) for name in names}
                    yield Block(columns, batch.num_rows / count)
                    rows += batch.num_rows
        except (pa.ArrowException, OSError) as error:
            problem = ' '.join(str(error).split())
            raise InputError(f'{self.path}: is not a Parquet file that can be read ({problem})') from None

    def _column(self, name: str, cells: pa.Array, rows_before: int) -> Column:
        import pyarrow as pa  # noqa: PLC0415 - an optional package

        if pa.types.is_dictionary(cells.type):
            cells = cells.dictionary_decode()
        kind = cells.type
        try:
            if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
                cells = cells.cast(pa.timestamp('ns'))
            elif pa.types.is_time(kind):
                cells = cells.cast(pa.time64('ns')).cast(pa.int64()).cast(pa.duration('ns'))
            elif pa.types.is_duration(kind):
                cells = cells.cast(pa.duration('ns'))
            elif str(kind) in {'string', 'large_string', 'string_view'}:
                return _text_times(self.path, name, [cell or '' for cell in cells.to_pylist()], kind, rows_before)
            else:
                is_whole = pa.types.is_integer(kind) and not cells.null_count
                # Nanoseconds since 1970 beside blank cells are rounded to 256.
                cells = cells.cast(pa.int64()) if is_whole else cells.cast(pa.float64(), safe=False)
            return np.asarray(cells.to_numpy(zero_copy_only=False))
        except pa.ArrowException:
            raise InputError(f'{self.path}: column {shown(name)} of type {kind} holds no numbers') from None


def _text_times(path: Path, name: str, cells: Sequence[str], kind: object, rows_before: int = 0) -> Column:
    """Return the times in a column of texts; other texts are an error."""
    times = _times(cells, lambda index: f'{path}: row {rows_before + index + 1}: column {shown(name)}')
    if times is not None:
        return times
    if all(map(_is_blank, cells)):
        return np.full(len(cells), np.nan)
    raise InputError(f'{path}: column {shown(name)} of type {kind} holds no numbers, and no times like {_LIKE}')


class NpzTable(Table):
    """An ``.npz`` file of NumPy with one array a column; arrays that are not used may have any shape."""

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`. They are read as a whole."""
        if not is_zipfile(self.path):
            raise InputError(f'{self.path}: is not an npz file')
        try:
            with np.load(self.path, allow_pickle=False) as file:
                _check_columns(self.path, names, file.files)
                columns = {name: file[name] for name in names}
        except (OSError, ValueError, BadZipFile, EOFError) as error:
            raise InputError(f'{self.path}: cannot be read ({" ".join(str(error).split())})') from None
        # Other programs save a vector as a matrix of one column or one row.
        columns = {name: x.ravel() if x.ndim == 2 and 1 in x.shape else x for name, x in columns.items()}
        first = columns[names[0]]
        columns = {name: self._column(name, column, names[0], first.shape) for name, column in columns.items()}
        for start in range(0, len(first), ROWS_AT_ONCE):
            rows = {name: column[start : start + ROWS_AT_ONCE] for name, column in columns.items()}
            yield Block(rows, len(rows[names[0]]) / len(first))

    def _column(self, name: str, column: Column, first: str, shape: tuple[int, ...]) -> Column:
        to = {'M': 'datetime64[ns]', 'm': 'timedelta64[ns]', 'i': 'int64', 'u': 'int64', 'b': 'float64', 'f': 'float64'}
        kind = column.dtype.kind
        if column.ndim != 1 or column.shape != shape or kind not in {*to, 'U'}:
            raise InputError(
                f'{self.path}: column {shown(name)} of type {column.dtype} and shape {column.shape}; one number for '
                f'each of {shown(first)} expected, which has shape {shape}'
            )
        if kind == 'u' and column.size and column.max() > np.iinfo(np.int64).max:
            raise InputError(f'{self.path}: column {shown(name)}: {column.max()} is no number of 64 bits with a sign')
        return _text_times(self.path, name, column.tolist(), column.dtype) if kind == 'U' else column.astype(to[kind])


_UNIT_SIGNS: Final = {'‰': 'per_mille', '%': 'percent', '°': 'deg', 'm/s²': 'm/s^2', 'km/hr': 'km/h', 'kmh': 'km/h'}
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
        signals = self._mapping.signals
        # A position at the stamp of a speed must be known before that.
        self._signals = {name: signals[name] for name in ('position', *signals) if name in signals}
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
            stamps, known = self._clock.stamps(block.columns, self._path, self.rows)
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
            with suppress(ValueError):
                text = _UNIT_SIGNS.get(stated.lower(), stated)
                # A file may write another case, such as KM/H.
                read = find_unit(next((n for n in unit_factors(quantity) if n.lower() == text.lower()), text), quantity)
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

    def _feeds(self, columns: dict[str, Column], known: NDArray[np.bool_]) -> list[_Feed]:
        feeds: list[_Feed] = []
        for quantity, signal in self._signals.items():
            raw = [numbers(columns[source.field]) for source in signal.sources]
            if signal.function is not None:
                made = [_Feed(quantity, -1, signal.function.of_columns(raw))]
            else:
                pairs = enumerate(zip(signal.sources, raw, strict=True))
                made = [_Feed(quantity, index, self._values(quantity, *pair)) for index, pair in pairs]
            blank = ~np.isfinite(made[0].values) & (made[0].values != UNKNOWN_EFFORT)
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
