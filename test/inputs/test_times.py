# SPDX-License-Identifier: Apache-2.0
"""Times in texts of many forms, and clocks of local time with their changes."""

from __future__ import annotations

from datetime import UTC

import numpy as np
import pytest

from trainid_ros.inputs.times import LocalClock, TextTimes, date_time, find_zone, time_of_day_ns
from trainid_ros.interface.errors import InputError

NOON_NS = 1_709_899_200 * 10**9
TENTHS_NS = 43_200_900_000_000


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('2024-03-08T12:00:00Z', NOON_NS),
        ('2024-03-08 12:00:00', NOON_NS),
        ('2024-03-08T13:00:00+01:00', NOON_NS),
        ('2024-03-08T12:00:00.123456789Z', NOON_NS + 123_456_789),
        ('2024-03-08T13:00:00,5+01:00', NOON_NS + 500_000_000),
        ('2024-03-08', NOON_NS - 12 * 3600 * 10**9),
        ('8.3.2024 12:00:00,25', NOON_NS + 250_000_000),
        ('08.03.2024', NOON_NS - 12 * 3600 * 10**9),
        ('2024-03-08 12:00:00:900', NOON_NS + 900_000_000),
        ('08.03.2024 12:00:00:009', NOON_NS + 9_000_000),
        ('2024-03-08T13:00:00:900+01:00', NOON_NS + 900_000_000),
        ('2024-03-08T120000.5Z', NOON_NS + 500_000_000),
        ('20240308T120000', NOON_NS),
        ('20240308T120000Z', NOON_NS),
        ('20240308 120000.5', NOON_NS + 500_000_000),
        ('2024-03-08 12', NOON_NS),
        ('2024年3月8日 12:00:00.5', NOON_NS + 500_000_000),
        ('2024年03月08日', NOON_NS - 12 * 3600 * 10**9),
        ('Fri Mar  8 12:00:00 2024', NOON_NS),
        ('Fri Mar  8 12:00:00.25 UTC 2024', NOON_NS + 250_000_000),
        ('2024-03-08-12:00:00', NOON_NS),
        ('Fri Mar  8 12:00:00 CET 2024', None),
        ('Fri Mai  8 12:00:00 2024', None),
        # Only a part of these would be used, or not as what it is.
        ('2024-03-08 12:00:00:9', None),
        ('2024-03-08 12:00:00:900:1', None),
        ('2024-03-08 12:00:00.123.456', None),
        ('2024-03-08 12:00:00.123:456', None),
        ('2024-03-08 12:00.5', None),
        ('2024-03-08 12:00:00+01:00:30.5', None),
        ('08/03/2024 12:00:00', None),
        ('12,5', None),
        ('1.5', None),
        ('20240308', None),
        ('2024-13-08T12:00:00', None),
        ('a-b-c', None),
    ],
)
def test_dates_are_read_to_the_nanosecond(text: str, expected: int | None) -> None:
    stamp = date_time(text)
    assert (stamp and stamp.ns) == expected


@pytest.mark.parametrize(
    ('text', 'expected_ns'),
    [('12:00:00:900', TENTHS_NS), ('12:00:00,9', TENTHS_NS), ('12:00:00:9', None), ('12:00:00.9:1', None)],
)
def test_a_time_of_day_is_read_whole_or_not_at_all(text: str, expected_ns: int | None) -> None:
    assert time_of_day_ns(text) == expected_ns


@pytest.mark.parametrize(
    ('text', 'hours'),
    [('12:00:00 AM', 0), ('1:00:00 am', 1), ('12:00:00 PM', 12), ('11:00:00 p.m.', 23), ('13:00:00 PM', None)],
)
def test_hours_with_am_and_pm(text: str, hours: int | None) -> None:
    assert time_of_day_ns(text) == (None if hours is None else hours * 3600 * 10**9)


def where(index: int) -> str:
    return f'row {index + 1}'


def stamps_of(texts: list[str], form: str = '') -> list[int]:
    found = TextTimes(form).read(texts, where)
    assert found is not None
    return [int(time) for time in found.astype(np.int64)]


@pytest.mark.parametrize(
    ('texts', 'form'),
    [
        (['14/11/2023 23:13:20', '14/11/2023 23:13:20.25'], ''),
        (['11/14/2023 11:13:20 PM', '11/14/2023 11:13:20.25 PM'], ''),
        (['2023/11/14 23:13:20', '2023/11/14 23:13:20,25'], ''),
        (['2023-11-14 11:13:20 PM', '2023-11-14 11:13:20:250 PM'], ''),
        (['14.11.23 23:13:20', '14.11.23 23:13:20.25'], ''),
        (['14-Nov-2023 23:13:20', '14-Nov-2023 23:13:20.25'], ''),
        (['2023/11/14-23:13:20', '2023/11/14-23:13:20.25'], ''),
        (['2023/11/14-23:13:20.00', '2023/11/14-23:13:20.25'], '%Y/%m/%d-%H:%M:%S.%f'),
        (['Tue Nov 14 23:13:20 2023', 'Tue Nov 14 23:13:20.25 2023'], ''),
        (['14/11/23 23:13:20', '14/11/23 23:13:20.25'], '%d/%m/%y'),
        (['11/14/23 23:13:20', '11/14/23 23:13:20.25'], ''),
        (['14 Nov 2023 11:13:20 PM', '14 Nov 2023 11:13:20.25 PM'], '%d %b %Y'),
        (['2023年11月14日 23:13:20', '2023年11月14日 23:13:20.25'], '%Y年%m月%d日'),
        (['20231114231320.00', '20231114231320.25'], '%Y%m%d%H%M%S.%f'),
        (['2023-11-15T00:13:20.00+0100', '2023-11-15T00:13:20.25+0100'], '%Y-%m-%dT%H:%M:%S.%f%z'),
    ],
)
def test_dates_of_many_forms_are_read(texts: list[str], form: str) -> None:
    assert stamps_of(texts, form) == [1_700_003_600 * 10**9, 1_700_003_600 * 10**9 + 250_000_000]


@pytest.mark.parametrize(('texts', 'day'), [(['14.11.23', '15.11.23'], 19_675), (['30.11.99', '01.12.99'], 10_925)])
def test_a_date_with_dots_alone_may_have_a_year_of_two_digits(texts: list[str], day: int) -> None:
    assert stamps_of(texts, '') == [day * 86_400 * 10**9, (day + 1) * 86_400 * 10**9]


def test_a_form_of_a_time_of_day() -> None:
    assert stamps_of(['23.13.20'], '%H.%M.%S') == [83_600 * 10**9]


@pytest.mark.parametrize(
    ('texts', 'forms'),
    [
        (['03/04/2024 12:00:00'], "{format: '%d/%m/%Y'} or {format: '%m/%d/%Y'}"),
        (['03/04/2024 08:15:00 AM'], "{format: '%m/%d/%Y'} or {format: '%d/%m/%Y'}"),
        (['14/11/23 12:00:00'], "{format: '%d/%m/%y'} or {format: '%y/%m/%d'}"),
        (['05/05/2024 12:00:00', '06/05/2024 12:00:00'], "{format: '%d/%m/%Y'} or {format: '%m/%d/%Y'}"),
    ],
)
def test_an_order_of_days_that_is_not_clear_is_asked_for(texts: list[str], forms: str) -> None:
    times = TextTimes()
    with pytest.raises(InputError, match=r'row 1 = .* several orders') as error:
        times.read(texts, where)
    assert forms in str(error.value)


def test_the_order_of_days_is_that_of_the_first_rows() -> None:
    times = TextTimes()
    times.read(['31/05/2024 23:59:59'], where)
    found = times.read(['01/06/2024 00:00:00'], where)
    assert found is not None
    assert found[0] == np.datetime64('2024-06-01T00:00:00')


def test_a_cell_of_another_form_is_named() -> None:
    with pytest.raises(InputError, match=r"row 2 = '14/13/2024 12:00:00' is not a time like %d/%m/%Y; so"):
        TextTimes().read(['14/11/2023 12:00:00', '14/13/2024 12:00:00'], where, '; so')
    with pytest.raises(InputError, match=r"row 2 = '2024-03-08T12:00:00' is not a date"):
        TextTimes().read(['2024-03-08T12:00:00Z', '2024-03-08T12:00:00'], where)
    assert TextTimes().read(['noon'], where) is None


@pytest.mark.parametrize('text', ['Europe/Berlim', '+25', ''])
def test_a_zone_has_a_name_or_an_offset(text: str) -> None:
    with pytest.raises(ValueError, match='is no zone like'):
        find_zone(text)


def local(*texts: str) -> np.ndarray:
    return np.array(texts, dtype='datetime64[ns]').astype(np.int64)


def in_utc(zone: str, *blocks: tuple[str, ...]) -> list[str]:
    """Return local times of blocks in UTC, as texts of hours and minutes."""
    clock = LocalClock(find_zone(zone))
    found = np.concatenate([clock.utc(local(*block), where) for block in blocks])
    return [str(text)[11:16] for text in found.astype('datetime64[ns]')]


def test_a_clock_of_local_time_is_followed_through_the_year() -> None:
    assert in_utc('Europe/Berlin', ('2024-01-08T12:00',), ('2024-07-08T12:00',)) == ['11:00', '10:00']
    assert in_utc('+05:30', ('2024-01-08T12:00',)) == ['06:30']


@pytest.mark.parametrize(
    ('blocks', 'expected'),
    [
        ((('02:59:59', '02:00:00', '02:30:00'),), ['00:59', '01:00', '01:30']),
        ((('01:59:59', '02:00:00'), ('02:59:59',), ('02:00:00', '02:59:59', '03:00:00')), None),
        ((('01:59:59', '02:00:00', '02:59:30'), ('02:59:59', '02:00:00'), ('02:00:30',)),
         ['23:59', '00:00', '00:59', '00:59', '01:00', '01:00']),
        ((('02:59:59', '03:00:00'),), ['01:59', '02:00']),
    ],
)  # fmt: skip
def test_rows_before_and_after_show_which_hour_it_is(
    blocks: tuple[tuple[str, ...], ...], expected: list[str] | None
) -> None:
    whole = [tuple(f'2024-10-27T{text}' for text in block) for block in blocks]
    if expected is None:  # what follows after a gap of an hour
        with pytest.raises(InputError, match='twice'):
            in_utc('Europe/Berlin', *whole)
    else:
        assert in_utc('Europe/Berlin', *whole) == expected


@pytest.mark.parametrize(
    ('zone', 'times', 'error'),
    [
        ('Europe/Berlin', ('2024-10-27T02:30:00', '2024-10-27T02:30:01'), r'row 1: .* show this hour twice'),
        ('Europe/Berlin', ('2024-10-27T01:30:00', '2024-10-27T02:30:01'), r'row 2: .* show this hour twice'),
        (
            'Europe/Berlin',
            ('2024-03-31T02:30:00',),
            r'row 1: .* twice or not at all',
        ),
        ('', ('2024-10-27T02:59:59.5', '2024-10-27T02:00:00'), 'row 2: the clock steps by an hour'),
        ('', ('2024-03-31T01:59:59.5', '2024-03-31T03:00:00'), 'row 2: the clock steps by an hour'),
    ],
)
def test_a_time_that_may_be_several_is_never_guessed(zone: str, times: tuple[str, ...], error: str) -> None:
    clock = LocalClock(find_zone(zone) if zone else None)
    with pytest.raises(InputError, match=error):
        clock.utc(local(*times), where)
    assert LocalClock(UTC).utc(local(*times), where).tolist() == local(*times).tolist()
