# SPDX-License-Identifier: Apache-2.0
"""Estimates go on, in the same process and bounded memory, through what networks and machines do to nodes.

Nothing here depends on the speed of the machine: each step ends when a newer estimate has come.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from rclpy.qos import QoSProfile
from trainid_msgs.msg import ResistanceEstimate

from benchmarks.processes import resident_kb
from test.ros.graph import Graph, coasting
from trainid_ros.cli.processes import free_domain, local_environment
from trainid_ros.interface.records import INPUT_TOPICS, SPEED_TOPIC, input_topic, stamp_of
from trainid_ros.ros.topics import message_class, message_from_record, source_qos

pytestmark = [pytest.mark.ros, pytest.mark.slow]
ROOT = Path(__file__).parents[2]
PROFILE = ROOT / 'config' / 'fastdds_localhost.xml'
RUN = (
    sys.executable,
    '-m',
    'trainid_ros.cli.main',
    'run',
    '--train',
    str(ROOT / 'config' / 'trains' / 'yizhuang.yaml'),
)
# As in a container: shared memory that holds no message. Where that is not allowed, it has its usual size.
SMALL = (
    'unshare',
    '--map-root-user',
    '--mount',
    'sh',
    '-c',
    'mount -t tmpfs -o size=64k none /dev/shm && exec "$@"',
    'sh',
)
FLOOD: Final = 5000
SUBSCRIBERS: Final = 200
FRAME_ID_BYTES: Final = 20_000_000
MAX_GROWTH_KB: Final = 150_000  # two copies of the largest message, and queues
PAUSE_S: Final = 1.5


class Load(Graph):
    """A train that coasts on and on, and the newest estimate."""

    def __init__(self, domain: int, pid: int) -> None:
        super().__init__(domain)
        self.pid, self.newest_ns = pid, 0
        self.node = self.plain('load')
        self.outputs = {
            topic: self.node.create_publisher(message_class(topic), topic.name, source_qos()) for topic in INPUT_TOPICS
        }
        self.node.create_subscription(ResistanceEstimate, 'trainid/resistance', self.note, 10)
        self._records = iter(coasting(20_000))

    def note(self, message: Any) -> None:
        self.newest_ns = max(self.newest_ns, stamp_of(message))

    def send(self) -> Any:
        """Send the next four records; return the speed."""
        for _ in range(4):
            record = next(self._records)
            message = message_from_record(record)
            self.outputs[input_topic(record)].publish(message)
        return message

    def goes_on(self) -> None:
        """Send samples until an estimate has come of one of them."""
        before_ns = stamp_of(self.send())

        def came() -> bool:
            self.send()
            return self.newest_ns > before_ns

        self.until(came)


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Load]:
    for variable, value in {**local_environment(PROFILE), 'ROS_LOG_DIR': str(tmp_path)}.items():
        monkeypatch.setenv(variable, value)
    domain = free_domain(os.getpid())
    is_allowed = subprocess.run([*SMALL, 'true'], capture_output=True, check=False).returncode == 0
    command = [*(SMALL if is_allowed else ()), *RUN]
    with (tmp_path / 'err').open('wb') as err:
        nodes = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=err, env=os.environ | {'ROS_DOMAIN_ID': str(domain)}
        )
    assert nodes.stdout is not None
    lines = [nodes.stdout.readline() for _ in range(3)]
    made = Load(domain, nodes.pid)
    try:
        assert lines[-1], (tmp_path / 'err').read_text()
        yield made
        assert nodes.poll() is None
        nodes.send_signal(signal.SIGTERM)
        assert nodes.wait() == 0
        assert 'Traceback' not in (tmp_path / 'err').read_text()
    finally:
        nodes.kill()
        nodes.wait()
        made.close()


def test_estimates_go_on(load: Load) -> None:
    load.goes_on()
    settled_kb = resident_kb(load.pid)
    speed = load.outputs[SPEED_TOPIC]

    # Thousands of messages as fast as they can be sent, with stamps that were there already.
    again = load.send()
    for _ in range(FLOOD):
        speed.publish(again)
    load.goes_on()

    # A node that was stopped, as by a debugger, while messages come.
    os.kill(load.pid, signal.SIGSTOP)
    until = time.monotonic() + PAUSE_S
    while time.monotonic() < until:
        load.send()
        load.spin(5)
    os.kill(load.pid, signal.SIGCONT)
    load.goes_on()

    # One header as large as a video.
    again.header.frame_id = 'x' * FRAME_ID_BYTES
    speed.publish(again)
    load.goes_on()

    # Two hundred subscribers.
    got = [0] * SUBSCRIBERS

    def count(number: int) -> None:
        got[number] += 1

    for number in range(SUBSCRIBERS):
        load.node.create_subscription(
            ResistanceEstimate, 'trainid/resistance', lambda _, number=number: count(number), QoSProfile(depth=1)
        )
    load.until(lambda: load.send() and all(got))
    load.goes_on()
    growth_kb = resident_kb(load.pid) - settled_kb
    print(f'memory grew by {growth_kb} kB')
    assert growth_kb < MAX_GROWTH_KB
