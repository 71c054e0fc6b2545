# SPDX-License-Identifier: Apache-2.0
"""Times as loggers write them: texts of many forms, and clocks that show local time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta, tzinfo
from functools import lru_cache
from typing import Any, Final, NamedTuple, TypeAlias
from zoneinfo import ZoneInfo, available_timezones

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import DAY_NS, NS_PER_S
from trainid_ros.train.fields import did_you_mean, shown

Times: TypeAlias = NDArray[Any]
"""Dates with time as datetime64[ns], times of day as timedelta64[ns]; NaT where a cell is blank."""
EXCEL: Final = 'excel'
"""Name of the form of days since 1899-12-30, as spreadsheets count."""
CLOCK: Final = 'HHMMSS'
"""Name of the form of numbers like 231320.25."""
_QUARTER_NS: Final = 900 * NS_PER_S  # at which offsets of zones change
# After the seconds of a time, not of a zone; some loggers write milliseconds after a colon.
_FRACTION: Final = re.compile(
    r'(?:(?<=[^+-]\d\d:\d\d:\d\d)|(?<=[^+\-\d]\d{6}))(?:[.,](\d{1,9})\d*|:(\d{3}))(?![\d.,:])'
)
_UNDIVIDED: Final = re.compile(r'^(\d{4})(\d\d)(\d\d)(?=[T ]\d{2,6}(?!\d))')
_CHINESE: Final = re.compile(r'^(\d{4})年(\d\d?)月(\d\d?)日 ?')
_DOTTED: Final = re.compile(r'^(\d\d?)\.(\d\d?)\.(\d{4})\b')
# As asctime of C and ``date`` of Unix write it, such as Tue Nov 14 23:13:20 UTC 2023.
_UNIX: Final = re.compile(r'^[A-Z][a-z]{2} ([A-Z][a-z]{2}) {1,2}(\d\d?) (\S+) (?:(?:UTC|GMT)() )?(\d{4})$')
_MONTHS: Final = ('Jan', 'Feb', 'Mar', 'Apr', 'May', 'Jun', 'Jul', 'Aug', 'Sep', 'Oct', 'Nov', 'Dec')
# A date and the dash before its clock; one of a zone has no seconds.
_DASHED: Final = re.compile(r'^(\d{1,4}([./-])\w{1,3}\2\d{1,4})-(?=\d\d?:\d\d:\d\d)')
# As Excel saves times with a fraction: the hour is lost.
_NO_HOUR: Final = re.compile(r'[0-5]?\d:[0-5]\d([.,])\d{1,6}')
_TIME_OF_DAY: Final = re.compile(
    r'([01]?\d|2[0-3]):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9})\d*|:(\d{3}))?(?: ?([AP])\.?M\.?)?', re.IGNORECASE
)


class Stamp(NamedTuple):
    """A date with time."""

    ns: int  # Since 1970 [ns], of a clock in UTC unless the text has a zone
    has_zone: bool


def date_time(text: str) -> Stamp | None:
    """Return a date with time of ISO 8601, with dots, or as Unix writes it; None if the text is none."""
    if (words := _UNIX.match(text)) is not None and words[1] in _MONTHS:
        month = _MONTHS.index(words[1]) + 1
        text = f'{words[5]}-{month:02}-{words[2]:>02} {words[3]}{"" if words[4] is None else "Z"}'
    text = _DASHED.sub(r'\1 ', text)
    text = _DOTTED.sub(lambda found: f'{found[3]}-{found[2]:>02}-{found[1]:>02}', text)
    text = _CHINESE.sub(lambda found: f'{found[1]}-{found[2]:>02}-{found[3]:>02} ', text).rstrip()
    text = _UNDIVIDED.sub(r'\1-\2-\3', text)
    if text.count('-') < 2:  # datetime also takes 20240308
        return None
    fraction = _FRACTION.search(text)
    try:
        when = datetime.fromisoformat(_FRACTION.sub('', text, count=1))
    except ValueError:
        return None
    if (whole_ns := _since_1970(when)) % NS_PER_S:  # of something else than a fraction, such as a second one
        return None
    return Stamp(whole_ns + _part_ns(fraction.groups() if fraction else ()), when.tzinfo is not None)


def time_of_day_ns(text: str) -> int | None:
    """Return a time of day as time since midnight [ns], None if the text is none."""
    if (found := _TIME_OF_DAY.fullmatch(text)) is None:
        return None
    hours, minutes, seconds, *fraction, half = found.groups()
    hour = int(hours)
    if half:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (half in 'pP')
    return ((hour * 60 + int(minutes)) * 60 + int(seconds)) * NS_PER_S + _part_ns(fraction)


def is_time(text: str) -> bool:
    """Return whether a text is a time of day, or starts with a date."""
    of_day = time_of_day_ns(text) is not None or _NO_HOUR.fullmatch(text) is not None
    return of_day or date_time(text) is not None or _DATE.match(_DASHED.sub(r'\1 ', text)) is not None


def _part_ns(fraction: Iterable[str | None]) -> int:
    """Return the digits after the seconds, the first that are there, in nanoseconds."""
    digits = next(filter(None, fraction), '')
    return int(digits.ljust(9, '0'))


def _since_1970(when: datetime) -> int:
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return since // timedelta(microseconds=1) * 1000


# Before a clock, or alone; 1.2.3 alone is a version.
_DATE: Final = re.compile(r'\d{1,4}(?:([./-])\w{1,3}\1\d{1,4} |([/-])\w{1,3}\2\d{1,4}$)|\d\d(\.)\d\d\.\d\d$')
# Orders of dates; with dots the day comes first everywhere.
_ORDERS: Final = ('%d %m %Y', '%d %m %y', '%Y %m %d', '%d %b %Y', '%m %d %Y', '%m %d %y', '%y %m %d')
_OF_DAY: Final = 'time of day'
_ISO: Final = 'date with time'


class UnclearError(InputError):
    """A file may be read in several ways; ``choice`` is the likeliest, as a mapping would say it."""

    def __init__(self, problem: str, choice: str) -> None:
        super().__init__(problem)
        self.choice = choice


@lru_cache(1 << 12)
def _parsed_ns(text: str, form: str) -> int | None:
    try:
        return _since_1970(datetime.strptime(text, form))
    except ValueError:
        return None


class TextTimes:
    """Reads the times in the texts of one column, block by block; all have one form.

    A form is that of ``strptime``. One of a date alone takes whatever clock stands after it, and midnight without one.
    """

    def __init__(self, form: str = '') -> None:
        """Take the form, '' if the first texts show it."""
        self.form, self.has_zone = form, '%z' in form  # whether the texts state their zone

    def read(self, cells: Sequence[str], where: Callable[[int], str], hint: str = '') -> Times | None:
        """Return the times in cells, of which blank ones are ''; None if they are no times.

        InputError, naming ``where`` by index, for a later cell that is no such time; UnclearError where day and month
        may be confused.
        """
        texts = [cell for cell in cells if cell]
        self.form = self.form or (self._found(texts, where(0)) if texts else '')
        if not texts or not self.form:
            return None
        found = [self._ns(cell) if cell else None for cell in cells]
        for index, (cell, time_ns) in enumerate(zip(cells, found, strict=True)):
            if time_ns is None and cell:
                what = self.form if self.form in {_OF_DAY, _ISO} else f'time like {self.form}'
                raise InputError(f'{where(index)} = {shown(cell)} is not a {what}{hint}')
        is_date = self.form == _ISO or any(part in self.form for part in ('%d', '%j'))
        kind = 'datetime64[ns]' if is_date else 'timedelta64[ns]'
        return np.array(['NaT' if time_ns is None else time_ns for time_ns in found], dtype=kind)

    def _found(self, texts: Sequence[str], where: str) -> str:
        """Return the form of texts, '' if the first is no time."""
        if time_of_day_ns(texts[0]) is not None:
            return _OF_DAY
        if (stamp := date_time(texts[0])) is not None:
            self.has_zone = stamp.has_zone
            return _ISO
        if (lacking := _NO_HOUR.fullmatch(texts[0])) is not None:
            form = f'%M:%S{lacking[1]}%f'
            raise UnclearError(
                f'{where} = {shown(texts[0])}: the hour is missing, as where Excel saves times with a fraction; '
                f"time: {{format: '{form}'}} in the mapping counts the hours from the first row on",
                form,
            )
        texts = [_DASHED.sub(r'\1 ', text) for text in texts]
        if (found := _DATE.match(texts[0])) is None:
            return ''
        dates = tuple(dict.fromkeys(text.partition(' ')[0] for text in texts))
        sign = next(filter(None, found.groups()))
        forms = [x.replace(' ', sign) for x in _ORDERS if sign != '.' or x[1] in 'Yd']
        forms = [form for form in forms if _parsed_ns(dates[0], form) is not None]
        all_fit = [form for form in forms if all(_parsed_ns(date, form) is not None for date in dates)]
        if texts[0].upper().endswith(('AM', 'PM')):  # in America
            all_fit.sort(key=lambda form: not form.startswith('%m'))
        if len(all_fit) > 1:
            raise UnclearError(
                f'{where} = {shown(texts[0])}: day, month and year may have several orders; time: '
                f'{" or ".join(f"{{format: {form!r}}}" for form in all_fit)} in the mapping says which',
                all_fit[0],
            )
        return (*all_fit, *forms, '')[0]

    def _ns(self, text: str) -> int | None:
        if self.form == _OF_DAY:
            return time_of_day_ns(text)
        if self.form == _ISO:
            stamp = date_time(text)
            return stamp.ns if stamp is not None and stamp.has_zone == self.has_zone else None
        if any(part in self.form for part in ('%H', '%I', '%M')):
            time_ns = _parsed_ns(text, self.form)
            return time_ns if time_ns is None or '%d' in self.form or '%j' in self.form else time_ns % DAY_NS
        words, count = _DASHED.sub(r'\1 ', text).split(' '), self.form.count(' ') + 1
        day_ns, clock = _parsed_ns(' '.join(words[:count]), self.form), ' '.join(words[count:])
        of_day_ns = time_of_day_ns(clock) if clock else 0
        return None if day_ns is None or of_day_ns is None else day_ns + of_day_ns


def find_zone(text: str) -> tzinfo:
    """Return a zone by its name, such as Europe/Berlin, or its offset, such as +01:00; ValueError if it is neither."""
    with suppress(ValueError):
        return datetime.strptime(text, '%z').tzinfo or UTC
    with suppress(ValueError, OSError, KeyError):  # the last where there is none
        return ZoneInfo(text)
    raise ValueError(f'is no zone like Europe/Berlin or +01:00; {did_you_mean(text, (*available_timezones(), "UTC"))}')


_RUNS_ON_NS: Final = 60 * NS_PER_S  # between rows of a clock that runs on, at most; far less than an hour


class LocalClock:
    """Turns the local times of rows, in their order, into UTC.

    Without a zone they stay as they are: their differences are right except where summer time begins or ends.
    """

    def __init__(self, zone: tzinfo | None) -> None:
        self._zone = zone
        self._last_ns: int | None = None  # of the rows so far

    def utc(self, local_ns: NDArray[np.int64], where: Callable[[int], str]) -> NDArray[np.int64]:
        """Return times in UTC [ns], shape (n,); InputError, naming ``where`` by index, if they may be several."""
        if not local_ns.size:
            return local_ns
        if self._zone is None:
            first_ns, self._last_ns = local_ns[0] if self._last_ns is None else self._last_ns, int(local_ns[-1])
            jumps = (
                np.abs(np.abs(np.diff(local_ns, prepend=first_ns)) - 4 * _QUARTER_NS) < 2 * NS_PER_S
            )  # or a row more
            if not jumps.any():
                return local_ns
            raise InputError(
                f'{where(int(np.argmax(jumps)))}: the clock steps by an hour, as at a change of summer time; time: '
                '{zone: Europe/Berlin} or {zone: UTC} in the mapping says which zone it shows'
            )
        quarters, place = np.unique(local_ns // _QUARTER_NS, return_inverse=True)
        early, late = (np.array([self._offset_ns(x, fold) for x in quarters.tolist()])[place] for fold in (0, 1))
        found = local_ns - early
        # Rows whose times may be several, in pieces in which the clock is not set back.
        rows = np.flatnonzero(early != late)
        breaks = np.flatnonzero((np.diff(rows) > 1) | (np.diff(local_ns[rows]) < -2 * _QUARTER_NS)) + 1
        for unclear in (piece for piece in np.split(rows, breaks) if piece.size):
            piece = slice(int(unclear[0]), int(unclear[-1]) + 1)
            found[piece] -= self._correction(piece, found, local_ns - late, where)
        self._last_ns = int(found[-1])
        return np.asarray(found)

    def _correction(
        self, piece: slice, found: NDArray[np.int64], late: NDArray[np.int64], where: Callable[[int], str]
    ) -> int:
        """Return what to subtract from the times of rows in an hour that is there twice [ns]: 0 for the first one.

        ``found`` has such rows, from these on, in the first hour, ``late`` in the second one. InputError if no row
        within a minute before or after them shows which it is.
        """
        first, last = piece.start, piece.stop - 1
        before = self._last_ns if first == 0 else int(found[first - 1])
        by = int(found[first] - late[first])
        shown_by = []
        for shift in (0, by):
            after_ns = int(late[last + 1] - found[last]) + shift if piece.stop < found.size else -1
            before_ns = -1 if before is None else int(found[first]) - shift - before
            if any(0 <= gap_ns < _RUNS_ON_NS for gap_ns in (before_ns, after_ns)):
                shown_by.append(shift)
        if by > 0 or len(shown_by) != 1:  # by > 0 is an hour that is left out in spring
            raise InputError(
                f'{where(first)}: the clocks of {self._zone} show this hour twice or not at all; '
                "time: {zone: '+01:00'} or another offset in the mapping says which it is"
            )
        return shown_by[0]

    def _offset_ns(self, quarter: int, fold: int) -> int:
        local = datetime(1970, 1, 1) + timedelta(seconds=900 * quarter)
        offset = local.replace(tzinfo=self._zone, fold=fold).utcoffset() or timedelta()
        return round(offset.total_seconds()) * NS_PER_S
