# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from trainid_ros.mapping.times import date_time_ns

NOON_NS = 1_709_899_200 * 10**9


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
        ('08/03/2024 12:00:00', None),
        ('12,5', None),
        ('1.5', None),
        ('20240308', None),
        ('2024-13-08T12:00:00', None),
        ('a-b-c', None),
    ],
)
def test_dates_are_read_to_the_nanosecond(text: str, expected: int | None) -> None:
    assert date_time_ns(text) == expected
