# SPDX-License-Identifier: Apache-2.0
"""The numbers of a table over time, and which of its columns is the time."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from trainid_ros.inputs.mapping import CsvFormat, Mapping, TimeColumn
from trainid_ros.inputs.table_files import VBOX_SUFFIX, Column, CsvTable, joined, open_table
from trainid_ros.inputs.tables import Clock
from trainid_ros.inputs.times import CLOCK, EXCEL, UnclearError
from trainid_ros.inputs.units import find_unit
from trainid_ros.inspection.choice import Choice, quoted
from trainid_ros.inspection.number_series import BagNumbers, NumberSeries, score, unit_in
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.text import listed

_MAX_NOTCHES: Final = 16  # whole numbers of more values are measurements
# Like -999, or the largest number of 8, 16 or 32 bits, also in tenths or hundredths.
_LIKE_CODE: Final = re.compile(r'-?(9{3,}(\.9+)?|99\.9+)|-?(255|327\.?6\.?[78]|655\.?3\.?5|2147483647|4294967295)')


def read_table(path: Path) -> tuple[BagNumbers, tuple[Choice, ...]]:
    """Return the numbers in the first rows of a table, and what a mapping says of its time and form.

    InputError if it cannot be read, or no column is a time.
    """
    reader = _Reader(path)
    names = open_table(path, reader.mapping).names()
    reader.find_decimal(names)
    columns = reader.columns(names)
    rows = max((len(column) for column in columns.values()), default=0)
    columns = {name: column for name, column in columns.items() if len(column) == rows}
    series = {name: _series(name, column, reader.units.get(name, '')) for name, column in columns.items()}
    points = {name: _points(column, series[name]) for name, column in columns.items()}
    name = max(points, key=lambda name: points[name], default='')
    if not name or points[name] <= 0.0:
        raise InputError(f'{path}: no column is a time (columns: {listed(names, 20) or "none"}){reader.why(columns)}')
    choice, (stamps, known) = _time(series[name], columns.pop(name), reader, points, columns)
    time = (stamps - stamps[known][0]) / NS_PER_S
    codes = _codes({other: column for other, column in columns.items() if column.dtype.kind in 'if'})
    numbers_of = sorted({code for some in codes.values() for code in some})
    columns |= {other: np.where(np.isin(columns[other], numbers_of), np.nan, columns[other]) for other in codes}
    found = []
    for other, column in columns.items():
        if column.dtype.kind not in 'if' or not np.any(rows_of := known & np.isfinite(column)):
            continue
        if np.any(column[rows_of] != 0):
            values = np.asarray(column[rows_of], dtype=np.float64)
            found.append(replace(series[other], time=time[rows_of], value=values))
        else:
            reader.left_out.append((other, 'always 0'))
    numbers = BagNumbers(tuple(found), frozenset(), (), tuple(reader.left_out), float(time[known][-1]))
    return numbers, (choice, *reader.form, *_missing(codes))


def _codes(columns: dict[str, Column]) -> dict[str, list[float]]:
    """Return the numbers that stand for no value, by column: repeated, and far outside all others of their column."""
    found = {name: codes for name, column in columns.items() if (codes := _codes_in(column))}
    others = [np.setdiff1d(column, found.get(name, ())) for name, column in columns.items()]
    # A mapping leaves a code out of all columns.
    used = np.concatenate([*others, [0.0]])
    found = {name: [code for code in codes if code not in used] for name, codes in found.items()}
    return {name: codes for name, codes in found.items() if codes}


def _codes_in(column: Column) -> list[float]:
    values, counts = np.unique(column[np.isfinite(column)].astype(np.float64), return_counts=True)
    codes = []
    while values.size > _MAX_NOTCHES:
        gaps = values[1] - values[0], values[-1] - values[-2]
        end = 0 if gaps[0] > gaps[1] else -1
        others = np.delete(values, end)
        code, text = float(values[end]), _as_text(values[end])
        # How many ranges of all other numbers it is away from them; one not like a code may be a rare value.
        spans = 1.0 if _LIKE_CODE.fullmatch(text) else 5.0
        if counts[end] < 3 or gaps[end] <= spans * np.ptp(others):  # fewer are outliers
            break
        codes.append(code)
        values, counts = others, np.delete(counts, end)
    return codes


def _as_text(number: float) -> str:
    return np.format_float_positional(number, trim='-')


def _missing(codes: dict[str, list[float]]) -> list[Choice]:
    """Return what a mapping says of codes."""
    texts = sorted({_as_text(code) for some in codes.values() for code in some})
    said = [f'{", ".join(map(_as_text, some))} in {name}' for name, some in codes.items()]
    problem = f'{listed(said, 6)}: far outside all other numbers, so taken for no value'
    return (
        [Choice('missing', text=f'[{", ".join(texts)}]', head='missing: codes', decisions=[problem])] if codes else []
    )


def _series(name: str, column: Column, unit: str) -> NumberSeries:
    is_flag = column.dtype.kind == 'f' and bool(np.all(np.isin(column, (0.0, 1.0)) | np.isnan(column)))  # true, false
    is_whole = is_flag or (column.dtype.kind == 'i' and len(np.unique(column)) <= _MAX_NOTCHES)
    return NumberSeries('', unit, name, np.empty(0), np.empty(0), has_stamps=True, is_whole=is_whole)


class _Reader:
    def __init__(self, path: Path) -> None:
        self.mapping = Mapping()
        self.units: dict[str, str] = {}  # that the file states, by column
        self.zoned: set[str] = set()  # columns of times with a zone
        self.forms: dict[str, UnclearError] = {}  # columns of dates that may be read in several ways
        self.left_out: list[tuple[str, str]] = []
        self.is_vbox = path.suffix.lower() == VBOX_SUFFIX
        self._path = path
        self._problems: dict[str, str] = {}  # of columns that cannot be read
        self.form: list[Choice] = []  # what a mapping says of the form of the file
        self._others: tuple[str, ...] = ()  # columns of another decimal sign

    def find_decimal(self, names: Sequence[str]) -> None:
        """Find one decimal sign for all columns: any part of them might show another."""
        table = open_table(self._path, self.mapping)
        if not isinstance(table, CsvTable):
            return
        doubts = []
        try:
            sign, self._others, grouped = table.decimal_sign(names)
        except UnclearError as error:
            sign, grouped, doubts = error.choice, (), [str(error).removeprefix(f'{self._path}: ')]
        if sign:
            self.mapping = Mapping(csv=CsvFormat(decimal=sign))
        if grouped:
            doubts = [
                f'{listed(grouped, 6)}: all numbers are like 1.250, read as 1.25; csv: {{decimal: ","}} makes it 1250'
            ]
        if doubts or self._others:
            text = f'{{decimal: "{sign}"}}' if sign else ''
            head = 'csv: as written' if sign else 'csv: as found'
            self.form = [Choice('csv', text=text, head=head, decisions=doubts)]

    def columns(self, names: Sequence[str], form: str = '') -> dict[str, Column]:
        """Return the columns that can be read; ``form`` is that of a single one with times."""
        time = TimeColumn(tuple(names), find_unit('s', 'time'), format=form) if form else None
        table = open_table(self._path, replace(self.mapping, time=time))
        try:
            found = joined(islice(table.blocks(names), 10), names)
        except InputError as error:
            if len(names) > 1:
                half = len(names) // 2
                return self.columns(names[:half]) | self.columns(names[half:])
            if isinstance(error, UnclearError):
                self.forms[names[0]] = error
                return self.columns(names, error.choice)
            self._problems[names[0]] = str(error).removeprefix(f'{self._path}: ')
            is_other = names[0] in self._others
            self.left_out.append((names[0], 'another decimal sign' if is_other else 'no numbers or times'))
            return {}
        self.units |= table.units
        self.zoned |= {name for name, times in table.times.items() if times.has_zone}
        return found

    def why(self, columns: Iterable[str]) -> str:
        """Return why no column is a time, for up to two that are named like one; ``columns`` could be read."""
        rising = [f'column {name} does not rise from row to row' for name in columns if _is_named(name)]
        named = [text for name, text in self._problems.items() if _is_named(name)]
        problems = [*rising, *named] or list(self._problems.values())
        form = "; time: {format: '%d %b %Y %H:%M:%S.%f'} in a mapping says how other texts are written"
        return f'{"".join(f"; {text}" for text in problems[:2])}{form if named else ""}'


def _is_named(name: str) -> bool:
    return score('time', '', name) > 0.0


def _points(column: Column, series: NumberSeries) -> float:
    """Return how much speaks for a column as the time: its name and unit, and that it rises, evenly."""
    numbers = column.astype('datetime64[ns]').astype(np.int64) if column.dtype.kind in 'mM' else column
    steps = np.diff(numbers[np.isfinite(column)].astype(np.float64))
    if steps.size < 2 or np.mean(steps > 0.0) < 0.5 or np.mean(steps >= 0.0) < 0.9:
        return 0.0
    named = 2.0 * score('time', '', series.field) + float(bool(series.type and unit_in(series, 'time')))
    even = float(np.mean(np.abs(steps - np.median(steps)) < 0.1 * np.median(steps)))
    return named + {'M': 2.0, 'm': 1.0}.get(column.dtype.kind, 0.0) + (even if even > 0.9 else 0.1 * bool(named))


def _time(
    series: NumberSeries, column: Column, reader: _Reader, points: dict[str, float], columns: dict[str, Column]
) -> tuple[Choice, tuple[Column, Column]]:
    """Return the choice of the time, and its stamps with which are known; ``columns`` are the others."""
    name, choice = series.field, Choice('time', head=f'time: {series.field}')
    unit, form, words = 's', '', [f'field: {quoted(series.field)}']
    if column.dtype.kind in 'if':
        unit, form = _unit_of_time(series, column[np.isfinite(column)].astype(np.float64), choice, reader)
        words.append(f'format: {form}' if form else f'unit: {unit}')
    # A column of dates alone belongs to times of day.
    days = {other: x.astype('datetime64[D]') for other, x in columns.items() if x.dtype.kind == 'M'}
    known = {other: day[~np.isnat(day)] for other, day in days.items() if column.dtype.kind == 'm'}
    dates = [x for x, day in known.items() if day.size and np.all(day == columns[x][~np.isnat(columns[x])])][:1]
    words += [f'date: {quoted(date)}' for date in dates]
    if blank := sum(int(np.count_nonzero(np.isnat(columns[date]))) for date in dates):
        choice.decisions.append(f'{blank} of {len(column)} rows have no date and are left out; without date: none is')
    for of_form in (name, *dates):
        if of_form in reader.forms:
            form = reader.forms[of_form].choice
            words.append(f"format: '{form}'")
            choice.decisions.append(str(reader.forms[of_form]).partition(' = ')[2])
    if (column.dtype.kind == 'M' or dates or form == EXCEL) and name not in reader.zoned:
        choice.decisions.append('the zone of its clock, such as zone: Europe/Berlin; it is taken for UTC')
    elif form == CLOCK or column.dtype.kind == 'm':
        choice.decisions.append('the day, such as start: 2024-03-08T00:00:00Z; it is taken for 2000-01-01')
    choice.text = f'{{{", ".join(words)}}}'
    others = [other for other, value in points.items() if value > 0.9 and other != name]
    choice.decisions += [f'also like a time: {listed(others, 3)}'] if others else []
    clock = Clock(TimeColumn((name, *dates), find_unit(unit, 'time'), format=form))
    return choice, clock.stamps({name: column, **columns}, name, 0, has_zone=True)


# Since 1970 the least number in each unit [ns to s], from 1973 on, and the largest step from row to row in it.
_SINCE_1970: Final = {'ns': 1e17, 'us': 1e14, 'ms': 1e11, 's': 1e8}
_STEPS: Final = {'s': 2.0, 'ms': 2e3, 'us': 2e6, 'ns': np.inf}


def _unit_of_time(series: NumberSeries, numbers: Column, choice: Choice, reader: _Reader) -> tuple[str, str]:
    """Return the unit and the form of a time in numbers."""
    if stated := unit_in(series, 'time'):
        choice.reasons.append(f'unit {stated}: stated by the file')
        return stated, ''
    top, steps = float(np.median(numbers)), np.diff(numbers)
    step = float(np.median(steps[steps > 0.0]))
    parts = numbers // 10_000 / 24.0, numbers // 100 % 100 / 60.0, numbers % 100 / 60.0
    is_clock = all(np.all((part >= 0.0) & (part < 1.0)) for part in parts)
    # At each full minute such numbers jump by 40 more.
    if is_clock and (reader.is_vbox or np.any((steps > 40.0) & (steps < 41.0 + step))):
        choice.reasons.append(f'hours, minutes and seconds, such as {numbers[0]:.10g}')
        return 's', CLOCK
    if 20_000.0 < top < 60_000.0 and step < 1e-3:
        choice.reasons.append(f'days of a spreadsheet, such as {numbers[0]:.10g}')
        return 's', EXCEL
    for unit, least in _SINCE_1970.items():
        if top > least:
            choice.reasons.append(f'unit {unit}: since 1970 by its size')
            return unit, ''
    unit = next(unit for unit, most in _STEPS.items() if step <= most)
    choice.decisions.append(f'unit {unit} is only by its steps of {step:.3g}')
    return unit, ''
