# SPDX-License-Identifier: Apache-2.0
"""Departures from the usual level: their days, steps and ends."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from trainid_ros.fleet.changes import Change, Level, Series, Step, departures, usual_days

DAYS = 30
CHANNEL = Series(np.zeros(DAYS), np.ones(DAYS), 32.0, 2.0, 5.0)


def changes(*levels: tuple[int, float]) -> list[Change]:
    """Return changes from level 0 to others on given days, of one channel."""
    steps = [(0, 0.0), *levels]
    return [
        Change(day, day + 1, 20.0 + day, (Step(Level(before, 0.3), Level(after, 0.3), 20.0),))
        for (_, before), (day, after) in pairwise(steps)
    ]


def spans(*levels: tuple[int, float]) -> list[tuple[int, int | None, float]]:
    found = departures([CHANNEL], changes(*levels))
    return [(d.first, d.end, d.steps[0].size if d.steps[0] else 0.0) for d in found]


@pytest.mark.parametrize(
    ('levels', 'expected'),
    [
        ((), []),
        (((8, 6.0),), [(8, None, 6.0)]),
        (((8, 6.0), (20, 0.5)), [(8, 20, 6.0)]),
        (((8, 6.0), (12, 4.5), (20, 0.5)), [(8, 20, 6.0)]),
        (((8, 6.0), (20, 0.5), (25, 7.0)), [(8, 20, 6.0), (25, None, 7.0)]),
        (((8, 6.0), (20, -6.0)), [(8, 20, 6.0), (20, None, -6.0)]),
    ],
)
def test_departures_begin_and_end(
    levels: tuple[tuple[int, float], ...], expected: list[tuple[int, int | None, float]]
) -> None:
    assert spans(*levels) == expected


def test_a_table_may_begin_with_a_fault() -> None:
    back = [Change(9, 10, 30.0, (Step(Level(14.0, 0.3), Level(0.5, 0.3), 30.0),))]
    (found,) = departures([CHANNEL], back)
    assert (found.first, found.end, found.alarm) == (0, 9, 10)
    assert found.steps[0] is not None
    assert found.steps[0].size == 13.5
    assert usual_days([CHANNEL], back) == (9.0, np.inf)


def test_a_level_within_the_fleet_is_the_usual_one() -> None:
    assert usual_days([CHANNEL], changes((9, 4.0))) == (0.0, 9.0)
    assert usual_days([CHANNEL], []) == (0.0, np.inf)
