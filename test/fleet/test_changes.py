# SPDX-License-Identifier: Apache-2.0
"""Changes of made-up series, their causes, and departures from the usual level: their days, steps and ends."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from trainid_ros.fleet.changes import (
    Change,
    Level,
    Series,
    Step,
    _Segment,
    causes_of,
    departures,
    find_changes,
    usual_days,
)

LIMIT = 20_000.0
DAYS = 30


def series(value: np.ndarray, std: float = 1.0, degrees: float = 32.0) -> Series:
    return Series(value, np.full(value.size, std), degrees, 2.0, 5.0)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(DAYS)


def test_the_bayes_factor_is_that_of_its_definition() -> None:
    """With normal errors all integrals are known."""
    value = np.array([0.3, -0.5, 0.2, 4.1, 3.7])
    segment = _Segment(series(value, degrees=1e9), 2.0)
    n, k = 5, 3
    one = np.eye(n) + 4.0  # trains far from the others are rare, and do not count here
    after = np.zeros(n)
    after[k:] = 1.0
    two = one + 25.0 * np.outer(after, after)

    def log_p(cov: np.ndarray) -> float:
        return -0.5 * float(np.linalg.slogdet(cov)[1] + value @ np.linalg.solve(cov, value))

    found = segment.log_bayes(n, 1)
    assert found[k - 1] == pytest.approx(log_p(two) - log_p(one), abs=0.05)
    assert found[-1] == 0.0  # one day after it is not enough


def stepped(seed: int, size: float, first: int, end: int = DAYS) -> np.ndarray:
    """Return noise with a step between two days."""
    value = noise(seed)
    value[first:end] += size
    return value


def test_a_step_is_found_with_its_day_and_size() -> None:
    (change,) = find_changes([series(stepped(1, 6.0, 12)), series(noise(2))], LIMIT)
    assert change.day == 12
    assert 13 <= change.alarm <= 15
    step, other = change.steps
    assert step is not None
    assert other is not None
    assert step.size == pytest.approx(6.0, abs=1.2)
    assert step.evidence > 10.0
    assert other.evidence < 0.5


def test_a_repair_is_a_change_too_and_one_bad_day_is_none() -> None:
    assert [change.day for change in find_changes([series(stepped(3, 7.0, 8, 20))], LIMIT)] == [8, 20]
    assert find_changes([series(stepped(4, 25.0, 10, 11), degrees=4.0)], LIMIT) == []


def test_a_change_is_certain_after_its_day() -> None:
    """More data than those of the alarm may move the day, but not beyond it."""
    for seed in range(40, 60):
        value = stepped(seed, 5.0, 12, 13)
        value[13:] += 3.0
        for change in find_changes([series(value)], 20.0):
            assert change.day < change.alarm


def test_missing_days_and_channels_do_not_count() -> None:
    gaps = stepped(5, 6.0, 12)
    gaps[::3] = math.nan
    (change,) = find_changes([series(gaps), series(np.full(DAYS, math.nan))], LIMIT)
    assert change.day in (12, 13)
    assert change.steps[1] is None


def test_weak_steps_in_two_channels_add_up() -> None:
    one, two = stepped(6, 2.5, 15), stepped(7, -2.5, 15)
    alone = [find_changes([series(value)], LIMIT)[0].evidence for value in (one, two)]
    (both,) = find_changes([series(one), series(two)], LIMIT)
    assert both.evidence > max(alone) + 5.0


def test_false_alarms_are_as_rare_as_stated() -> None:
    """With a limit of 100 train-days, fewer than 1 % of the days bring an alarm."""
    runs = 120
    alarms = sum(len(find_changes([series(noise(100 + seed))], 100.0)) for seed in range(runs))
    assert alarms / (runs * DAYS) < 0.01


STD = {'w15': 0.02, 'brake_rate': 0.006, 'force_scale': 0.004, 'wheel_ratio': 0.0003}


@pytest.mark.parametrize(
    ('steps', 'effect'),
    [
        ({'w15': 0.25}, 'dragging_brake'),
        ({'w15': 0.7, 'brake_rate': -0.035}, 'dragging_brake'),
        ({'w15': -0.25}, 'resistance_step'),
        ({'brake_rate': -0.1}, 'brake_scale'),
        ({'wheel_ratio': 0.02, 'force_scale': 0.021, 'brake_rate': 0.017, 'w15': 0.03}, 'wheel_diameter'),
        ({'force_scale': -0.07, 'brake_rate': -0.068}, 'mass_error'),
        ({'force_scale': -0.07}, 'traction_scale'),
        ({'w15': 0.3, 'wheel_ratio': 0.05, 'brake_rate': -0.2}, 'other'),
    ],
)
def test_causes_are_known_by_their_channels(steps: dict[str, float], effect: str) -> None:
    best = causes_of({name: (steps.get(name, 0.0), std) for name, std in STD.items()})[0]
    assert best.effect == effect
    assert best.probability > 0.8


def test_without_a_resistance_no_brake_drags() -> None:
    weaker = {'w15': None, 'brake_rate': (-0.015, 0.003), 'force_scale': None, 'wheel_ratio': None}
    assert 'dragging_brake' not in {cause.effect for cause in causes_of(weaker)}


def test_without_the_wheel_ratio_weighing_and_wheels_look_alike() -> None:
    steps = {'w15': (0.0, 0.02), 'brake_rate': (0.02, 0.006), 'force_scale': (0.02, 0.004), 'wheel_ratio': None}
    assert {cause.effect for cause in causes_of(steps)} >= {'wheel_diameter', 'mass_error'}


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


def test_departures_begin_and_end() -> None:
    assert spans() == []
    assert spans((8, 6.0)) == [(8, None, 6.0)]
    assert spans((8, 6.0), (20, 0.5)) == [(8, 20, 6.0)]
    assert spans((8, 6.0), (12, 4.5), (20, 0.5)) == [(8, 20, 6.0)]
    assert spans((8, 6.0), (20, 0.5), (25, 7.0)) == [(8, 20, 6.0), (25, None, 7.0)]
    assert spans((8, 6.0), (20, -6.0)) == [(8, 20, 6.0), (20, None, -6.0)]


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
