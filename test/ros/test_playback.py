# SPDX-License-Identifier: Apache-2.0
"""The timeline has clock ticks in its gaps and keeps its pace."""

from __future__ import annotations

from trainid_ros.records import NS_PER_S, ForceRecord
from trainid_ros.ros.playback import Pacer, TimedRecord, Timeline, with_ticks

MS = NS_PER_S // 1000


def timeline(*times_ms: int) -> Timeline:
    entries = [TimedRecord(t * MS, ForceRecord(t * MS, float(t))) for t in times_ms]
    return Timeline(times_ms[0] * MS, times_ms[-1] * MS, lambda: iter(entries))


def test_gaps_are_filled_with_ticks_and_records_stay_in_order() -> None:
    out = list(with_ticks(timeline(1000, 1000, 1170, 1200), 0.0, 0.0))
    assert [entry.time_ns // MS for entry in out] == [1000, 1000, 1050, 1100, 1150, 1170, 1200, 1200]
    assert [entry.record is not None for entry in out] == [True, True, False, False, False, True, True, False]


def test_start_and_duration_cut_the_timeline() -> None:
    out = list(with_ticks(timeline(1000, 1100, 1200, 1300), 0.1, 0.1))
    assert [entry.time_ns // MS for entry in out if entry.record is not None] == [1100, 1200]
    assert out[-1] == TimedRecord(1200 * MS, None)


def test_the_pace_does_not_drift() -> None:
    pacer = Pacer(4.0)
    assert pacer.due_ns(1000 * MS, 50 * MS) == 50 * MS
    assert pacer.due_ns(9000 * MS, 51 * MS) == 2050 * MS
    # A late callback does not change when the next entry is due.
    assert pacer.due_ns(9400 * MS, 2080 * MS) == 2150 * MS


def test_after_a_long_stall_the_pacer_restarts_without_a_burst() -> None:
    pacer = Pacer(1.0)
    pacer.due_ns(0, 0)
    assert pacer.due_ns(100 * MS, 5000 * MS) == 5000 * MS
    assert pacer.due_ns(300 * MS, 5001 * MS) == 5200 * MS


def test_released_entries_are_due_at_once() -> None:
    pacer = Pacer(1.0)
    pacer.due_ns(0, 0)
    pacer.release()
    assert pacer.due_ns(7000 * MS, 20 * MS) == 20 * MS
