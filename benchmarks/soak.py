# SPDX-License-Identifier: Apache-2.0
"""The live nodes for minutes at many times real time on a loaded machine: memory, open files, missed ticks.

Drives of a simulated day are published again and again with later stamps while other processes keep all cores busy.
Every sample must give an estimate of each node, memory and open files must not grow, and nothing may be left in shared
memory at the end.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from trainid_msgs import msg as trainid_msgs

from benchmarks.days import TRAIN_FILE, simulated_day
from benchmarks.live import private_domain
from benchmarks.memory import open_files, repeated, resident_kb
from benchmarks.tables import Table, as_text
from trainid_ros.cli.demo import node_parameters
from trainid_ros.cli.processes import ProcessGroup
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, OUTPUT_TOPICS, stamp_of
from trainid_ros.ros.topics import message_class, message_from_record
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample

if TYPE_CHECKING:
    from collections.abc import Iterator

_SEED: Final = 1
_DEPTH: Final = 40000
_DISCOVERY_S: Final = 60.0
_SETTLING_S: Final = 40.0
"""Time after which memory is compared: by then all code has run and all buffers have their sizes."""
_READ_EVERY_S: Final = 5.0
_PARTS: Final = 5
_LAST_S: Final = 10.0
_MAX_END_S: Final = 60.0
"""Time for a clean end: a process that is killed leaves its shared memory."""
_SHARED: Final = '/dev/shm/'
_TRACING: Final = 'lttng'  # kept by the system for all processes


@dataclass(frozen=True, slots=True)
class Reading:
    """Memory [kB] and open files of the nodes at a time [s]."""

    time_s: float
    resident_kb: int
    open_files: int


@dataclass(frozen=True, slots=True)
class Soak:
    """Result of a run.

    Attributes:
        readings: Memory and open files over time.
        samples: Number of samples sent.
        missed: For each topic, when the samples were sent that gave no estimate [s].
        left: Number of files left in shared memory.
        late_s: By how much a record was published late at most [s]: then many follow at once.

    """

    readings: tuple[Reading, ...]
    samples: int
    missed: dict[str, list[float]]
    left: int
    late_s: float


class _Feed:
    """Publishes records and counts estimates."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('soak', context=self._context)
        # Nothing may be lost on the way: what is missing at the end was missed by a node.
        deep = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._publishers = {
            topic.record: self._node.create_publisher(message_class(topic), topic.name, deep) for topic in INPUT_TOPICS
        }
        self.sent: dict[int, float] = {}
        self.received: dict[str, set[int]] = {topic.name: set() for topic in OUTPUT_TOPICS}
        for topic in OUTPUT_TOPICS:
            receive = self._receiver(self.received[topic.name])
            self._node.create_subscription(getattr(trainid_msgs, topic.message), topic.name, receive, deep)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    @staticmethod
    def _receiver(stamps: set[int]) -> Any:
        return lambda message: stamps.add(stamp_of(message))

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def wait_for_nodes(self) -> None:
        """Wait until the nodes subscribe and publish; TimeoutError if they do not start."""
        end = time.monotonic() + _DISCOVERY_S
        while not all(p.get_subscription_count() for p in self._publishers.values()) or not all(
            self._node.count_publishers(topic.name) for topic in OUTPUT_TOPICS
        ):
            if time.monotonic() > end:
                raise TimeoutError(f'the nodes did not start within {_DISCOVERY_S:g} s')
            time.sleep(0.1)
        time.sleep(1.0)

    def publish(self, seconds: float, rate: float) -> float:
        """Publish for some seconds; return by how much a record was late at most [s]."""
        day, aligner = simulated_day(_SEED), Aligner(AlignmentConfig())
        first_ns, start_s, latest_s = day.records[0].stamp_ns, time.monotonic(), 0.0
        for record in repeated(day.records, round(day.duration_s * NS_PER_S)):
            due_s = (record.stamp_ns - first_ns) / NS_PER_S / rate
            if due_s > seconds:
                break
            late_s = time.monotonic() - start_s - due_s
            latest_s = max(latest_s, late_s)
            if late_s < 0.0:
                time.sleep(-late_s)
            self.sent |= {event.stamp_ns: due_s for event in aligner.push(record) if isinstance(event, Sample)}
            self._publishers[type(record)].publish(message_from_record(record))
        return latest_s

    def close(self) -> None:
        """Shut down."""
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.destroy()


def soak(seconds: float, rate: float, busy: int, *, realtime: bool = False) -> Soak:
    """Run the three nodes in one process for some seconds.

    Args:
        seconds: Duration [s].
        rate: Recorded seconds per second [1].
        busy: Number of processes that keep a core busy.
        realtime: Whether the nodes have real-time priority, as with ``chrt -r 1``.

    Raises:
        PermissionError: This user may not give real-time priority.

    """
    shared: set[Path] = set()
    # What processes left that were killed long ago, and these may use again.
    before = set(Path(_SHARED).iterdir())
    burners = [multiprocessing.get_context('spawn').Process(target=_burn, daemon=True) for _ in range(busy)]
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)), ProcessGroup(Path(name)) as processes:
        parameters = Path(name) / 'parameters.yaml'
        parameters.write_text(node_parameters(), encoding='utf-8')
        command = ('run', '--train', str(TRAIN_FILE), '--ros-args', '--params-file', str(parameters))
        process = processes.start('nodes', *command)
        feed, stop = _Feed(), threading.Event()
        readings: list[Reading] = []
        reader = threading.Thread(target=lambda: readings.extend(_readings(process.pid, stop)))
        try:
            feed.wait_for_nodes()
            if realtime:
                _prioritise(process.pid)
            for burner in burners:
                burner.start()
            reader.start()
            late_s = feed.publish(seconds, rate)
            _wait(feed)
            shared = (_shared_memory(process.pid) | _shared_memory('self')) - before
            stop.set()
            reader.join()
            process.terminate()
            process.wait(_MAX_END_S)
        finally:
            stop.set()
            reader.join()
            feed.close()
            for burner in burners:
                burner.kill()
    missed = {
        topic: [sent_s for stamp_ns, sent_s in feed.sent.items() if stamp_ns not in stamps]
        for topic, stamps in feed.received.items()
    }
    return Soak(tuple(readings), len(feed.sent), missed, sum(path.exists() for path in shared), late_s)


def _wait(feed: _Feed) -> None:
    """Wait for the last estimates."""
    end = time.monotonic() + _LAST_S
    while time.monotonic() < end and any(len(stamps) < len(feed.sent) for stamps in feed.received.values()):
        time.sleep(0.1)


def _readings(pid: int, stop: threading.Event) -> Iterator[Reading]:
    start_s = time.monotonic()
    while not stop.wait(_READ_EVERY_S):
        yield Reading(time.monotonic() - start_s, resident_kb(pid), open_files(pid))


def _prioritise(pid: int) -> None:
    for thread in Path(f'/proc/{pid}/task').iterdir():
        os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))


def _burn() -> None:
    while True:
        pass


def _shared_memory(process: int | str) -> set[Path]:
    """Return the files in shared memory that a process uses."""
    mapped = {line.split()[-1] for line in Path(f'/proc/{process}/maps').read_text(encoding='ascii').splitlines()}
    return {Path(name) for name in mapped if name.startswith(_SHARED) and _TRACING not in name}


def _missed(times: list[float]) -> str:
    return f'{len(times)}, from {min(times):.1f} to {max(times):.1f} s' if times else '0'


def measure(minutes: float, rate: float = 20.0) -> tuple[Table, ...]:
    """Run the nodes on a machine whose cores are all busy, without and with real-time priority; return the table."""
    seconds = 60.0 * minutes
    busy = os.cpu_count() or 1
    columns = [_values(soak(seconds, rate, busy, realtime=realtime)) for realtime in (False, True)]
    rows = tuple((name, plain, columns[1][name]) for name, plain in columns[0].items())
    note = (
        f'{seconds:g} s at {rate:g} x real time each, all cores kept busy by {busy} other processes, beside the load '
        f'below; growth counts after {_SETTLING_S:g} s.'
    )
    header = ('three nodes in one process', 'as started', 'with real-time priority')
    return (Table('Live nodes under load', header, rows, note),)


def _values(result: Soak) -> dict[str, str]:
    """Return the values of a run by the name of their row."""
    settled = [reading for reading in result.readings if reading.time_s > _SETTLING_S]
    first, last = settled[0], settled[-1]
    parts = [settled[k * (len(settled) - 1) // _PARTS].resident_kb for k in range(_PARTS + 1)]
    return {
        'samples sent': str(result.samples),
        **{f'missed by {topic}': _missed(times) for topic, times in result.missed.items()},
        'publisher late at most, s': f'{result.late_s:.2f}',
        'memory of the nodes, MB': f'{last.resident_kb / 1024:.1f}',
        'grown in each fifth of the time, kB': ', '.join(str(after - before) for before, after in pairwise(parts)),
        'open files, first and last': f'{first.open_files}, {last.open_files}',
        'files left in shared memory': str(result.left),
    }


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=3.0, metavar='N', help='duration (default 3)')
    parser.add_argument('--rate', type=float, default=20.0, metavar='R', help='x real time (default 20)')
    args = parser.parse_args()
    for table in measure(args.minutes, args.rate):
        print(as_text(table))
    sys.exit(0)
