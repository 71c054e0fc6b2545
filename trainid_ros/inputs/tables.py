# SPDX-License-Identifier: Apache-2.0
"""Tables in files, in blocks of rows: CSV as loggers write it, Parquet and npz."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from zipfile import BadZipFile, is_zipfile

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.mapping import CsvFormat, Mapping, date_time_ns, time_of_day_ns
from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import did_you_mean, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    import pyarrow as pa


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
        """Name the file."""
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
    """Return the columns of all blocks."""
    found = list(blocks)
    return {name: _concatenated([block.columns[name] for block in found]) for name in names}


def _concatenated(parts: list[Column]) -> Column:
    """Return the parts of a column as one; blank cells are NaN in a part without times, NaT beside times."""
    times = next((part.dtype for part in parts if part.dtype.kind in 'mM'), None)
    if times is not None:
        blank = np.array('NaT', times)
        parts = [
            np.full(len(part), blank) if part.dtype.kind == 'f' and np.isnan(part).all() else part for part in parts
        ]
    return np.concatenate(parts) if parts else np.empty(0)


def _check_columns(path: Path, wanted: Iterable[str], known: Sequence[str]) -> None:
    """Raise InputError for the first column that is not known, or is there twice."""
    for name in wanted:
        if known.count(name) > 1:
            raise InputError(f'{path}: column {shown(name)} is there {known.count(name)} times')
        if name not in known:
            columns = ', '.join(map(shown, known[:20])) + (', ...' if len(known) > 20 else '')
            hint = did_you_mean(name, known) if known else ''
            hint = f'; {hint}' if hint.startswith('did') else ''
            raise InputError(f'{path}: no column {shown(name)}{hint} (columns: {columns or "none"})')


_BLANK: Final = frozenset({'', '-', '--', 'na', 'n/a', '#n/a', 'nan', 'null', 'none'})
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
    return cell.strip().lower() in _BLANK


def _number(cell: str, decimal: str) -> float | None:
    """Return the number in a cell, NaN if it is blank, None if it holds something else."""
    text = cell.strip()
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
    """How a file is written: encoding, separator, names of its columns, and rows before the numbers."""

    encoding: str
    separator: str
    names: tuple[str, ...]
    skipped: int


class CsvTable(Table):
    """A CSV file; comments, and whatever stands above the names of the columns, are skipped.

    The names that the mapping gives show the separator and the row of the names. The decimal sign is that of the first
    number in the file which only one sign explains.
    """

    def __init__(self, path: Path, form: CsvFormat) -> None:
        """Name the file and its known form."""
        super().__init__(path)
        self._form = form

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        layout = self._layout(names)
        decimal = self._form.decimal or self._decimal(layout, names)
        for lines, cells, share in self._rows(layout, names):
            columns = zip(names, zip(*cells, strict=True), strict=True)
            yield Block({name: self._column(name, lines, column, decimal) for name, column in columns}, share)

    def _rows(
        self, layout: _Layout, names: Sequence[str]
    ) -> Iterator[tuple[Sequence[int], Sequence[Sequence[str]], float]]:
        """Yield blocks of the rows below the names: line numbers, cells of the columns, share of the file read."""
        places = [layout.names.index(name) for name in names]
        size, reached = max(1, self.path.stat().st_size), 0
        with self.path.open('rb') as raw, io.TextIOWrapper(raw, layout.encoding, errors='replace', newline='') as text:
            reader = csv.reader(text, delimiter=layout.separator)
            full = ((reader.line_num, row) for row in self._closed(reader, layout) if any(map(str.strip, row)))
            rows = (item for item in full if not self._is_comment(item[1]) or self._holds_numbers(*item, places))
            try:
                for _ in islice(rows, layout.skipped):
                    pass
                while some := list(islice(rows, ROWS_AT_ONCE)):
                    lines, cells = zip(
                        *((line, self._cells(line, row, places, layout)) for line, row in some), strict=True
                    )
                    before, reached = reached, raw.tell()
                    yield lines, cells, (reached - before) / size
            except csv.Error as error:
                raise InputError(f'{self.path}: line {reader.line_num}: {error}') from None

    def _closed(self, reader: Any, layout: _Layout) -> Iterator[list[str]]:
        """Yield the rows; InputError for a text in quotes that holds whole rows: its second quote is missing."""
        before, others = 0, len(layout.names) - 1
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

    def _cells(self, line: int, row: list[str], places: Sequence[int], layout: _Layout) -> list[str]:
        """Return the cells of the columns in a row, blank where it ends early."""
        # No one can say which of more cells than names belongs to which.
        count = len(layout.names)
        if len(row) > count and any(map(str.strip, row[count:])):
            raise InputError(
                f'{self.path}: line {line} has {len(row)} cells, {count} columns have names; a text with the '
                f'separator {layout.separator!r} must be in quotes'
            )
        return [row[place] if place < len(row) else '' for place in places]

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
        """Find out how the file is written, by the names of its columns."""
        with self.path.open('rb') as file:
            head = file.read(1 << 18)
        encoding = self._form.encoding or _encoding(head)
        separators = (self._form.separator,) if self._form.separator else (';', '\t', ',', '|')
        separator, rows, place = _find_names(head.decode(encoding, errors='replace'), separators, names)
        known = _names(rows[place]) if rows else []
        _check_columns(self.path, names, known)
        above = sum(not self._is_comment(row) for row in rows[:place])
        places = [known.index(name) for name in names]
        below = [row for row in rows[place:] if not self._is_comment(row)]
        cells = [[row[i] if i < len(row) else '' for i in places] for row in below]
        named = int(not self._is_comment(rows[place]))
        if below[named:] and not any(_is_value(cell) for row in cells[named:] for cell in row):
            raise InputError(f'{self.path}: no numbers below the names of its columns {", ".join(map(shown, names))}')
        skipped = self._form.header_rows or named + _unit_rows(cells[named:])
        for row in ([*map(_in_brackets, names)], *cells[named:skipped]):
            self.units |= {name: cell.strip(' []()') for name, cell in zip(names, row, strict=True) if cell.strip()}
        return _Layout(encoding, separator, tuple(known), above + skipped)

    def _decimal(self, layout: _Layout, names: Sequence[str]) -> str:
        """Return the decimal sign of a file; InputError where a comma may also mark thousands."""
        unclear = ''
        for _, rows, _ in self._rows(layout, names):
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
    """Return the number of rows, up to five, between the names and the first numbers, such as units."""
    head = rows[:6]
    for count, row in enumerate(head):
        if any(map(_is_value, row)) and all(_is_value(cell) or _is_blank(cell) for cell in row):
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
            elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
                return _text_times(self.path, name, [cell or '' for cell in cells.to_pylist()], kind, rows_before)
            else:
                is_whole = pa.types.is_integer(kind) and not cells.null_count
                cells = cells.cast(pa.int64() if is_whole else pa.float64())
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
