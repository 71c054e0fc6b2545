# SPDX-License-Identifier: Apache-2.0
"""Checkpoints under ``kill -9``: the three live nodes in one process, killed at random moments and started again.

This process publishes the records of a simulated day in real time, and after each kill reads what is on disk.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Self

import numpy as np

from benchmarks.days import TRAIN_FILE, simulated_day
from benchmarks.graph import Peer
from benchmarks.tables import Table
from trainid_ros.cli.processes import free_domain
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, OutputTopic, stamp_of
from trainid_ros.ros.topics import message_from_record
from trainid_ros.setup.checkpoint import Checkpoint, parse_checkpoint
from trainid_ros.setup.pipelines import KINDS

_SEED: Final = 1
_PERIOD_S: Final = 0.2
_SAMPLE_S: Final = 0.2
# Of four kills one comes within this time from the start of the process, the others from its first estimates.
_LATEST_S: Final = 4.0
_SETTLED_S: Final = 2.0 * (_PERIOD_S + _SAMPLE_S)
_PATIENCE_S: Final = 60.0
_RUN: Final = 'import sys; from trainid_ros.cli.main import main; sys.exit(main(sys.argv[1:]))'


@dataclass(slots=True)
class Outcome:
    kills: int = 0  # Number of kills
    active: int = 0  # Those that met nodes which had published for more than two periods
    age_s: list[float] = field(default_factory=list)  # Age of the checkpoint of each of these nodes at the kill [s]
    lost_s: list[float] = field(default_factory=list)  # Time covered by their estimates after the checkpoint [s]
    lost_at_stop: int = 0  # Estimates that came after the checkpoint of a process which was asked to end
    torn: int = 0  # Files that could not be read
    parts: set[str] = field(default_factory=set)  # Names of interrupted writes
    most_parts: int = 0  # The most of them at a time
    strays: set[str] = field(default_factory=set)  # Files of any other name at the end
    rejected: int = 0  # Starts that did not continue from the checkpoint on disk
    backward: int = 0  # Checkpoints older than the one before
    unsaved: int = 0  # Warnings that a checkpoint could not be written


def measure(kills: int) -> tuple[Table, ...]:
    with tempfile.TemporaryDirectory() as folder:
        outcome = Campaign(Path(folder)).run(kills)
    rows = (
        ('kills', str(outcome.kills)),
        ('... of active nodes', str(outcome.active)),
        ('age of the checkpoint at the kill, median / 99 % / most [s]', _spread(outcome.age_s)),
        ('lost of what was published, median / 99 % / most [s]', _spread(outcome.lost_s)),
        ('lost at the end by SIGTERM, estimates', str(outcome.lost_at_stop)),
        ('torn files', str(outcome.torn)),
        ('interrupted writes', str(len(outcome.parts))),
        ('most files of interrupted writes at a time', str(outcome.most_parts)),
        ('stray files at the end', str(len(outcome.strays))),
        ('starts without the checkpoint', str(outcome.rejected)),
        ('checkpoints that went back', str(outcome.backward)),
        ('checkpoints that could not be written', str(outcome.unsaved)),
    )
    note = (
        f'checkpoint_period = {_PERIOD_S:g} s; a sample every {_SAMPLE_S:g} s. The age is by the clock; where a '
        'process had not saved yet, it is that of the checkpoint of the process before. Lost is by stamps what lies '
        'between checkpoint and last estimate: on a loaded machine the last period, and the time until a file is on '
        'disk. The next start removes what an interrupted write has left.'
    )
    return (Table('kill -9 at random moments, three nodes in one process', ('', 'value'), rows, note),)


def _spread(values: list[float]) -> str:
    return ' / '.join(f'{x:.2f}' for x in np.percentile(values, (50.0, 99.0, 100.0))) if values else '-'


class Campaign:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._states = folder / 'states'
        self._states.mkdir()
        self._params = folder / 'params.yaml'
        self._params.write_text(
            ''.join(
                f'/{kind.node_name}: {{ros__parameters: {{checkpoint_period: {_PERIOD_S}, '
                f'checkpoint_file: {self._states / kind.node_name}.json}}}}\n'
                for kind in KINDS
            ),
            encoding='utf-8',
        )
        self._domain = free_domain(os.getpid())
        self._train = Train(self._domain)
        self._outcome = Outcome()

    def run(self, kills: int) -> Outcome:
        """Kill so many times; end with one clean stop."""
        rng = np.random.default_rng(_SEED)
        with self._train:
            for k in range(kills):
                self._kill_after(float(rng.uniform(0.0, _LATEST_S)), of_active=bool(k % 4))
            self._stop()
        names = {item.name for item in self._states.iterdir()}
        self._outcome.strays = names - {f'{kind.node_name}.json' for kind in KINDS}
        return self._outcome

    def _kill_after(self, delay_s: float, *, of_active: bool) -> None:
        before, start_ns = self._read(), time.time_ns()
        nodes = Nodes(self._folder / 'log.txt', self._domain, self._params)
        if of_active:
            self._wait_for_estimates(nodes)
        time.sleep(delay_s)
        killed_ns = time.time_ns()
        nodes.process.kill()
        nodes.close()
        self._outcome.kills += 1
        self._judge(nodes, start_ns, killed_ns, before, self._read())

    def _stop(self) -> None:
        nodes = Nodes(self._folder / 'log.txt', self._domain, self._params)
        self._wait_for_estimates(nodes)
        nodes.process.terminate()
        nodes.close()
        after = self._read()
        for name, stamps in self._train.take().items():
            self._outcome.lost_at_stop += sum(stamp > after[name].stamp_ns for stamp in stamps)

    def _wait_for_estimates(self, nodes: Nodes) -> None:
        _wait_until(lambda: len(nodes.active) == len(KINDS))
        self._train.take()
        _wait_until(lambda: self._train.is_heard)

    def _read(self) -> dict[str, Checkpoint]:
        found = {}
        for path in self._states.glob('*.json'):
            try:
                found[path.stem] = parse_checkpoint(path.read_text(encoding='utf-8'), str(path))
            except InputError:
                self._outcome.torn += 1
        parts = {path.name for path in self._states.iterdir() if path.suffix == '.part'}
        self._outcome.parts |= parts
        self._outcome.most_parts = max(self._outcome.most_parts, len(parts))
        return found

    def _judge(
        self,
        nodes: Nodes,
        start_ns: int,
        killed_ns: int,
        before: dict[str, Checkpoint],
        after: dict[str, Checkpoint],
    ) -> None:
        outcome, log = self._outcome, nodes.log.read_text(encoding='utf-8', errors='replace')
        outcome.rejected += log.count('starting from the prior')
        for name, checkpoint in before.items():
            outcome.rejected += name in nodes.active and f'[{name}]: continues from' not in log
            outcome.backward += name not in after or after[name].stamp_ns < checkpoint.stamp_ns
        outcome.unsaved += log.count('would be lost')
        # Estimates of the process before may arrive late.
        seen = {name: [stamp for stamp in stamps if stamp > start_ns] for name, stamps in self._train.take().items()}
        if all(len(seen.get(kind.node_name, ())) * _SAMPLE_S > _SETTLED_S for kind in KINDS):
            outcome.active += 1
            for name, stamps in seen.items():
                outcome.age_s.append((killed_ns - after[name].saved_ns) / NS_PER_S)
                outcome.lost_s.append(_SAMPLE_S * sum(stamp > after[name].stamp_ns for stamp in stamps))


def _wait_until(holds: Callable[[], bool]) -> None:
    """Wait for something, but not for ever."""
    deadline = time.monotonic() + _PATIENCE_S
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.02)


class Nodes:
    """The process of the three nodes, and the names of those that have become active."""

    def __init__(self, log: Path, domain: int, params: Path) -> None:
        self.log = log
        self.active: set[str] = set()
        environment = os.environ | {
            'ROS_DOMAIN_ID': str(domain),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_LOG_DIR': str(log.parent),
        }
        arguments = ('run', '--train', str(TRAIN_FILE), '--ros-args', '--params-file', str(params))
        self._errors: IO[bytes] = log.open('wb')
        self.process = subprocess.Popen(
            [sys.executable, '-c', _RUN, *arguments],
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
        )
        self._reader = threading.Thread(target=self._follow, daemon=True)
        self._reader.start()

    def _follow(self) -> None:
        for line in self.process.stdout or ():
            if ' is active: ' in line:
                self.active.add(line.split()[0])

    def close(self) -> None:
        self.process.wait(_PATIENCE_S)
        self._reader.join()
        if self.process.stdout is not None:
            self.process.stdout.close()
        self._errors.close()


class Train(Peer):
    """Publishes the records of a simulated day in real time, stamped with the time of day, and hears the estimates."""

    def __init__(self, domain: int) -> None:
        super().__init__('train', domain)
        self._inputs = self.publishers()
        self._estimates: dict[str, list[int]] = {}
        self._names = {kind.topic: kind.node_name for kind in KINDS}
        self.hear(self._note)
        self._end = threading.Event()
        self._sender = threading.Thread(target=self._publish, daemon=True)

    def _note(self, topic: OutputTopic, message: Any) -> None:
        # STALE is the status before the first sample; the adhesion comes with each brake rate.
        if topic in self._names and message.status != message.STALE:
            self._estimates.setdefault(self._names[topic], []).append(stamp_of(message))

    @property
    def is_heard(self) -> bool:
        """Whether estimates of all nodes have come since they were taken."""
        return len(self._estimates) == len(KINDS)

    def take(self) -> dict[str, list[int]]:
        """Return the stamps of the estimates received since the last call [ns], by the name of the node."""
        taken, self._estimates = self._estimates, {}
        return taken

    def __enter__(self) -> Self:
        self._sender.start()
        return super().__enter__()

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._sender.join()
        super().__exit__()

    def _publish(self) -> None:
        records: Sequence[Any] = simulated_day(_SEED).records
        shift_ns = time.time_ns() - records[0].stamp_ns
        for record in records:
            stamp_ns = record.stamp_ns + shift_ns
            if self._end.wait(max((stamp_ns - time.time_ns()) / NS_PER_S, 0.0)):
                return
            message = message_from_record(record)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
            self._inputs[type(record)].publish(message)
