# SPDX-License-Identifier: Apache-2.0
"""Run the three nodes on a drive with one fault, in real time, and listen to what they publish.

The nodes continue from checkpoints of the same drive, so that they are VALID when the fault begins.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Final

from benchmarks.days import assumed_train, simulated_day
from benchmarks.faults import BY_NAME, SECOND_COMMAND, injected
from benchmarks.faults_live.cases import HEALTHY, NODES
from benchmarks.faults_live.listener import Listener
from benchmarks.kills import Nodes
from benchmarks.sender import Sending, write_rows
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.records import BRAKE, NS_PER_S, Row
from trainid_ros.setup.checkpoint import Checkpoint, provenance_of
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from benchmarks.faults_live.cases import Action, Case
    from trainid_ros.sim.truth import Truth

_SEED: Final = 4001
# Soon after a departure in mid-drive; the train accelerates.
_BEGIN_S: Final = 682.0
_LENGTH_S: Final = 800.0
# Time for processes to start, and to drive without a fault; time after the fault [s].
_SET_UP_S: Final = 30.0
_TAIL_S: Final = 30.0
_SIGNALS: Final = {'kill': signal.SIGKILL, 'stop': signal.SIGSTOP, 'resume': signal.SIGCONT}
_SENDER: Final = 'benchmarks.sender'


@dataclass(frozen=True, slots=True)
class Heard:
    """What was heard in a trial.

    Attributes:
        listener: The messages.
        truth: True values, by the time of day.
        begin_ns: Start of the fault [ns].
        end_ns: Its end [ns].
        resumed: Whether the nodes had continued from their checkpoints.

    """

    listener: Listener
    truth: Truth
    begin_ns: int
    end_ns: int
    resumed: bool


class Trial:
    """The processes of one case; they share a folder and the ROS domain of this process."""

    def __init__(self, case: Case, folder: Path) -> None:
        self._case = case
        self._folder = folder
        rows, truth = _drive()
        self._begin_ns = time.time_ns() + round(_SET_UP_S * NS_PER_S)
        self._end_ns = self._begin_ns + round(case.duration_s * NS_PER_S)
        shift_ns = self._begin_ns - truth.start_ns - round(_BEGIN_S * NS_PER_S)
        self._truth = replace(truth, start_ns=truth.start_ns + shift_ns)
        shifted = [(topic, stamp + shift_ns, x, y, flag) for topic, stamp, x, y, flag in rows]
        self._write_state([row for row in shifted if row[1] < time.time_ns()])
        self._write_rows(shifted)
        self._senders: dict[str, subprocess.Popen[bytes]] = {}
        self._nodes: Nodes | None = None

    def run(self) -> Heard:
        """Start everything, do what the case says, and return what was heard."""
        with Listener() as listener:
            try:
                self._start(NODES)
                for sender in HEALTHY:
                    self._start(sender.name)
                for action in sorted(self._case.actions):
                    self._sleep_until(action.at_s)
                    self._act(action)
                self._sleep_until(self._case.duration_s + _TAIL_S)
            finally:
                self._stop()
        log = (self._folder / 'log.txt').read_text(encoding='utf-8', errors='replace')
        resumed = log.count('continues from') >= len(KINDS)
        return Heard(listener, self._truth, self._begin_ns, self._end_ns, resumed)

    def _sleep_until(self, at_s: float) -> None:
        time.sleep(max((self._begin_ns - time.time_ns()) / NS_PER_S + at_s, 0.0))

    def _act(self, action: Action) -> None:
        if action.verb == 'start':
            self._start(action.process)
            return
        assert self._nodes is not None
        process = self._nodes.process if action.process == NODES else self._senders[action.process]
        process.send_signal(_SIGNALS[action.verb])
        if action.verb == 'kill':
            process.wait()

    def _start(self, name: str) -> None:
        if name == NODES:
            self._nodes = Nodes(self._folder / 'log.txt', int(os.environ['ROS_DOMAIN_ID']), self._params)
            return
        options = {sender.name: sender.options for sender in (*HEALTHY, *self._case.senders)}
        command = [sys.executable, '-m', _SENDER, str(os.getpid()), name, str(self._rows_of(name)), *options[name]]
        self._senders[name] = subprocess.Popen(command)

    def _stop(self) -> None:
        for process in self._senders.values():
            process.kill()
            process.wait()
        if self._nodes is not None:
            self._nodes.process.kill()
            self._nodes.close()

    # Files

    @property
    def _params(self) -> Path:
        return self._folder / 'params.yaml'

    def _rows_of(self, name: str) -> Path:
        return self._folder / f'{name}.json'

    def _write_state(self, rows: Sequence[Row]) -> None:
        """Write checkpoints after a part of the drive, and the parameters that name them."""
        train, settings = assumed_train(), EstimatorSettings()
        pipelines = [kind.pipeline(train, settings) for kind in KINDS]
        PipelineGroup(pipelines).push_rows(rows)
        lines = []
        for kind, pipeline in zip(KINDS, pipelines, strict=True):
            path = self._folder / f'{kind.node_name}.state.json'
            stamp_ns = pipeline.current().stamp_ns
            checkpoint = Checkpoint(provenance_of(kind.name, train, settings), stamp_ns, stamp_ns, pipeline.save())
            path.write_text(checkpoint.text(), encoding='utf-8')
            values = ', '.join((f'checkpoint_file: {path}', *self._case.parameters))
            lines.append(f'/{kind.node_name}: {{ros__parameters: {{{values}}}}}\n')
        self._params.write_text(''.join(lines), encoding='utf-8')

    def _write_rows(self, rows: Sequence[Row]) -> None:
        """Write the rows of each process, from the set-up on."""
        begin_ns, end_ns, case = self._begin_ns, self._end_ns, self._case
        soon = [row for row in rows if row[1] > time.time_ns() - NS_PER_S]
        faults = [BY_NAME[name] for name in case.faults]
        # A fault of a clock changes the stamp, but not the time at which a message is sent.
        changed = injected(soon, [fault for fault in faults if not fault.shifts_stamps], begin_ns, end_ns)
        stamped = injected(changed, [fault for fault in faults if fault.shifts_stamps], begin_ns, end_ns)
        sendings = [Sending(row[1], sent) for row, sent in zip(changed, stamped, strict=True)]
        for sender in (*HEALTHY, *case.senders):
            own = [item for item in sendings if item.row[0] in sender.topics]
            write_rows(self._rows_of(sender.name), _of_second(own) if sender.is_second else own)


def _of_second(sendings: Sequence[Sending]) -> list[Sending]:
    """Return what a second publisher of the brake command sends between the messages of the first."""
    rows = [item.row for item in sendings if item.row[0] == BRAKE]
    both = SECOND_COMMAND.change(rows, rows[0][1], rows[-1][1] + 1)
    return [Sending(row[1], row) for row in both if row not in rows]


@cache
def _drive() -> tuple[tuple[Row, ...], Truth]:
    day = simulated_day(_SEED)
    last_ns = day.truth.start_ns + round(_LENGTH_S * NS_PER_S)
    return tuple(record.row() for record in day.records if record.stamp_ns < last_ns), day.truth
