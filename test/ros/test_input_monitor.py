# SPDX-License-Identifier: Apache-2.0
"""Statistics of an input, and what is said of it."""

from __future__ import annotations

import math

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from trainid_ros.interface.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    MASS_TOPIC,
    NS_PER_S,
    SPEED_TOPIC,
    InputTopic,
)
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.ros.diagnostics import Finding, InputMonitor, InputMonitors
from trainid_ros.ros.topics import Publishers
from trainid_ros.stream.alignment import AlignmentConfig

START_NS = 1_700_000_000 * NS_PER_S  # 2023-11-14 22:13:20 UTC
WRONG = '/odo publishes std_msgs/msg/Float64 instead of trainid_msgs/msg/AtoSpeed'


def fed(topic: InputTopic = SPEED_TOPIC, count: int = 20, age_s: float = 0.0) -> InputMonitor:
    """A monitor after some messages at 5 Hz, the last one at START_NS."""
    monitor = InputMonitor(topic, 1.0, 1.25, optional=topic is MASS_TOPIC)
    for i in range(count):
        now_ns = START_NS - (count - 1 - i) * NS_PER_S // 5
        monitor.arrived(now_ns - round(age_s * NS_PER_S), now_ns)
    monitor.publishers = Publishers(('/odo',))
    return monitor


def test_time_since_the_last_message_keeps_growing_after_the_rate_is_unknown() -> None:
    monitor = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False)
    assert math.isinf(monitor.missing_for_s(0))
    for i in range(20):
        monitor.arrived(i + 1, i * NS_PER_S // 5)
    last_ns = 19 * NS_PER_S // 5
    assert monitor.rate(last_ns) == pytest.approx(5.0)
    assert math.isnan(monitor.rate(last_ns + 60 * NS_PER_S))
    assert monitor.missing_for_s(last_ns + 60 * NS_PER_S) == pytest.approx(60.0)


def test_there_is_no_rate_by_a_clock_that_stands_still() -> None:
    monitor = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False)
    for i in range(20):
        monitor.arrived(i + 1, 0)
    assert math.isnan(monitor.rate(0))
    assert 'Hz' not in monitor.judge(0, 0.8).text


def test_an_input_that_stopped_is_described_with_time_and_action() -> None:
    monitor = fed()
    late_ns = START_NS + 63 * NS_PER_S
    found = monitor.judge(late_ns, 0.8)
    assert found.level == DiagnosticStatus.STALE
    assert found.sentence(late_ns) == (
        'no message for 63.0 s, 1 publisher(s), but no messages arrive, since 2023-11-14 22:13:20 UTC: '
        'check sensor and network of /odo, or whether it is active'
    )
    monitor.publishers = Publishers()
    assert monitor.judge(late_ns, 0.8).sentence(late_ns).endswith('22:13:20 UTC: start the node that publishes it')
    never = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False).judge(late_ns, 0.8)
    assert never.sentence(late_ns) == (
        'never received, no publisher: start the node that publishes it, or remap the topic to its name'
    )


@pytest.mark.parametrize(
    ('monitor', 'publishers', 'level', 'part'),
    [
        (fed(), Publishers(('/odo',)), DiagnosticStatus.OK, '5.0 Hz'),
        (fed(count=0), Publishers((), (WRONG,)), DiagnosticStatus.ERROR, WRONG),
        (fed(count=0), Publishers(('/a',), (WRONG,)), DiagnosticStatus.ERROR, WRONG),
        (fed(), Publishers(('/a',), (WRONG,)), DiagnosticStatus.WARN, WRONG),
        (fed(), Publishers(('/a', '/b')), DiagnosticStatus.WARN, '2 publishers, whose messages mix: /a, /b'),
        (fed(age_s=4.0), Publishers(('/odo',)), DiagnosticStatus.WARN, 'set use_sim_time'),
        (fed(MASS_TOPIC, 0), Publishers(), DiagnosticStatus.OK, 'optional'),
        (fed(MASS_TOPIC, 0), Publishers((), (WRONG,)), DiagnosticStatus.ERROR, WRONG),
    ],
)
def test_the_most_important_finding_is_reported(
    monitor: InputMonitor, publishers: Publishers, level: bytes, part: str
) -> None:
    monitor.publishers = publishers
    found = monitor.judge(START_NS, 0.8)
    assert (found.level, part in found.sentence(START_NS)) == (level, True), found
    assert bool(found.action) == (level != DiagnosticStatus.OK)


def test_a_publisher_that_is_not_heard_is_named_as_soon_as_no_message_comes() -> None:
    monitor = fed()
    monitor.publishers = Publishers(('/killed',), (WRONG,))
    assert monitor.judge(START_NS, 0.8).action == 'correct or stop this publisher'
    found = monitor.judge(START_NS + 2 * NS_PER_S, 0.8)
    assert (found.level, found.text) == (DiagnosticStatus.ERROR, WRONG)


def test_a_time_that_is_not_known_or_in_the_future_is_left_out() -> None:
    assert Finding(DiagnosticStatus.WARN, 'a', 'b').sentence(START_NS) == 'a: b'
    assert Finding(DiagnosticStatus.WARN, 'a', '', START_NS + 1).sentence(START_NS) == 'a'


def test_missing_inputs_are_named_with_their_times() -> None:
    monitors = InputMonitors(AlignmentConfig())
    for topic, seconds in ((SPEED_TOPIC, 3.0), (FORCE_TOPIC, 0.1), (BRAKE_TOPIC, 9.0)):
        monitors.by_topic[topic].arrived(1, START_NS - round(seconds * NS_PER_S))
    text = monitors.describe_missing(START_NS, lambda topic: 5.0 if topic is BRAKE_TOPIC else 0.8)
    assert text == 'no ato/speed for 3.0 s, no ato/gradient yet, no ato/brake_command for 9.0 s'


def arrive(monitors: InputMonitors, seconds: float, delays: dict[InputTopic, float], reason: Reason | None) -> int:
    """Let all required inputs come at 5 Hz, each so much behind its stamp; all speeds are rejected with a reason."""
    now_ns = START_NS
    for i in range(round(5 * seconds)):
        now_ns = START_NS + i * NS_PER_S // 5
        for topic in (FORCE_TOPIC, GRADIENT_TOPIC, BRAKE_TOPIC, SPEED_TOPIC):
            stamp_ns = now_ns - round(delays.get(topic, 0.0) * NS_PER_S)
            rejected = [Rejection(stamp_ns, reason, math.nan, math.nan)] if reason and topic is SPEED_TOPIC else []
            monitors.arrived(topic, stamp_ns, now_ns, rejected)
    return now_ns


@pytest.mark.parametrize(
    ('reason', 'action'),
    [(Reason.NOT_FINITE, 'correct the sensor'), (Reason.OUT_OF_RANGE, 'unit'), (Reason.ZERO_STAMP, 'set the stamp')],
)
def test_messages_that_are_rejected_are_named_within_a_second(reason: Reason, action: str) -> None:
    monitors = InputMonitors(AlignmentConfig())
    now_ns = arrive(monitors, 1.0, {}, reason)
    found = monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8)
    assert found.level == DiagnosticStatus.ERROR
    assert found.text.startswith(f'5 of the last 5 messages not used: {reason.name}')
    assert action in found.action
    assert monitors.describe_missing(now_ns, lambda _: 0.8) == f'ato/speed: {found.text}'
    assert monitors.by_topic[FORCE_TOPIC].judge(now_ns, 0.8).level == DiagnosticStatus.OK
    assert monitors.by_topic[SPEED_TOPIC].judge_rejections(now_ns + 6 * NS_PER_S) is None


def test_single_rejections_and_speeds_faster_than_the_period_are_not_reported() -> None:
    thinned, late = InputMonitors(AlignmentConfig()), InputMonitors(AlignmentConfig())
    now_ns = arrive(thinned, 5.0, {}, Reason.THINNED)
    arrive(late, 5.0, {}, None)
    late.by_topic[SPEED_TOPIC].rejected(Rejection(now_ns, Reason.LATE, -0.1, 0.0), now_ns)
    for monitors in (thinned, late):
        assert monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8).level == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ('behind_s', 'shown'),
    [
        (300.0, '5.0 min behind'),
        (-7200.0, '2.0 h ahead of'),
        (864_000.0, '10.0 days behind'),
        (95_448_337.0, '3.0 years behind'),
    ],
)
def test_a_large_difference_of_stamps_is_told_in_a_unit_that_can_be_read(behind_s: float, shown: str) -> None:
    monitors = InputMonitors(AlignmentConfig())
    now_ns = arrive(monitors, 1.0, {SPEED_TOPIC: behind_s}, None)
    found = monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8, monitors.skew_s(SPEED_TOPIC, now_ns))
    assert found.text == f'stamps are {shown} those of the other inputs'
    assert ('use_sim_time' in found.action) == (abs(behind_s) > 3600.0)
    assert monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8).text == f"stamps are {shown} this node's clock"


def test_a_stamp_that_is_rejected_with_the_next_message_is_that_of_its_own_topic() -> None:
    monitors = InputMonitors(AlignmentConfig())
    for i in range(10):
        now_ns = START_NS + i * NS_PER_S // 5
        monitors.arrived(SPEED_TOPIC, now_ns - NS_PER_S * 10, now_ns, ())
        rejected = [Rejection(now_ns - NS_PER_S * 10, Reason.STAMP_JUMP, -10.0, -2.0)]
        monitors.arrived(FORCE_TOPIC, now_ns, now_ns, rejected)
    found = monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8)
    assert found.sentence(0) == (
        '10 of the last 10 messages not used: STAMP_JUMP (10.0 s): synchronise its clock with those of the other inputs'
    )
    assert monitors.by_topic[FORCE_TOPIC].judge(now_ns, 0.8).level == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ('rejection', 'shown'),
    [
        (Rejection(5, Reason.NOT_FINITE, math.inf, math.nan), 'NOT_FINITE (inf)'),
        (Rejection(5, Reason.OUT_OF_RANGE, -5.0, 0.0), 'OUT_OF_RANGE (-5 is below 0)'),
        (Rejection(5, Reason.OUT_OF_RANGE, 300.0, 200.0), 'OUT_OF_RANGE (300 is above 200)'),
        (Rejection(0, Reason.ZERO_STAMP, 0.0, 0.0), 'ZERO_STAMP (the stamp is 0)'),
        (Rejection(-705033000, Reason.ZERO_STAMP, -0.705033, 0.0), 'ZERO_STAMP (the stamp is negative)'),
        (Rejection(5, Reason.DUPLICATE, 2.1e9, 0.0), 'DUPLICATE'),
        (Rejection(5, Reason.LATE, -0.5, 0.0), 'LATE (0.5 s)'),
    ],
)
def test_a_rejection_is_told_with_the_number_that_says_so(rejection: Rejection, shown: str) -> None:
    monitor = InputMonitors(AlignmentConfig()).by_topic[SPEED_TOPIC]
    for i in range(5):
        monitor.arrived(START_NS + i, START_NS + i)
        monitor.rejected(rejection, START_NS + i)
    found = monitor.judge_rejections(START_NS + 5)
    assert found is not None
    assert found.text == f'5 of the last 5 messages not used: {shown}'


@pytest.mark.parametrize('behind_s', [0.5, 1.0, -1.0])
def test_stamps_that_are_behind_those_of_the_other_inputs_are_named_with_the_time(behind_s: float) -> None:
    monitors = InputMonitors(AlignmentConfig())
    now_ns = arrive(monitors, 1.0, {SPEED_TOPIC: behind_s, FORCE_TOPIC: 0.1}, None)
    found = monitors.by_topic[SPEED_TOPIC].judge(now_ns, 0.8, monitors.skew_s(SPEED_TOPIC, now_ns))
    where = f'{behind_s:.1f} s behind' if behind_s > 0.0 else '1.0 s ahead of'
    assert found.text == f'stamps are {where} those of the other inputs'
    assert f'ato/speed: {found.text}' in monitors.describe_missing(now_ns, lambda _: 0.8)
    assert [monitors.skew_s(topic, now_ns) for topic in (FORCE_TOPIC, GRADIENT_TOPIC, BRAKE_TOPIC, MASS_TOPIC)] == [
        0.0
    ] * 4


def test_one_message_that_is_held_up_is_no_skew() -> None:
    monitors = InputMonitors(AlignmentConfig())
    now_ns = arrive(monitors, 1.0, {}, None) + NS_PER_S // 5
    monitors.arrived(SPEED_TOPIC, now_ns - NS_PER_S, now_ns, ())
    assert monitors.skew_s(SPEED_TOPIC, now_ns) == 0.0
