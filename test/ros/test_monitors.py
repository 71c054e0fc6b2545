# SPDX-License-Identifier: Apache-2.0
"""What the diagnostics say of an input, also long after it has ended."""

from __future__ import annotations

import math

import pytest

from trainid_ros.core.records import NS_PER_S, SPEED_TOPIC
from trainid_ros.ros.monitors import InputMonitor


def test_silence_goes_on_counting_after_the_rate_is_gone() -> None:
    monitor = InputMonitor(SPEED_TOPIC, 1.0, 1.25, optional=False)
    assert math.isinf(monitor.missing_for_s(0))
    for i in range(20):
        monitor.arrived(i + 1, i * NS_PER_S // 5)
    last_ns = 19 * NS_PER_S // 5
    assert monitor.rate(last_ns) == pytest.approx(5.0)
    assert math.isnan(monitor.rate(last_ns + 60 * NS_PER_S))
    assert monitor.missing_for_s(last_ns + 60 * NS_PER_S) == pytest.approx(60.0)
