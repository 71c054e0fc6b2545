# SPDX-License-Identifier: Apache-2.0
"""Dates with time as text, ISO 8601 or day.month.year, to the nanosecond."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Final

from trainid_ros.interface.records import NS_PER_S

_FRACTION: Final = re.compile(r'[.,](\d{1,9})\d*')
_DOTTED: Final = re.compile(r'^(\d\d?)\.(\d\d?)\.(\d{4})\b')
_TIME_OF_DAY: Final = re.compile(r'([01]?\d|2[0-3]):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9})\d*)?')
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def date_time_ns(text: str) -> int | None:
    """Return a date with time as stamp [ns], None if the text is none; without a zone it is UTC."""
    text = _DOTTED.sub(lambda found: f'{found[3]}-{found[2]:>02}-{found[1]:>02}', text)
    if text.count('-') < 2:  # datetime also takes 20240308
        return None
    fraction = _FRACTION.search(text)
    try:
        when = datetime.fromisoformat(_FRACTION.sub('', text, count=1))
    except ValueError:
        return None
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - _EPOCH
    part_ns = 0 if fraction is None else int(fraction[1].ljust(9, '0'))
    return (since.days * 86400 + since.seconds) * NS_PER_S + part_ns


def time_of_day_ns(text: str) -> int | None:
    """Return a time of day as time since midnight [ns], None if the text is none."""
    if (found := _TIME_OF_DAY.fullmatch(text)) is None:
        return None
    hours, minutes, seconds, fraction = found.groups(default='')
    return ((int(hours) * 60 + int(minutes)) * 60 + int(seconds)) * NS_PER_S + int(fraction.ljust(9, '0'))
