# SPDX-License-Identifier: Apache-2.0
"""The interval of a topic follows changes of rate, but not faults of single records."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.stream.topic_track import LearnedInterval

MS = 1_000_000
LONGEST = 1250 * MS


def learn(stamps_ms: list[int]) -> int:
    interval = LearnedInterval(LONGEST)
    for stamp in stamps_ms:
        interval.see(stamp * MS)
    return interval.ns


@pytest.mark.parametrize('interval_ms', [20, 100, 200, 250, 300, 500, 1000, 1250])
def test_the_interval_of_regular_stamps(interval_ms: int) -> None:
    assert learn([interval_ms * k for k in range(40)]) == (interval_ms * MS if interval_ms > 250 else 0)


@pytest.mark.parametrize('seed', range(5))
def test_jitter_changes_the_interval_only_slightly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = [1000 * k + int(rng.integers(-100, 101)) for k in range(40)]
    assert learn(stamps) == pytest.approx(1000 * MS, rel=0.12)


def test_the_interval_is_unknown_below_four_intervals_and_for_too_slow_topics() -> None:
    assert learn([]) == learn([5]) == learn([0, 1000, 2000, 3000]) == 0
    assert learn([0, 1000, 2000, 3000, 4000]) == 1000 * MS
    assert learn([1300 * k for k in range(40)]) == 0


@pytest.mark.parametrize('seed', range(20))
def test_lost_records_do_not_make_a_fast_topic_slow(seed: int) -> None:
    """5 Hz with jitter, a quarter of the records lost and dropouts of seconds: fast at all times except the start."""
    rng = np.random.default_rng(seed)
    interval = LearnedInterval(LONGEST)
    for k in range(5000):
        if rng.random() < 0.25 or k % 100 > 80:
            continue
        interval.see((200 * k + int(rng.integers(-40, 41))) * MS)
        assert k < 30 or interval.ns == 0


def test_bursts_and_late_records_leave_a_slow_topic_slow() -> None:
    assert learn(sorted([*range(0, 40_000, 1000), 20_001, 20_002, 35_001])) == 1000 * MS
    stamps = list(range(0, 40_000, 1000))
    stamps[30], stamps[33] = stamps[33], stamps[30]
    assert learn(stamps) == 1000 * MS


def test_a_topic_that_becomes_slower_is_followed_after_14_records_and_a_faster_one_after_3() -> None:
    interval = LearnedInterval(LONGEST)
    for k in range(100):
        interval.see(100 * MS * k)
    slower = [9900 * MS + 1000 * MS * k for k in range(1, 30)]
    found = []
    for stamp in slower:
        interval.see(stamp)
        found.append(interval.ns)
    assert found == [0] * 13 + [1000 * MS] * 16
    found.clear()
    for k in range(1, 8):
        interval.see(slower[-1] + 100 * MS * k)
        found.append(interval.ns)
    assert found == [1000 * MS] * 2 + [0] * 5


def test_cleared_equals_new() -> None:
    interval = LearnedInterval(LONGEST)
    for k in range(20):
        interval.see(1000 * MS * k)
    interval.clear()
    assert interval.ns == 0
    interval.see(0)
    interval.see(500 * MS)
    assert interval.ns == 0
