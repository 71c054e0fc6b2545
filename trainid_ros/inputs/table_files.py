# SPDX-License-Identifier: Apache-2.0
"""Tables in files, in blocks of rows: CSV as loggers write it, VBOX, Parquet and npz."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from abc import ABC, abstractmethod
from collections import Counter
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from zipfile import BadZipFile, is_zipfile

import numpy as np
from numpy.typing import NDArray

from trainid_ros.inputs.mapping import OWN, Mapping
from trainid_ros.inputs.times import TextTimes, UnclearError, is_time
from trainid_ros.inputs.units import SUFFIXES
from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    import pyarrow as pa

Column: TypeAlias = NDArray[Any]
"""Numbers as float64, whole numbers as int64, times as datetime64[ns], times of day and durations as timedelta64[ns];
NaN or NaT where a cell is blank."""
ROWS_AT_ONCE: Final = 10_000
VBOX_SUFFIX: Final = '.vbo'
CSV_SUFFIXES: Final = ('.csv', '.tsv', '.txt', '.dat', '.log', VBOX_SUFFIX)


@dataclass(frozen=True, slots=True)
class Block:
    """Some rows of a table."""

    columns: dict[str, Column]  # Columns by name, each of shape (n,)
    share: float  # Share of the file that was read for them [1]


class Table(ABC):
    """A file with columns."""

    def __init__(self, path: Path, mapping: Mapping = OWN) -> None:
        self.path = path
        self.units: dict[str, str] = {}  # that the file states, by column; known once a block is read
        self.times: dict[str, TextTimes] = {}  # how the texts of columns of times are read
        self._mapping = mapping

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Return the names of all columns; InputError if the file cannot be read."""

    @abstractmethod
    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield the columns of these names; InputError, naming file, column and row, if they cannot be read."""

    def text_times(self, name: str) -> TextTimes:
        """Return how the texts of a column are read as times."""
        time = self._mapping.time
        # Of a date in another column than its clock.
        form = time.format if time is not None and name == time.columns[-1] and '%' in time.format else ''
        return self.times.setdefault(name, TextTimes(form))

    def is_missing(self, cell: str) -> bool:
        """Return whether a cell holds no value."""
        return _is_blank(cell) or cell.strip().lower() in self._mapping.missing

    def _of_texts(self, name: str, texts: Sequence[str], kind: object, rows_before: int = 0) -> Column:
        """Return the times in a column of texts; other texts are an error."""
        cells = ['' if self.is_missing(text) else text.strip() for text in texts]
        if not any(cells):
            return np.full(len(cells), np.nan)
        times = self.text_times(name).read(
            cells, lambda i: f'{self.path}: row {rows_before + i + 1}: column {shown(name)}'
        )
        if times is None:
            raise InputError(f'{self.path}: column {shown(name)} of type {kind} holds no numbers or times like {_LIKE}')
        return times


def open_table(path: Path, mapping: Mapping) -> Table:
    """Return the table in a file, by its suffix; InputError if there is no such file, or the suffix is not known."""
    if not path.is_file():
        raise InputError(f'{path}: is not a file' if path.exists() else f'{path}: no such file')
    kinds: dict[str, type[Table]] = dict.fromkeys(CSV_SUFFIXES, CsvTable)
    kinds |= {'.parquet': ParquetTable, '.pq': ParquetTable, '.npz': NpzTable}
    if (suffix := path.suffix.lower()) in kinds:
        return kinds[suffix](path, mapping)
    hint = '; a spreadsheet must be saved as CSV' if suffix in {'.xlsx', '.xls', '.ods'} else ''
    raise InputError(f'{path}: not a table: {", ".join(kinds)} expected{hint}')


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


def find_columns(path: Path, wanted: Iterable[str], known: Sequence[str]) -> list[str]:
    """Return the columns of these names, which may lack a unit: ``v`` is ``v [km/h]``; InputError if one is not one."""
    found = []
    for name in wanted:
        alike = [column for column in known if column == name] or [column for column in known if bare(column) == name]
        if len(alike) > 1:
            raise InputError(f'{path}: column {shown(name)} is there {len(alike)} times')
        if not alike:
            columns = ', '.join(map(shown, known[:20])) + (', ...' if len(known) > 20 else '')
            folded = {part.lower(): column for column in known for part in (column, bare(column))}
            near = get_close_matches(name.lower(), folded, n=1)
            hint = f'; did you mean {folded[near[0]]!r}?' if near else ''
            raise InputError(f'{path}: no column {shown(name)}{hint} (columns: {columns or "none"})')
        if alike[0] in found:  # a part of a sum would count twice
            raise InputError(f'{path}: column {shown(alike[0])} has two names in the mapping')
        found += alike
    return found


_IN_BRACKETS: Final = re.compile(r'\s*[\[(]([^\[\]()]+)[\])]$')


def bare(name: str) -> str:
    """Return the name of a column without its unit, such as that of ``v [km/h]`` or ``speed_kmh``."""
    stem, mark, unit = _IN_BRACKETS.sub('', name).rpartition('_')
    return stem if mark and unit.lower() in SUFFIXES else f'{stem}{mark}{unit}'


_BLANK: Final = frozenset(
    {'', '-', '--', '---', '----', '?', '*'} | {'na', 'n/a', '#n/a', 'n.a.', 'k.a.', 'nan', 'null', 'nil', 'none'}
)
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


_POST: Final = re.compile(r'(\d{1,4})\+(\d{3,4}(?:[.,]\d+)?)')  # km+m, as on kilometre posts


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
    if post := _POST.fullmatch(text):
        return 1000.0 * int(post[1]) + float(post[2].replace(decimal, '.'))
    try:
        return float(text.replace(decimal, '.'))
    except ValueError:
        return {'true': 1.0, 'false': 0.0}.get(text.lower())


def _may_be_number(text: str) -> bool:
    return any(_number(text, decimal) is not None for decimal in _GROUPED)


def _is_value(cell: str) -> bool:
    text = cell.strip()
    return not _is_blank(text) and (is_time(text) or _may_be_number(text))


_EITHER: Final = '1,250'  # such a number, which both signs explain
_THOUSANDS: Final = '1.250'  # such a number, read as 1.25 unless others show a comma


def _sign_in(cell: str) -> str:
    """Return the decimal sign that alone explains a number, one of the above if both do, '' if it shows nothing."""
    if ',' not in cell and '.' not in cell:
        return ''
    signs = [decimal for decimal in _GROUPED if _number(cell, decimal) is not None]
    if len(signs) > 1:
        return _EITHER if ',' in cell else _THOUSANDS
    return ''.join(signs)


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a file is written: encoding, separator, number of its columns, those read, and rows before the numbers."""

    encoding: str
    separator: str
    width: int
    places: tuple[int, ...]
    skipped: int
    heads: list[str]  # the row of the names, which some loggers repeat


class CsvTable(Table):
    """A CSV file; comments, and whatever stands above the names of the columns, are skipped.

    The names that the mapping gives show the separator and the row of the names. The decimal sign is that of the first
    number in the file which only one sign explains.
    """

    def __init__(self, path: Path, mapping: Mapping = OWN) -> None:
        super().__init__(path, mapping)
        self._form = mapping.csv
        self._is_vbox = path.suffix.lower() == VBOX_SUFFIX

    def names(self) -> tuple[str, ...]:
        """Return the names that are there once; see :class:`Table`."""
        *_, rows, place = self._head(())
        if not rows or any(map(_is_value, rows[place])):
            raise InputError(f'{self.path}: no row with the names of the columns above the numbers')
        counts = Counter(_names(rows[place]))
        return tuple(name for name, count in counts.items() if name and count == 1)

    def decimal_sign(self, names: Sequence[str]) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
        """Return the decimal sign of the columns that hold numbers, '' if none shows one, and columns in doubt.

        With a sign those that show another one, or may on their own, then without one those whose numbers are all like
        1.250. UnclearError where a comma may be either.
        """
        _, rows, _ = next(self._rows(self._layout(names)), ((), (), 0.0))
        some = zip(names, zip(*rows[:1000], strict=True), strict=False)
        columns = {name: [cell.strip() for cell in column if not self.is_missing(cell)] for name, column in some}
        numbers = {name: cells for name, cells in columns.items() if cells and all(map(_may_be_number, cells))}
        sign = self._decimal(self._layout(tuple(numbers) or names))
        shown_by = {name: {_sign_in(cell) for cell in cells} for name, cells in numbers.items()}
        grouped = [name for name, signs in shown_by.items() if signs == {_THOUSANDS}]
        read = {'', _THOUSANDS} if sign == '.' else {''}
        others = [name for name, signs in shown_by.items() if sign not in signs and signs - read]
        return (sign, tuple(others), ()) if sign else ('', (), tuple(grouped))

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        layout = self._layout(names)
        decimal = self._form.decimal or self._decimal(layout) or '.'
        for lines, cells, share in self._rows(layout):
            columns = zip(names, zip(*cells, strict=True), strict=True)
            yield Block({name: self._column(name, lines, column, decimal) for name, column in columns}, share)

    def _rows(self, layout: _Layout) -> Iterator[tuple[Sequence[int], Sequence[Sequence[str]], float]]:
        """Yield blocks of the rows below the names: line numbers, cells of the columns, share of the file read."""
        size, reached = max(1, self.path.stat().st_size), 0
        with self.path.open('rb') as raw, io.TextIOWrapper(raw, layout.encoding, errors='replace', newline='') as text:
            reader = _reader(text, layout.separator)
            full = ((reader.line_num, row) for row in self._closed(reader, layout) if any(map(str.strip, row)))
            data = (item for item in full if not self._is_comment(item[1]) or self._holds_numbers(*item, layout.places))
            rows = (item for item in islice(data, layout.skipped, None) if item[1] != layout.heads)
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
        cells = [row[place] if place < len(row) else '' for place in layout.places]
        return ['' if self.is_missing(cell) else cell for cell in cells] if self._mapping.missing else cells

    def _is_comment(self, row: list[str]) -> bool:
        return self._form.comments is not False and row[0].startswith('#') and not _is_blank(row[0])

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
        encoding, text, separator, rows, place = self._head(names)
        known = _names(rows[place]) if rows else []
        columns = find_columns(self.path, names, known)
        above = sum(not self._is_comment(row) for row in rows[:place])
        places = tuple(map(known.index, columns))
        below = [row for row in rows[place:] if not self._is_comment(row)]
        cells = [[row[i] if i < len(row) else '' for i in places] for row in below]
        named = int(not self._is_comment(rows[place]))
        texts = [cell for row in cells[named:] for cell in row if not _is_blank(cell)]
        # Blank ones say nothing of the rest of the file.
        if texts and not any(map(_is_value, texts)):
            which = f'{", ".join(map(shown, names))} (but {shown(texts[-1])})'
            raise InputError(f'{self.path}: no numbers below the names of its columns {which}')
        skipped = self._form.header_rows or named + _unit_rows(cells[named:])
        stated = _vbox_units(text, known) if self._is_vbox else {}
        in_names = [stated.get(name) or ''.join(_IN_BRACKETS.findall(name)) for name in columns]
        for row in (in_names, *(() if self._is_vbox else cells[named:skipped])):
            self.units |= {name: cell.strip(' []()') for name, cell in zip(names, row, strict=True) if cell.strip()}
        return _Layout(encoding, separator, len(known), places, above + skipped, rows[place])

    def _head(self, names: Sequence[str]) -> tuple[str, str, str, list[list[str]], int]:
        """Return encoding, text and separator of the beginning, its rows, and the place of the one with the names."""
        with self.path.open('rb') as file:
            head = file.read(1 << 18)
        encoding = self._form.encoding or _encoding(head)
        text = head.decode(encoding, errors='replace')
        separators = self._form.separator or (' ' if self._is_vbox else ';\t,|')  # of one character each
        return encoding, text, *_find_names(text, separators, names)

    def _decimal(self, layout: _Layout) -> str:
        """Return the decimal sign of a file, '' if it shows none; UnclearError where a comma may mark thousands."""
        unclear = ''
        for _, rows, _ in self._rows(layout):
            for cell in (cell.strip() for row in rows for cell in row if ',' in cell or '.' in cell):
                sign = _sign_in(cell)
                if sign in _GROUPED:
                    return sign
                if sign == _EITHER:
                    unclear = unclear or cell
        if unclear:
            raise UnclearError(
                f'{self.path}: {shown(unclear)} may be {_number(unclear, ",")} or {_number(unclear, ".")}: a comma '
                'before three digits in every cell that has one; csv: {decimal: ","} or {decimal: "."} in the mapping '
                'says which',
                ',',
            )
        return ''

    def _column(self, name: str, lines: Sequence[int], cells: Sequence[str], decimal: str) -> Column:
        times = self.text_times(name)
        if all(map(_WHOLE.fullmatch, cells)) and '%' not in times.form:
            return np.array([int(cell) for cell in cells], dtype=np.int64)
        is_plain = '%' not in times.form and not any('_' in cell for cell in cells)
        if is_plain and (decimal == '.' or not any('.' in cell for cell in cells)):
            with suppress(ValueError):
                return np.array([float(cell.replace(decimal, '.')) for cell in cells], dtype=np.float64)

        def where(index: int) -> str:
            return f'{self.path}: line {lines[index]}: column {shown(name)}'

        footer = '; lines of text below the numbers must go, or start with #'
        texts = ['' if _is_blank(cell) else cell.strip() for cell in cells]
        if (found := times.read(texts, where, footer)) is not None:
            return found
        values = [_number(cell, decimal) for cell in cells]
        if None in values:
            cell = cells[index := values.index(None)]
            problem = f'is not a number with the decimal sign {decimal!r}; csv: {{separator, decimal, header_rows}} in '
            problem += f'the mapping says how the file is written{footer}'
            raise InputError(f'{where(index)} = {shown(cell)} {f"is no time like {_LIKE}" if ":" in cell else problem}')
        return np.array(values, dtype=np.float64)


def _reader(text: Iterable[str], separator: str) -> Any:
    return csv.reader(text, delimiter=separator, skipinitialspace=separator == ' ')


def _vbox_units(text: str, names: Sequence[str]) -> dict[str, str]:
    """Return the units in the descriptions of the columns, which the header of VBOX has in their order."""
    found = re.search(r'\[header\]\s*\n(.*?)\n\s*\[', text, re.DOTALL)
    lines = found[1].split('\n') if found else []
    return dict(zip(names, map(str.strip, lines), strict=False)) if len(lines) >= sum(map(bool, names)) else {}


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return 'utf-16'
    try:
        codecs.getincrementaldecoder('utf-8')().decode(head)
    except UnicodeDecodeError:
        runs = re.findall(rb'[\x80-\xff]+', head[: head.rfind(b'\n')])
        if all(len(run) % 2 == 0 for run in runs):  # pairs, as of Chinese characters
            with suppress(UnicodeDecodeError):
                b''.join(runs).decode('gb18030')
                return 'gb18030'
        return 'cp1252'  # latin-1 with what Windows adds
    return 'utf-8-sig'


def _find_names(text: str, separators: Sequence[str], names: Sequence[str]) -> tuple[str, list[list[str]], int]:
    """Return separator, first rows, and the place of the one with most of the names, or else with most cells.

    Without names it is the first of texts with most rows of its width.
    """
    best: tuple[int, int, str, list[list[str]], int] = (-1, 0, separators[0], [], 0)
    for separator in separators:
        rows: list[list[str]] = []
        with suppress(csv.Error):  # where the text is cut off
            reader = _reader(io.StringIO(text, newline=''), separator)
            rows.extend(islice((row for row in reader if any(map(str.strip, row))), 200))
        widths = Counter(map(_width, rows))
        for place, row in enumerate(rows):
            if names:
                known = {part for name in _names(row) for part in (name, bare(name))}
                found = sum(name in known for name in names)
            else:
                found = widths[_width(row)] if _width(row) > 1 and not any(map(_is_value, row)) else -1
            if (found, len(row)) > best[:2]:
                best = found, len(row), separator, rows, place
    return best[2:]


def _width(row: Sequence[str]) -> int:
    """Return the number of cells without blank ones at the end."""
    return max((place for place, cell in enumerate(row, 1) if cell.strip()), default=0)


def _names(row: list[str]) -> list[str]:
    """Return the names of the columns in a row, which some programs write as a comment."""
    return [row[0].lstrip('#').strip(), *map(str.strip, row[1:])]


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

    def names(self) -> tuple[str, ...]:
        """Return all names; see :class:`Table`."""
        with self._opened() as file:
            return tuple(file.schema_arrow.names)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        import pyarrow as pa  # noqa: PLC0415 - an optional package
        from pyarrow import parquet  # noqa: PLC0415

        try:
            with parquet.ParquetFile(self.path) as file:
                yield file
        except (pa.ArrowException, OSError) as error:
            problem = ' '.join(str(error).split())
            raise InputError(f'{self.path}: is not a Parquet file that can be read ({problem})') from None

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        rows = 0
        with self._opened() as file:
            schema = file.schema_arrow
            columns = dict(zip(names, find_columns(self.path, names, schema.names), strict=True))
            stated = {name: schema.field(column).metadata or {} for name, column in columns.items()}
            self.units = {
                name: data[b'unit'].decode(errors='replace') for name, data in stated.items() if b'unit' in data
            }
            count = max(1, file.metadata.num_rows)
            for batch in file.iter_batches(batch_size=ROWS_AT_ONCE, columns=list(columns.values())):
                found = {name: self._column(name, batch.column(column), rows) for name, column in columns.items()}
                yield Block(found, batch.num_rows / count)
                rows += batch.num_rows

    def _column(self, name: str, cells: pa.Array, rows_before: int) -> Column:
        import pyarrow as pa  # noqa: PLC0415 - an optional package

        if pa.types.is_dictionary(cells.type):
            cells = cells.dictionary_decode()
        kind = cells.type
        try:
            if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
                self.text_times(name).has_zone = bool(getattr(kind, 'tz', None))
                cells = cells.cast(pa.timestamp('ns'))
            elif pa.types.is_time(kind):
                cells = cells.cast(pa.time64('ns')).cast(pa.int64()).cast(pa.duration('ns'))
            elif pa.types.is_duration(kind):
                cells = cells.cast(pa.duration('ns'))
            elif str(kind) in {'string', 'large_string', 'string_view'}:
                return self._of_texts(name, [cell or '' for cell in cells.to_pylist()], kind, rows_before)
            else:
                is_whole = pa.types.is_integer(kind) and not cells.null_count
                # Nanoseconds since 1970 beside blank cells are rounded to 256.
                cells = cells.cast(pa.int64()) if is_whole else cells.cast(pa.float64(), safe=False)
            return np.asarray(cells.to_numpy(zero_copy_only=False))
        except pa.ArrowException:
            raise InputError(f'{self.path}: column {shown(name)} of type {kind} holds no numbers') from None


class NpzTable(Table):
    """An ``.npz`` file of NumPy with one array a column; arrays that are not used may have any shape."""

    def names(self) -> tuple[str, ...]:
        """Return all names; see :class:`Table`."""
        return tuple(self._load(None))

    def _load(self, names: Sequence[str] | None) -> dict[str, Column]:
        """Return columns by name, all without names."""
        if not is_zipfile(self.path):
            raise InputError(f'{self.path}: is not an npz file')
        try:
            with np.load(self.path, allow_pickle=False) as file:
                wanted = file.files if names is None else names
                found = find_columns(self.path, wanted, file.files)
                columns = {name: file[column] for name, column in zip(wanted, found, strict=True)}
        except (OSError, ValueError, BadZipFile, EOFError) as error:
            raise InputError(f'{self.path}: cannot be read ({" ".join(str(error).split())})') from None
        # Other programs save a vector as a matrix of one column or one row.
        return {name: x.ravel() if x.ndim == 2 and 1 in x.shape else x for name, x in columns.items()}

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`. They are read as a whole."""
        columns = self._load(names)
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
        return self._of_texts(name, column.tolist(), column.dtype) if kind == 'U' else column.astype(to[kind])
