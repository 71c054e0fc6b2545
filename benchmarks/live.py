# SPDX-License-Identifier: Apache-2.0
"""The running nodes at 5 Hz: latency of the estimates, and CPU time and memory of the nodes.

This process publishes the records of a simulated day in real time and subscribes to the estimates. The latency is
measured from just before the last input is published until the callback that receives the estimate: it includes two
transfers through the middleware, all three nodes and this subscriber. The same is measured of a bare node that computes
nothing, in the same run: what is left is the estimators' own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from trainid_msgs import msg as trainid_msgs

from benchmarks.days import TRAIN_FILE, simulated_day
from benchmarks.tables import Table
from trainid_ros.cli.processes import ProcessGroup, free_domain, local_environment
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, OUTPUT_TOPICS, stamp_of
from trainid_ros.ros.topics import estimate_qos, message_class, message_from_record, source_qos
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from trainid_ros.interface.records import Record

_PROFILE: Final = Path(__file__).parents[1] / 'config' / 'fastdds_localhost.xml'
_SEED: Final = 1
# A part of the day with traction, coasting, braking and standstill.
_START_S: Final = 40.0
_WARM_UP_TICKS: Final = 25
_TICKS: Final = 310
_IDLE_S: Final = 4.0
_DISCOVERY_S: Final = 60.0
_NODES: Final = ('resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator')


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency from the last input to the estimate, over all estimates of one topic [ms]."""

    topic: str
    sent: int
    received: int
    p50: float
    p99: float
    longest: float


@dataclass(frozen=True, slots=True)
class ProcessLoad:
    """Share of one core used by a process of nodes, idle and at 5 Hz, and its memory [MB]."""

    name: str
    idle_share: float
    busy_share: float
    resident_mb: float


@dataclass(frozen=True, slots=True)
class LiveResult:
    """Results of one distribution of nodes over processes."""

    arrangement: str
    latencies: tuple[Latency, ...]
    loads: tuple[ProcessLoad, ...]


def measure() -> tuple[Table, ...]:
    """Run both distributions of nodes over processes, and a bare relay; return the tables."""
    together = run_nodes('one process', (_NODES,))
    apart = run_nodes('three processes', tuple((name,) for name in _NODES))
    results = (together, apart, run_relay())
    return _latency_table(results), _load_table(results)


def _latency_table(results: Sequence[LiveResult]) -> Table:
    rows = tuple(
        (
            f'{result.arrangement}: {latency.topic}',
            str(latency.sent),
            str(latency.received),
            *(f'{value:.2f}' for value in (latency.p50, latency.p99, latency.longest)),
        )
        for result in results
        for latency in result.latencies
    )
    header = ('last input to estimate, ms', 'ticks', 'received', 'p50', 'p99', 'longest')
    return Table('Latency of estimates at 5 Hz', header, rows, f'Load of the machine: {os.getloadavg()[0]:.1f}.')


def _load_table(results: Sequence[LiveResult]) -> Table:
    rows = tuple(
        (
            f'{result.arrangement}: {load.name}',
            f'{load.idle_share:.1%}',
            f'{load.busy_share:.1%}',
            f'{load.resident_mb:.0f}',
        )
        for result in results
        for load in result.loads
    )
    header = ('share of one core', 'idle', 'at 5 Hz', 'resident MB')
    return Table('CPU time and memory of the nodes', header, rows, 'Idle: active nodes without input.')


class _Meter:
    """Publishes records and stores the times at which the estimates are received."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('benchmark', context=self._context)
        self._publishers = {
            topic.record: self._node.create_publisher(message_class(topic), topic.name, source_qos())
            for topic in INPUT_TOPICS
        }
        self.sent_ns: dict[int, int] = {}
        self.received_ns: dict[str, dict[int, int]] = {topic.name: {} for topic in OUTPUT_TOPICS}
        for topic in OUTPUT_TOPICS:
            receiver = self._receiver(self.received_ns[topic.name])
            self._node.create_subscription(getattr(trainid_msgs, topic.message), topic.name, receiver, estimate_qos())
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    @staticmethod
    def _receiver(received: dict[int, int]) -> Any:
        def receive(message: Any) -> None:
            received.setdefault(stamp_of(message), time.perf_counter_ns())

        return receive

    def close(self) -> None:
        """Shut down the executor, the context and the thread."""
        self._executor.shutdown()
        rclpy.try_shutdown(context=self._context)
        self._thread.join()

    def wait_for_nodes(self, processes: int) -> None:
        """Wait until all processes subscribe to the inputs, once each, and publish the estimates.

        Raises:
            TimeoutError: The nodes did not start.

        """
        end = time.monotonic() + _DISCOVERY_S
        while not self._sees_all(processes):
            if time.monotonic() > end:
                raise TimeoutError(f'the nodes did not start within {_DISCOVERY_S:g} s')
            time.sleep(0.1)

    def _sees_all(self, processes: int) -> bool:
        subscribed = all(self._node.count_subscribers(topic.name) == processes for topic in INPUT_TOPICS)
        return subscribed and all(self._node.count_publishers(topic.name) for topic in OUTPUT_TOPICS)

    def publish(self, records: Sequence[Record]) -> None:
        """Publish records in real time; store the time at which each sample is complete."""
        aligner = Aligner(AlignmentConfig())
        start_s, first_ns = time.perf_counter(), records[0].stamp_ns
        for record in records:
            message = message_from_record(record)
            completed = [event for event in aligner.push(record) if isinstance(event, Sample)]
            due_s = start_s + (record.stamp_ns - first_ns) / NS_PER_S
            time.sleep(max(0.0, due_s - time.perf_counter()))
            for sample in completed:
                self.sent_ns[sample.stamp_ns] = time.perf_counter_ns()
            self._publishers[type(record)].publish(message)
        time.sleep(1.0)

    def latencies(self) -> tuple[Latency, ...]:
        """Return the latencies of all estimates after the warm-up."""
        sent = dict(list(self.sent_ns.items())[_WARM_UP_TICKS:])
        return tuple(_latency(topic, sent, received) for topic, received in self.received_ns.items())


def _latency(topic: str, sent: dict[int, int], received: dict[int, int]) -> Latency:
    both = [stamp for stamp in sent if stamp in received]
    ms = np.array([received[stamp] - sent[stamp] for stamp in both]) / 1e6
    p50, p99, longest = np.percentile(ms, (50.0, 99.0, 100.0))
    return Latency(topic, len(sent), len(both), float(p50), float(p99), float(longest))


def run_nodes(arrangement: str, groups: Sequence[Sequence[str]]) -> LiveResult:
    """Run groups of nodes, each group in one process, and measure them."""
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)), ProcessGroup(Path(name)) as processes:
        pids = [processes.start('+'.join(nodes), *_command(nodes)).pid for nodes in groups]
        names = ['all three' if len(nodes) == len(_NODES) else nodes[0] for nodes in groups]
        return _measure(arrangement, dict(zip(names, pids, strict=True)))


def run_relay() -> LiveResult:
    """Run a node that computes nothing, and measure it."""
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)):
        process = subprocess.Popen([sys.executable, '-m', 'benchmarks.relay'])
        try:
            return _measure('bare relay', {'relay': process.pid})
        finally:
            process.terminate()
            process.wait()


def _measure(arrangement: str, pids: Mapping[str, int]) -> LiveResult:
    """Measure running processes, given by name."""
    meter = _Meter()
    try:
        meter.wait_for_nodes(len(pids))
        time.sleep(1.0)
        idle = _shares(pids.values(), lambda: time.sleep(_IDLE_S))
        busy = _shares(pids.values(), lambda: meter.publish(_records()))
        memory = [_resident_mb(pid) for pid in pids.values()]
    finally:
        meter.close()
    loads = tuple(ProcessLoad(*row) for row in zip(pids, idle, busy, memory, strict=True))
    return LiveResult(arrangement, meter.latencies(), loads)


def _command(nodes: Sequence[str]) -> list[str]:
    chosen = [text for node in nodes for text in ('--node', node)]
    return ['run', '--train', str(TRAIN_FILE), *chosen]


def _records() -> tuple[Record, ...]:
    day = simulated_day(_SEED)
    first_ns = day.records[0].stamp_ns + round(_START_S * NS_PER_S)
    last_ns = first_ns + round((_WARM_UP_TICKS + _TICKS) * AlignmentConfig().period * NS_PER_S)
    return tuple(record for record in day.records if first_ns <= record.stamp_ns <= last_ns)


@contextmanager
def private_domain(logs: Path) -> Iterator[None]:
    """Put this process and its children into a ROS domain of their own, on this machine only."""
    before = dict(os.environ)
    os.environ |= {
        **local_environment(_PROFILE),
        'ROS_DOMAIN_ID': str(free_domain(os.getpid())),
        'ROS_LOG_DIR': str(logs),
    }
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _shares(pids: Collection[int], work: Any) -> list[float]:
    """Return the share of one core that each process used during ``work``."""
    before, start = [_cpu_s(pid) for pid in pids], time.perf_counter()
    work()
    wall = time.perf_counter() - start
    return [(_cpu_s(pid) - spent) / wall for pid, spent in zip(pids, before, strict=True)]


def _cpu_s(pid: int) -> float:
    """Return user and system time of a process, all threads [s]."""
    after_name = Path(f'/proc/{pid}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf('SC_CLK_TCK')


def _resident_mb(pid: int) -> float:
    pages = int(Path(f'/proc/{pid}/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGESIZE') / 2**20
