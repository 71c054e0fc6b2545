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
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.days import TRAIN_FILE, simulated_day
from benchmarks.graph import Peer, private_domain
from benchmarks.processes import cpu_s, resident_kb
from benchmarks.tables import Table
from trainid_ros.cli.processes import ProcessGroup
from trainid_ros.interface.records import NS_PER_S, OUTPUT_TOPICS, OutputTopic, Record, stamp_of
from trainid_ros.ros.topics import message_from_record
from trainid_ros.setup.pipelines import KINDS
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample

Rows = list[tuple[str, ...]]
_SEED: Final = 1
# A part of the day with traction, coasting, braking and standstill.
_START_S: Final = 40.0
_WARM_UP_TICKS: Final = 25
_TICKS: Final = 310
_IDLE_S: Final = 4.0
_NODES: Final = tuple(kind.node_name for kind in KINDS)


def measure() -> tuple[Table, ...]:
    """Run both distributions of nodes over processes, and a bare relay; return the tables."""
    together = _run_nodes('one process', {'all three': _NODES})
    apart = _run_nodes('three processes', {name: (name,) for name in _NODES})
    latencies, loads = zip(together, apart, _run_relay(), strict=True)
    load = f'Load of the machine: {os.getloadavg()[0]:.1f}.'
    header = ('last input to estimate, ms', 'ticks', 'received', 'p50', 'p99', 'longest')
    return (
        Table('Latency of estimates at 5 Hz', header, tuple(chain(*latencies)), load),
        Table(
            'CPU time and memory of the nodes',
            ('share of one core', 'idle', 'at 5 Hz', 'resident MB'),
            tuple(chain(*loads)),
            'Idle: active nodes without input.',
        ),
    )


def _run_nodes(arrangement: str, groups: Mapping[str, Sequence[str]]) -> tuple[Rows, Rows]:
    """Run groups of nodes, each group in one process, and measure them."""
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)), ProcessGroup(Path(name)) as processes:
        pids = {}
        for group, nodes in groups.items():
            chosen = [text for node in nodes for text in ('--node', node)]
            pids[group] = processes.start(group, 'run', '--train', str(TRAIN_FILE), *chosen).pid
        return _measure(arrangement, pids)


def _run_relay() -> tuple[Rows, Rows]:
    """Run a node that computes nothing, and measure it."""
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)):
        process = subprocess.Popen([sys.executable, '-m', 'benchmarks.relay'])
        try:
            return _measure('bare relay', {'relay': process.pid})
        finally:
            process.terminate()
            process.wait()


def _measure(arrangement: str, pids: Mapping[str, int]) -> tuple[Rows, Rows]:
    """Return latencies by topic, and load and memory by process, of running processes given by name."""
    with _Meter() as meter:
        meter.wait_for_nodes(len(pids))
        idle = _shares(pids.values(), lambda: time.sleep(_IDLE_S))
        busy = _shares(pids.values(), lambda: meter.publish(_records()))
        memory = [resident_kb(pid) / 1024.0 for pid in pids.values()]
    loads: Rows = [
        (f'{arrangement}: {name}', f'{still:.1%}', f'{at_work:.1%}', f'{size_mb:.0f}')
        for name, still, at_work, size_mb in zip(pids, idle, busy, memory, strict=True)
    ]
    return [(f'{arrangement}: {topic}', *cells) for topic, cells in meter.latencies().items()], loads


class _Meter(Peer):
    """Publishes records and stores the times at which the estimates are received."""

    def __init__(self) -> None:
        super().__init__('benchmark')
        self._inputs = self.publishers()
        self._sent_ns: dict[int, int] = {}
        self._received_ns: dict[str, dict[int, int]] = {topic.name: {} for topic in OUTPUT_TOPICS}
        self.hear(self._note)

    def _note(self, topic: OutputTopic, message: Any) -> None:
        self._received_ns[topic.name].setdefault(stamp_of(message), time.perf_counter_ns())

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
                self._sent_ns[sample.stamp_ns] = time.perf_counter_ns()
            self._inputs[type(record)].publish(message)
        time.sleep(1.0)

    def latencies(self) -> dict[str, tuple[str, ...]]:
        """Return by topic the numbers of samples and of estimates after the warm-up, and the latencies [ms]."""
        sent_ns, found = dict(list(self._sent_ns.items())[_WARM_UP_TICKS:]), {}
        for topic, received_ns in self._received_ns.items():
            ms = [(received_ns[stamp] - at) / 1e6 for stamp, at in sent_ns.items() if stamp in received_ns]
            shown = (f'{value:.2f}' for value in np.percentile(ms, (50.0, 99.0, 100.0)))
            found[topic] = (str(len(sent_ns)), str(len(ms)), *shown)
        return found


def _records() -> tuple[Record, ...]:
    day = simulated_day(_SEED)
    first_ns = day.records[0].stamp_ns + round(_START_S * NS_PER_S)
    last_ns = first_ns + round((_WARM_UP_TICKS + _TICKS) * AlignmentConfig().period * NS_PER_S)
    return tuple(record for record in day.records if first_ns <= record.stamp_ns <= last_ns)


def _shares(pids: Collection[int], work: Callable[[], None]) -> list[float]:
    """Return the share of one core that each process used during ``work``."""
    before, start = [cpu_s(pid) for pid in pids], time.perf_counter()
    work()
    wall = time.perf_counter() - start
    return [(cpu_s(pid) - spent) / wall for pid, spent in zip(pids, before, strict=True)]
