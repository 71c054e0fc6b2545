# SPDX-License-Identifier: Apache-2.0
"""Times of a table become stamps."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.mapping import TimeColumn
from trainid_ros.mapping.units import find_unit
from trainid_ros.tables.columns import Clock, Column, numbers

UNIX_2000 = 946_684_800
S = 10**9


def stamps(values: object, unit: str = 's', start_ns: int | None = None) -> list[int]:
    clock = Clock(TimeColumn(('t',), find_unit(unit, 'time'), start_ns))
    found, known = clock.stamps({'t': np.asarray(values)}, 'log.csv', 0)
    return [int(stamp) for stamp in found[known]]


@pytest.mark.parametrize(
    ('values', 'unit', 'expected'),
    [
        ([1_700_000_000.5], 's', [1_700_000_000 * S + S // 2]),
        ([1_700_000_000_123_456_789], 'ns', [1_700_000_000_123_456_789]),
        ([1_700_000_000_123_456], 'us', [1_700_000_000_123_456_000]),
        ([0, 250], 'ms', [UNIX_2000 * S, UNIX_2000 * S + S // 4]),
        ([0.0, np.nan, 1.5], 'min', [UNIX_2000 * S, (UNIX_2000 + 90) * S]),
        ([1], 'h', [(UNIX_2000 + 3600) * S]),
        (np.array(['2024-03-08T12:00', 'NaT'], dtype='datetime64[ns]'), 's', [1_709_899_200 * S]),
    ],
)
def test_times_are_stamps(values: object, unit: str, expected: list[int]) -> None:
    assert stamps(values, unit) == expected


def test_numbers_count_from_the_start_that_is_stated() -> None:
    assert stamps([0.0, 0.1], start_ns=5 * S) == [5 * S, 5 * S + S // 10]


def test_the_start_is_that_of_the_first_block() -> None:
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time')))
    clock.stamps({'t': np.array([0.0])}, 'log.csv', 0)
    later, _ = clock.stamps({'t': np.array([4e7])}, 'log.csv', 1)
    assert later.tolist() == [(UNIX_2000 + 40_000_000) * S]


@pytest.mark.parametrize(('values', 'unit'), [([1.7e9], 'h'), ([-1.0], 'h'), ([10**18], 'ms'), ([1e300], 's')])
def test_a_time_that_ros_cannot_hold_names_row_and_column(values: list[float], unit: str) -> None:
    with pytest.raises(InputError, match=r"log\.csv: row 1: column 't' = .* is no time between 1970 and 2038"):
        stamps([*values], unit, 0)


def test_times_of_day_go_on_through_midnight() -> None:
    hours = np.array([23, 'NaT', 1, 0.75, 23, 0], dtype=object)
    column = np.array([h if h == 'NaT' else int(h * 3600 * S) for h in hours], dtype='timedelta64[ns]')
    after = (23, 25, 24.75, 47, 48)  # a clock set back by a quarter of an hour is no midnight
    assert stamps(column) == [int((UNIX_2000 + h * 3600) * S) for h in after]
    assert stamps(column, start_ns=5 * S)[0] == (5 + 23 * 3600) * S
    clock = Clock(TimeColumn(('t',), find_unit('s', 'time')))
    found = [clock.stamps({'t': column[k : k + 1]}, 'log.csv', k)[0][0] for k in (0, 2)]
    assert found[1] - found[0] == 2 * 3600 * S  # also from block to block
    assert numbers(column[:1]).tolist() == [23 * 3600.0]


def test_times_are_numbers_for_functions() -> None:
    column: Column = np.array(['1970-01-01T00:00:01.5', 'NaT'], dtype='datetime64[ns]')
    assert numbers(column).tolist() == pytest.approx([1.5, np.nan], nan_ok=True)
