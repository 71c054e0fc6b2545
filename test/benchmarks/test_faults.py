# SPDX-License-Identifier: Apache-2.0
"""The fault matrix: what its faults do to rows, and one trial."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from benchmarks.fault_matrix import Injection, judge
from benchmarks.faults import BY_NAME, FAULTS, PAIRS, injected
from benchmarks.scenarios import ride
from trainid_ros.interface.records import BRAKE, FORCE, GRADIENT, MASS, NS_PER_S, SPEED, Row
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample

SECOND = NS_PER_S
SEED = 4001


def rows(seconds: int = 60) -> list[Row]:
    """Rows of all topics at 5 Hz, in the order of stamps; the values count up, those of the force down."""
    return [
        (topic, (k * 5 + topic) * SECOND // 25, float(-k - 1 if topic == FORCE else k + 1), 10.0 * k, False)
        for k in range(seconds * 5)
        for topic in (SPEED, FORCE, GRADIENT, BRAKE, MASS)
    ]


def sent(name: str) -> list[Row]:
    """The rows with a fault from 20 to 40 s."""
    return injected(rows(), [BY_NAME[name]], 20 * SECOND, 40 * SECOND)


def of(topic: int, some: list[Row]) -> list[Row]:
    return [row for row in some if row[0] == topic]


@pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)
def test_a_fault_changes_nothing_before_it_and_something_after(fault: object) -> None:
    changed = injected(rows(), [fault], 20 * SECOND, 40 * SECOND)  # type: ignore[list-item]
    before = [row for row in rows() if row[1] < 20 * SECOND]
    assert changed[: len(before)] == before
    assert repr(changed) != repr(rows())


def test_ten_times_as_often_has_values_between() -> None:
    faster = [row for row in of(SPEED, sent('speed ten times as often')) if row[1] <= 39.8 * SECOND]
    assert len(of(SPEED, rows())) + 9 * 99 == len(of(SPEED, sent('speed ten times as often')))
    first, second = (row for row in faster if 20 * SECOND <= row[1] <= 20 * SECOND + SECOND // 50)
    assert second[1] - first[1] == SECOND // 50
    assert second[2] - first[2] == pytest.approx(0.1)


def test_one_hertz_keeps_one_of_five() -> None:
    kept = [row for row in of(FORCE, sent('force at 1 Hz')) if 20 * SECOND <= row[1] < 40 * SECOND]
    assert {b[1] - a[1] for a, b in pairwise(kept)} == {SECOND}


def test_a_clock_that_is_off_moves_stamps_and_no_message() -> None:
    ahead, late = sent('speed clock +1 s'), sent('speed +1 s')
    assert [row[2] for row in of(SPEED, ahead)] == [row[2] for row in of(SPEED, rows())]
    assert [row[0] for row in ahead] == [row[0] for row in rows()]
    assert [row[0] for row in late] != [row[0] for row in rows()]


def test_for_ever_means_until_the_end() -> None:
    assert max(row[1] for row in of(SPEED, sent('speed missing for ever'))) < 20 * SECOND
    assert max(row[1] for row in of(SPEED, sent('speed missing'))) > 40 * SECOND


def test_pairs_are_of_different_topics() -> None:
    assert len(PAIRS) == len(set(PAIRS)) >= 30
    assert {name for pair in PAIRS for name in pair} <= BY_NAME.keys()
    assert all(first.split()[0] != second.split()[0] for first, second in PAIRS)


@pytest.mark.slow
def test_two_faults_are_named_and_nothing_is_wrong_or_not_finite() -> None:
    outcome = judge(Injection(('speed not a number', 'force +1 s'), SEED, from_start=False))
    assert math.isfinite(outcome.named_s)
    assert outcome.is_finite
    assert outcome.wrong_s == 0.0
    assert outcome.seen_s <= outcome.named_s


# Seeds, and the longest drive until a fault from the first message on is named [s]: brakings may be rare.
@pytest.mark.parametrize(
    ('train', 'seed', 'fault', 'within_s', 'text'),
    [
        ('freight', 14, 'force frozen', 150.0, 'ato/force'),
        ('freight', 15, 'gradient 2 per mille high', 900.0, 'ato/gradient'),
        ('emu', 12, 'gradient 2 per mille high', 150.0, 'ato/gradient'),
        ('emu', 12, 'force spikes', 60.0, 'ato/force has spikes'),
        ('metro', 13, 'force spikes', 60.0, 'ato/force has spikes'),
        ('metro', 11, 'command half', 600.0, 'ato/brake_command'),
        ('tram', 16, 'command double', 600.0, 'ato/brake_command'),
        ('emu', 13, 'speed frozen', 300.0, 'SPEED_STUCK'),
    ],
)
def test_faults_of_other_trains_are_named(train: str, seed: int, fault: str, within_s: float, text: str) -> None:
    found = ride(train, seed)
    end_ns = found.start_ns + round(within_s * SECOND)
    all_rows = [row for row in found.rows if row[1] < end_ns]
    begin_ns = found.start_ns + (0 if fault != 'speed frozen' else 200 * SECOND)
    stream = SampleStream(StreamConfig(found.train_file))
    findings: set[str] = set()
    for row in injected(all_rows, [BY_NAME[fault]], begin_ns, end_ns):
        for event in stream.push_row(*row):
            if isinstance(event, Sample) and event.rejection is not None:
                findings.add(event.rejection.reason.name)
        findings.add(stream.finding)
    assert any(text in finding for finding in findings)


@pytest.mark.slow
@pytest.mark.parametrize(('train', 'seed'), [('freight', 21), ('emu', 22), ('high_speed', 23), ('metro', 24)])
def test_nothing_is_found_on_healthy_drives_of_other_trains(train: str, seed: int) -> None:
    found = ride(train, seed)
    stream = SampleStream(StreamConfig(found.train_file))
    for row in found.rows:
        stream.push_row(*row)
        assert stream.finding == ''
