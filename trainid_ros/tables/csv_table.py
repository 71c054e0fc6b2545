# SPDX-License-Identifier: Apache-2.0
"""CSV files as loggers write them: separator, decimal sign, header and encoding are found out."""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Final, NoReturn

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.times import date_time_ns, time_of_day_ns
from trainid_ros.tables.columns import ROWS_AT_ONCE, Block, Column, check_columns
from trainid_ros.train.fields import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from trainid_ros.mapping.mapping import CsvFormat

_SEPARATORS: Final = (';', '\t', ',', '|')
_HEAD_BYTES: Final = 1 << 18
_HEAD_ROWS: Final = 200
# Rows between the names and the first numbers, such as units, unless the mapping says how many.
_MOST_UNIT_ROWS: Final = 5
_COMMENT: Final = '#'
_BLANK: Final = frozenset({'', '-', '--', 'na', 'n/a', '#n/a', 'nan', 'null', 'none'})
_WORDS: Final = {'true': 1.0, 'false': 0.0}
# Thousands marks by decimal sign: a point, a comma, an apostrophe or a space before each three digits.
_MARKS: Final = "'\u2019\u00a0\u202f "
_GROUPED: Final = {
    decimal: re.compile(rf'[+-]?\d{{1,3}}([{other}{_MARKS}])\d{{3}}(\1\d{{3}})*({re.escape(decimal)}\d*)?')
    for decimal, other in (('.', ','), (',', '.'))
}
_WHOLE: Final = re.compile(r'[+-]?(\d{1,18}|1\d{18})')  # of 64 bits


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a file is written: encoding, separator, decimal sign, names of its columns, and rows before the numbers."""

    encoding: str
    separator: str
    decimal: str
    names: tuple[str, ...]
    skipped: int


class CsvTable:
    """A CSV file; comments, and whatever stands above the names of the columns, are skipped."""

    def __init__(self, path: Path, form: CsvFormat) -> None:
        """Name the file, and what is known of its form."""
        self.path = path
        self.units: dict[str, str] = {}
        self._form = form

    def blocks(self, names: Sequence[str]) -> Iterator[Block]:
        """Yield columns; see :class:`Table`."""
        layout = self._layout(names)
        places = [(name, layout.names.index(name)) for name in names]
        with self._opened(layout.encoding) as (text, done):
            reader = csv.reader(text, delimiter=layout.separator)
            rows = ((reader.line_num, row) for row in reader if _is_full(row) and not _is_comment(row))
            try:
                for _ in islice(rows, layout.skipped):
                    pass
                while some := list(islice(rows, ROWS_AT_ONCE)):
                    self._check_widths(some, layout)
                    lines, cells = [line for line, _ in some], [row for _, row in some]
                    columns = {
                        name: self._column(name, lines, [row[i] if i < len(row) else '' for row in cells], layout)
                        for name, i in places
                    }
                    yield Block(columns, done())
            except csv.Error as error:
                raise InputError(f'{self.path}: line {reader.line_num}: {error}') from None

    def _check_widths(self, rows: Sequence[tuple[int, list[str]]], layout: _Layout) -> None:
        """Raise InputError for a row with more cells than names: no one can say which cell belongs to which."""
        most = len(layout.names)
        for line, row in rows:
            if len(row) > most and _is_full(row[most:]):
                raise InputError(
                    f'{self.path}: line {line} has {len(row)} cells, {most} columns have names; a text with the '
                    f'separator {layout.separator!r} must be in quotes'
                )

    @contextmanager
    def _opened(self, encoding: str) -> Iterator[tuple[io.TextIOWrapper, _Progress]]:
        with self.path.open('rb') as raw, io.TextIOWrapper(raw, encoding, errors='replace', newline='') as text:
            yield text, _Progress(raw, max(1, self.path.stat().st_size))

    def _layout(self, names: Sequence[str]) -> _Layout:
        """Find out how the file is written, by the names of its columns.

        Raises:
            InputError: A column is missing.
        """
        with self.path.open('rb') as file:
            head = file.read(_HEAD_BYTES)
        encoding = self._form.encoding or _encoding(head)
        separators = (self._form.separator,) if self._form.separator else _SEPARATORS
        separator, rows, place = _find_names(head.decode(encoding, errors='replace'), separators, names)
        known = _names(rows[place]) if rows else []
        check_columns(self.path, names, known)
        above = sum(not _is_comment(row) for row in rows[:place])
        below = [row for row in rows[place:] if not _is_comment(row)]
        wanted = [known.index(name) for name in names]
        cells = [[row[i] if i < len(row) else '' for i in wanted] for row in below]
        named = int(not _is_comment(rows[place]))
        if below[named:] and not any(_is_value(cell) for row in cells[named:] for cell in row):
            raise InputError(f'{self.path}: no numbers below the names of its columns {", ".join(map(shown, names))}')
        skipped = self._form.header_rows or named + _unit_rows(cells[named:])
        for row in ([*map(_in_brackets, names)], *cells[named:skipped]):
            self.units |= {name: cell.strip(' []()') for name, cell in zip(names, row, strict=True) if cell.strip()}
        decimal = self._form.decimal or self._decimal(cells[skipped:])
        return _Layout(encoding, separator, decimal, tuple(known), above + skipped)

    def _decimal(self, rows: list[list[str]]) -> str:
        """Return the decimal sign of some rows.

        Raises:
            InputError: A comma may be the decimal sign or mark thousands.
        """
        cells = [cell.strip() for row in rows for cell in row if not _is_time(cell.strip())]
        if cell := _unclear(cells):
            raise InputError(
                f'{self.path}: {shown(cell)} may be {_number(cell, ",")} or {_number(cell, ".")}: a comma before three '
                'digits in every cell that has one; csv: {decimal: ","} or {decimal: "."} in the mapping says which'
            )
        return _decimal(cells)

    def _column(self, name: str, lines: list[int], cells: list[str], layout: _Layout) -> Column:
        """Return a column of some rows."""
        if all(map(_WHOLE.fullmatch, cells)):
            return np.array([int(cell) for cell in cells], dtype=np.int64)
        if (layout.decimal == '.' or not any('.' in cell for cell in cells)) and not any('_' in cell for cell in cells):
            with suppress(ValueError):
                return np.array([float(cell.replace(layout.decimal, '.')) for cell in cells], dtype=np.float64)
        first = next((cell.strip() for cell in cells if not _is_blank(cell)), '')
        if date_time_ns(first) is not None:
            return self._times(name, lines, cells, date_time_ns, 'datetime64[ns]')
        if time_of_day_ns(first) is not None:
            return self._times(name, lines, cells, time_of_day_ns, 'timedelta64[ns]')
        rows = zip(lines, cells, strict=True)
        return np.array([self._number(name, *item, layout.decimal) for item in rows], dtype=np.float64)

    def _times(
        self, name: str, lines: list[int], cells: list[str], of_text: Callable[[str], int | None], kind: str
    ) -> Column:
        stamps = [None if _is_blank(cell) else of_text(cell.strip()) for cell in cells]
        for line, cell, stamp in zip(lines, cells, stamps, strict=True):
            if stamp is None and not _is_blank(cell):
                what = 'date with time' if kind.startswith('date') else 'time of day'
                self._fail(name, line, cell, f'is not a {what}; {_FOOTER}')
        return np.array(['NaT' if stamp is None else stamp for stamp in stamps], dtype=kind)

    def _number(self, name: str, line: int, cell: str, decimal: str) -> float:
        number = _number(cell, decimal)
        if number is None:
            if ':' in cell:
                self._fail(name, line, cell, 'is no time like 2024-03-08T12:00:00, 08.03.2024 12:00:00 or 12:00:00')
            hint = 'csv: {separator, decimal, header_rows} in the mapping says how the file is written'
            self._fail(name, line, cell, f'is not a number with the decimal sign {decimal!r}; {hint}; {_FOOTER}')
        return number

    def _fail(self, name: str, line: int, cell: str, problem: str) -> NoReturn:
        raise InputError(f'{self.path}: line {line}: column {shown(name)} = {shown(cell)} {problem}')


_FOOTER: Final = 'lines of text below the numbers must go, or start with #'


class _Progress:
    """Share of a file that was read since the last call."""

    def __init__(self, raw: io.BufferedReader, size: int) -> None:
        self._raw, self._size, self._reached = raw, size, 0

    def __call__(self) -> float:
        before, self._reached = self._reached, self._raw.tell()
        return (self._reached - before) / self._size


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
        rows = _head_rows(text, separator)
        for place, row in enumerate(rows):
            found = sum(name in _names(row) for name in names)
            if (found, len(row)) > best[:2]:
                best = found, len(row), separator, rows, place
    return best[2:]


def _head_rows(text: str, separator: str) -> list[list[str]]:
    """Return the first rows of a text; its end may be cut off."""
    rows: list[list[str]] = []
    try:
        for row in csv.reader(io.StringIO(text, newline=''), delimiter=separator):
            if _is_full(row) and len(rows) < _HEAD_ROWS:
                rows.append(row)
    except csv.Error:
        pass
    return rows


def _is_full(row: list[str]) -> bool:
    return any(map(str.strip, row))


def _is_comment(row: list[str]) -> bool:
    return row[0].startswith(_COMMENT)


def _names(row: list[str]) -> list[str]:
    """Return the names of the columns in a row, which some programs write as a comment."""
    return [row[0].lstrip(_COMMENT).strip(), *map(str.strip, row[1:])]


def _in_brackets(name: str) -> str:
    """Return what is in brackets at the end of a name, such as a unit."""
    found = re.search(r'[\[(]([^\[\]()]+)[\])]$', name)
    return found[1] if found else ''


def _unit_rows(rows: list[list[str]]) -> int:
    """Return the number of rows, from the first on, that hold words where numbers are wanted."""
    for count, row in enumerate(rows[: _MOST_UNIT_ROWS + 1]):
        if any(_is_value(cell) for cell in row) and all(_is_value(cell) or _is_blank(cell) for cell in row):
            return count
    # Such as a date that cannot be read beside numbers: it is then named, and not the units above it.
    return next((count for count, row in enumerate(rows[: _MOST_UNIT_ROWS + 1]) if any(map(_is_value, row))), 0)


def _is_value(cell: str) -> bool:
    text = cell.strip()
    if _is_blank(text):
        return False
    return any(_number(text, decimal) is not None for decimal in _GROUPED) or _is_time(text)


def _is_time(text: str) -> bool:
    return date_time_ns(text) is not None or time_of_day_ns(text) is not None


def _unclear(cells: list[str]) -> str:
    """Return a cell with a comma if none of all cells shows whether that is the decimal sign, '' if one does."""
    with_comma = [cell for cell in cells if ',' in cell and _number(cell, ',') is not None]
    is_shown = any(_number(cell, '.') is None or cell.lstrip('+-').startswith('0') for cell in with_comma)
    return '' if is_shown or not with_comma or any('.' in cell for cell in cells) else with_comma[0]


def _decimal(cells: list[str]) -> str:
    """Return the decimal sign of the numbers in some cells."""
    # By the cells that only one of the two explains; then by which sign there is.
    by_sign = {
        sign: sum(_number(cell, sign) is not None and _number(cell, other) is None for cell in cells)
        for sign, other in ((',', '.'), ('.', ','))
    }
    if by_sign[','] == by_sign['.']:  # as 1,234 alone is
        return ',' if any(',' in cell for cell in cells) and not any('.' in cell for cell in cells) else '.'
    return ',' if by_sign[','] > by_sign['.'] else '.'


def _is_blank(cell: str) -> bool:
    return cell.strip().lower() in _BLANK


def _number(cell: str, decimal: str) -> float | None:
    """Return the number in a cell, NaN if it is blank, None if it holds something else."""
    text = cell.strip()
    if _is_blank(text):
        return math.nan
    if grouped := _GROUPED[decimal].fullmatch(text):
        text = text.replace(grouped[1], '')
    # What float() would take: a point for the decimal sign, and underscores.
    if (decimal == ',' and '.' in text) or '_' in text:
        return None
    try:
        return float(text.replace(decimal, '.'))
    except ValueError:
        return _WORDS.get(text.lower())
