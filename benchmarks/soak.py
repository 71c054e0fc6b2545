# SPDX-License-Identifier: Apache-2.0
"""The live nodes for minutes at many times real time on a loaded machine: memory, open files, missed ticks.

Drives of a simulated day are published again and again with later stamps while other processes keep all cores busy.
Every sample must give an estimate of each node, memory and open files must not grow, and nothing may be left in shared
memory at the end.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from rclpy.qos import QoSProfile, ReliabilityPolicy

from benchmarks.days import TRAIN_FILE, simulated_day
from benchmarks.graph import Peer, private_domain
from benchmarks.memory import repeated
from benchmarks.processes import open_files, resident_kb
from benchmarks.tables import Table
from trainid_ros.cli.demo import node_parameters
from trainid_ros.cli.processes import ProcessGroup
from trainid_ros.interface.records import NS_PER_S, OUTPUT_TOPICS, stamp_of
from trainid_ros.ros.topics import message_from_record
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample

_SEED: Final = 1
_DEPTH: Final = 40000
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


class _Feed(Peer):
    def __init__(self) -> None:
        super().__init__('soak')
        # Nothing may be lost on the way: what is missing at the end was missed by a node.
        deep = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._inputs = self.publishers(deep)
        self.sent: dict[int, float] = {}
        self.received: dict[str, set[int]] = {topic.name: set() for topic in OUTPUT_TOPICS}
        self.hear(lambda topic, message: self.received[topic.name].add(stamp_of(message)), deep)

    def publish(self, seconds: float, rate: float) -> float:
        """Publish for some seconds, wait for the last estimates; return by how much a record was late at most [s]."""
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
            self._inputs[type(record)].publish(message_from_record(record))
        end = time.monotonic() + _LAST_S
        while time.monotonic() < end and any(len(stamps) < len(self.sent) for stamps in self.received.values()):
            time.sleep(0.1)
        return latest_s


def soak(seconds: float, rate: float, busy: int, *, realtime: bool = False) -> dict[str, str]:
    """Run the three nodes in one process for some seconds; return what is measured by the name of its row.

    They get records ``rate`` times as fast as recorded while so many processes keep a core ``busy`` each; ``realtime``
    gives them real-time priority, as ``chrt -r 1`` does.

    Raises:
        PermissionError: This user may not give real-time priority.

    """
    # What processes left that were killed long ago, and these may use again.
    old = set(Path(_SHARED).iterdir())
    burners = [multiprocessing.get_context('spawn').Process(target=_burn, daemon=True) for _ in range(busy)]
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)), ProcessGroup(Path(name)) as processes:
        parameters = Path(name) / 'parameters.yaml'
        parameters.write_text(node_parameters(), encoding='utf-8')
        command = ('run', '--train', str(TRAIN_FILE), '--ros-args', '--params-file', str(parameters))
        process = processes.start('nodes', *command)
        readings, stop = list[Reading](), threading.Event()
        reader = threading.Thread(target=lambda: readings.extend(_readings(process.pid, stop)), daemon=True)
        try:
            with _Feed() as feed:
                feed.wait_for_nodes()
                if realtime:
                    _prioritise(process.pid)
                for burner in burners:
                    burner.start()
                reader.start()
                late_s = feed.publish(seconds, rate)
                shared = (_shared_memory(process.pid) | _shared_memory('self')) - old
                stop.set()
                reader.join()
                process.terminate()
                process.wait(_MAX_END_S)
        finally:
            stop.set()
            for burner in burners:
                burner.kill()
    missed = {
        f'missed by {topic}': _missed([sent_s for stamp_ns, sent_s in feed.sent.items() if stamp_ns not in stamps])
        for topic, stamps in feed.received.items()
    }
    settled = [reading for reading in readings if reading.time_s > _SETTLING_S]
    first, last = settled[0], settled[-1]
    parts = [settled[k * (len(settled) - 1) // _PARTS].resident_kb for k in range(_PARTS + 1)]
    return {
        'samples sent': str(len(feed.sent)),
        **missed,
        'publisher late at most, s': f'{late_s:.2f}',  # then many follow at once
        'memory of the nodes, MB': f'{last.resident_kb / 1024:.1f}',
        'grown in each fifth of the time, kB': ', '.join(str(after - before) for before, after in pairwise(parts)),
        'open files, first and last': f'{first.open_files}, {last.open_files}',
        'files left in shared memory': str(sum(path.exists() for path in shared)),
    }


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
    columns = [soak(seconds, rate, busy, realtime=realtime) for realtime in (False, True)]
    rows = tuple((name, plain, columns[1][name]) for name, plain in columns[0].items())
    note = (
        f'{seconds:g} s at {rate:g} x real time each, all cores kept busy by {busy} other processes, beside the load '
        f'below; growth counts after {_SETTLING_S:g} s.'
    )
    header = ('three nodes in one process', 'as started', 'with real-time priority')
    return (Table('Live nodes under load', header, rows, note),)
