# SPDX-License-Identifier: Apache-2.0
"""Statistics of an input, and what is said of it."""

from __future__ import annotations

import math

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from trainid_ros.records import BRAKE_TOPIC, FORCE_TOPIC, MASS_TOPIC, NS_PER_S, SPEED_TOPIC, InputTopic
from trainid_ros.ros.input_monitor import Finding, InputMonitor, InputMonitors
from trainid_ros.ros.publishers import Publishers
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
def test_the_most_important_finding_is_told(
    monitor: InputMonitor, publishers: Publishers, level: bytes, part: str
) -> None:
    monitor.publishers = publishers
    found = monitor.judge(START_NS, 0.8)
    assert (found.level, part in found.sentence(START_NS)) == (level, True), found
    assert bool(found.action) == (level != DiagnosticStatus.OK)


def test_a_time_that_is_not_known_or_in_the_future_is_left_out() -> None:
    assert Finding(DiagnosticStatus.WARN, 'a', 'b').sentence(START_NS) == 'a: b'
    assert Finding(DiagnosticStatus.WARN, 'a', '', START_NS + 1).sentence(START_NS) == 'a'


def test_missing_inputs_are_named_with_their_times() -> None:
    monitors = InputMonitors(AlignmentConfig())
    for topic, seconds in ((SPEED_TOPIC, 3.0), (FORCE_TOPIC, 0.1), (BRAKE_TOPIC, 9.0)):
        monitors.by_topic[topic].arrived(1, START_NS - round(seconds * NS_PER_S))
    text = monitors.describe_missing(START_NS, lambda topic: 5.0 if topic is BRAKE_TOPIC else 0.8)
    assert text == 'no ato/speed for 3.0 s, no ato/gradient yet, no ato/brake_command for 9.0 s'
