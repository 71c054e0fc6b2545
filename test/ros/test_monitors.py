# SPDX-License-Identifier: Apache-2.0
"""Input statistics of the diagnostics, also long after the input has ended."""

from __future__ import annotations

import math

import pytest

from trainid_ros.records import NS_PER_S, SPEED_TOPIC
from trainid_ros.ros.monitors import InputMonitor


def test_time_since_the_last_message_keeps_growing_after_the_rate_is_unknown() -> None:
    monitor = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False)
    assert math.isinf(monitor.missing_for_s(0))
    for i in range(20):
        monitor.arrived(i + 1, i * NS_PER_S // 5)
    last_ns = 19 * NS_PER_S // 5
    assert monitor.rate(last_ns) == pytest.approx(5.0)
    assert math.isnan(monitor.rate(last_ns + 60 * NS_PER_S))
    assert monitor.missing_for_s(last_ns + 60 * NS_PER_S) == pytest.approx(60.0)
