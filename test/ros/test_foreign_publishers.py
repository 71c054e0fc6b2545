# SPDX-License-Identifier: Apache-2.0
"""Publishers in processes of their own that are killed, started again, or doubled; see also benchmarks/faults_live."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from benchmarks.sender import Sending, write_rows
from test.ros.graph import Diagnosed, Graph
from trainid_ros.interface.records import NS_PER_S, SPEED
from trainid_ros.ros.inputs import ForeignTopic, InputSubscription

Start: TypeAlias = Callable[[], 'subprocess.Popen[bytes]']
SPEED_INPUT = 'resistance_estimator: input ato/speed'


@pytest.fixture
def start(graph: Graph, tmp_path: Path) -> Iterator[Start]:
    """Starts an odometer that publishes speeds at 5 Hz."""
    begin_ns, path = time.time_ns(), tmp_path / 'speeds.json'
    stamps = [begin_ns + k * NS_PER_S // 5 for k in range(3000)]
    write_rows(path, [Sending(stamp_ns, (SPEED, stamp_ns, 20.0, 1.0, False)) for stamp_ns in stamps])
    started = []

    def start_one() -> subprocess.Popen[bytes]:
        command = [sys.executable, '-m', 'benchmarks.sender', str(os.getpid()), 'odometer', str(path)]
        started.append(subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}))
        return started[-1]

    yield start_one
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.ros
def test_a_publisher_killed_and_started_again_is_missed_but_never_called_two(
    graph: Graph, train_file: str, start: Start
) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    diagnosed, odometer = Diagnosed(graph), start()
    graph.until(lambda: diagnosed.level(SPEED_INPUT) == DiagnosticStatus.OK)
    odometer.kill()
    graph.until(lambda: diagnosed.level(SPEED_INPUT) == DiagnosticStatus.STALE)
    start()
    graph.until(lambda: diagnosed.level(SPEED_INPUT) != DiagnosticStatus.STALE)
    count = len(diagnosed.said)
    graph.until(lambda: len(diagnosed.said) > count + 100)
    # The killed one is still in the graph.
    assert not [text for text in diagnosed.said if SPEED_INPUT in text and 'publishers' in text]


@pytest.mark.ros
def test_two_publishers_of_one_name_are_named(graph: Graph, train_file: str, start: Start) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    diagnosed = Diagnosed(graph)
    start()
    start()
    # Those of other tests may still be in the graph.
    diagnosed.until(SPEED_INPUT, 'publishers, whose messages mix: /odometer')


def test_counts_of_publishers_alternate_or_begin_again() -> None:
    topic = ForeignTopic('/x', ('speed',))
    unknown, one, again, two = (InputSubscription(topic, lambda *_: None, lambda _: None) for _ in range(4))
    for k in range(50):
        unknown.count(None)
        one.count(100 + 2 * k)  # with losses
        again.count(k % 45 + 1)
        two.count(100 + k // 2 if k % 2 else 5 + k // 2)
    assert [subscription.may_mix for subscription in (unknown, one, again, two)] == [True, False, False, True]
