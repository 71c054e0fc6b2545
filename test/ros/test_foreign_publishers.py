# SPDX-License-Identifier: Apache-2.0
"""Publishers in processes of their own that are killed, started again, or doubled; see also benchmarks/faults_live."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from benchmarks.sender import Sending, write_rows
from trainid_ros.interface.records import NS_PER_S, SPEED
from trainid_ros.ros.inputs import _Numbers

Graph: TypeAlias = Any  # the fixture of conftest.py
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


def follow(graph: Graph) -> list[Any]:
    """Return the list that the statuses of the speed go to."""
    found: list[Any] = []

    def note(array: DiagnosticArray) -> None:
        found.extend(status for status in array.status if status.name == SPEED_INPUT)

    graph.plain('display').create_subscription(DiagnosticArray, '/diagnostics', note, 10)
    return found


@pytest.mark.ros
def test_a_publisher_killed_and_started_again_is_missed_but_never_called_two(
    graph: Graph, train_file: str, start: Start
) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    statuses, odometer = follow(graph), start()
    graph.until(lambda: statuses and statuses[-1].level == DiagnosticStatus.OK)
    odometer.kill()
    graph.until(lambda: statuses[-1].level == DiagnosticStatus.STALE)
    start()
    graph.until(lambda: statuses[-1].level != DiagnosticStatus.STALE)
    count = len(statuses)
    graph.until(lambda: len(statuses) > count + 10)
    # The killed one is still in the graph.
    assert not [status.message for status in statuses if 'publishers' in status.message]


@pytest.mark.ros
def test_two_publishers_of_one_name_are_named(graph: Graph, train_file: str, start: Start) -> None:
    graph.active(train_file, diagnostic_period=0.1)
    statuses = follow(graph)
    start()
    start()
    # Those of other tests may still be in the graph.
    graph.until(lambda: statuses and 'publishers, whose messages mix: /odometer' in statuses[-1].message)


def test_counts_of_publishers_alternate_or_begin_again() -> None:
    unknown, one, again, two = _Numbers(), _Numbers(), _Numbers(), _Numbers()
    for k in range(50):
        unknown.add(None)
        one.add(100 + 2 * k)  # with losses
        again.add(k % 45 + 1)
        two.add(100 + k // 2 if k % 2 else 5 + k // 2)
    assert [numbers.alternate for numbers in (unknown, one, again, two)] == [True, False, False, True]
