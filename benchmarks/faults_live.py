# SPDX-License-Identifier: Apache-2.0
"""Faults of messages, publishers and processes, in real time: the three nodes in one process, and their publishers.

Each case has processes and a ROS domain of its own, and says what is expected to name it; some run at the same time.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks

from benchmarks.days import assumed_train, simulated_day
from benchmarks.faults import BY_NAME, SECOND_COMMAND, injected
from benchmarks.graph import Peer, private_domain
from benchmarks.kills import Nodes
from benchmarks.seeds import over_seeds
from benchmarks.sender import Sending, write_rows
from benchmarks.tables import Table, columns
from trainid_ros.cli.processes import free_domain
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.records import (
    BRAKE,
    BRAKE_RATE_TOPIC,
    FORCE,
    GRADIENT,
    MASS,
    MAY_BE_UNKNOWN,
    NS_PER_S,
    OUTPUT_TOPICS,
    RESISTANCE_TOPIC,
    SPEED,
    Row,
    stamp_of,
)
from trainid_ros.interface.results import Status
from trainid_ros.ros.topics import LEASE_S, estimate_qos, message_class
from trainid_ros.setup.checkpoint import Checkpoint, provenance_of
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
from trainid_ros.sim.truth import Truth

FAULT_S: Final = 30.0
"""How long a fault lasts that ends [s]."""


class Sender(NamedTuple):
    name: str  # Name of the process and of its node
    topics: tuple[int, ...]  # The topics, as places
    options: tuple[str, ...] = ()  # Options of the program
    waits: bool = False  # True if it is not started before an action does so
    is_second: bool = False  # True if it sends the messages of a second publisher of the brake command


class Action(NamedTuple):
    """What is done to a process, at a time from the start of the fault on [s]: start, kill, stop or resume."""

    at_s: float
    verb: str
    process: str


@dataclass(frozen=True, slots=True)
class Case:
    name: str  # What happens
    expected: str  # Regular expression of what names it in the diagnostics
    faults: tuple[str, ...] = ()  # Faults of the messages, by their names in the catalogue
    actions: tuple[Action, ...] = ()  # What is done to processes
    senders: tuple[Sender, ...] = ()  # Processes beside those of a healthy train
    parameters: tuple[str, ...] = ()  # Parameters of all nodes, each as YAML
    duration_s: float = FAULT_S  # How long it lasts [s]


NODES: Final = 'nodes'
ODOMETER: Final = Sender('odometer', (SPEED,))
HEALTHY: Final = (ODOMETER, Sender('train_control', (FORCE, GRADIENT, BRAKE, MASS)))
_RELIABLE: Final = 'qos_overrides./ato/speed.subscription.reliability: reliable'


def _replaced(other: Sender) -> tuple[Action, ...]:
    """Return actions that let another process publish in the place of the odometer for some time."""
    return (
        Action(0.0, 'kill', ODOMETER.name),
        Action(0.0, 'start', other.name),
        Action(FAULT_S, 'kill', other.name),
        Action(FAULT_S, 'start', ODOMETER.name),
    )


_BEST_EFFORT: Final = Sender('best_effort', (SPEED,), ('--best-effort',), waits=True)
_WRONG_TYPE: Final = Sender('wrong_type', (SPEED,), ('--wrong-type',), waits=True)
_SECOND: Final = Sender('second_control', (BRAKE,), waits=True, is_second=True)

CASES: Final = (
    Case('nothing', '.'),
    Case('speed in km/h', 'ato/speed is in km/h', ('speed in km/h',)),
    Case('force sign', 'ato/force', ('force sign',)),
    Case('force in kN', 'ato/force', ('force in kN',)),
    Case('speed frozen', 'ato/speed', ('speed frozen',)),
    Case('speed not a number', 'NOT_FINITE', ('speed not a number',)),
    Case('force stamped 1 s late', 'ato/force', ('force +1 s',)),
    Case('clock of speed 1 s behind', '1.0 s behind', ('speed clock -1 s',)),
    Case('all clocks 10 s back', r'(9\.9|10\.0) s behind', ('clock -10 s',)),
    Case('publisher silent', 'no messages arrive', ('speed missing',)),
    Case('publisher killed', 'no message for', actions=(Action(0.0, 'kill', 'odometer'),)),
    Case(
        'publisher restarted after 5 s',
        'no message for',
        actions=(Action(0.0, 'kill', 'odometer'), Action(5.0, 'start', 'odometer')),
        duration_s=5.0,
    ),
    Case(
        'publisher stalled for 3 s',
        'no message for',
        actions=(Action(0.0, 'stop', 'odometer'), Action(3.0, 'resume', 'odometer')),
        duration_s=3.0,
    ),
    Case(
        'best effort, reliable asked for',
        'incompatible quality of service',
        actions=_replaced(_BEST_EFFORT),
        senders=(_BEST_EFFORT,),
        parameters=(_RELIABLE,),
    ),
    Case(
        'wrong message type',
        'std_msgs/msg/Float64 instead of trainid_msgs/msg/AtoSpeed',
        actions=_replaced(_WRONG_TYPE),
        senders=(_WRONG_TYPE,),
    ),
    Case(
        'second brake publisher',
        '2 publishers|alternates',
        actions=(Action(0.0, 'start', 'second_control'), Action(FAULT_S, 'kill', 'second_control')),
        senders=(_SECOND,),
    ),
    Case(
        'nodes killed, restarted after 5 s',
        'not alive',
        actions=(Action(0.0, 'kill', NODES), Action(5.0, 'start', NODES)),
        duration_s=5.0,
    ),
    Case('nodes stalled for 3 s', 'not alive', actions=(Action(0.0, 'stop', NODES), Action(3.0, 'resume', NODES))),
)


_SEED: Final = 4001
# Soon after a departure in mid-drive; the train accelerates.
_BEGIN_S: Final = 682.0
_LENGTH_S: Final = 800.0
# Time for processes to start, and to drive without a fault; time after the fault [s].
_SET_UP_S: Final = 30.0
_TAIL_S: Final = 30.0
_SIGNALS: Final = {'kill': signal.SIGKILL, 'stop': signal.SIGSTOP, 'resume': signal.SIGCONT}
_PERIOD_S: Final = 0.2
# The nodes must have published for this time before the fault [s].
_READY_S: Final = 3.0
_FIT: Final = (Status.VALID, Status.HOLDING)
_ESTIMATOR: Final = 'resistance_estimator: estimator'
_REJECTED: Final = 'rejected.'
_SINCE: Final = re.compile(r', since [-0-9: ]+ UTC')
_AT_A_TIME: Final = 3
_DOMAINS_APART: Final = 7
_HEADER: Final = columns(
    'fault | not fit after, s | named after, s | VALID > 3 std, s | worst, std | fit again, s | rejected | '
    'what names it'
)
_NOTE: Final = (
    f'One trial each, at 5 Hz; the fault lasts {FAULT_S:g} s, or as long as it says. Not fit: the resistance is '
    'neither VALID nor HOLDING. Named: by `/diagnostics`, once a second, or by an event of the middleware. VALID '
    'beyond 3 std: of resistance or brake rate, since the start of the fault. Fit again: after the end of the fault. '
    'Rejected: records and samples of the resistance, by the most frequent reason.'
)


def measure() -> tuple[Table, ...]:
    outcomes = over_seeds(run, CASES, jobs=_AT_A_TIME)
    rows = tuple(_row(case, outcome) for case, outcome in zip(CASES, outcomes, strict=True))
    return (Table('Faults through real processes', _HEADER, rows, _NOTE),)


def run(case: Case) -> Outcome:
    with tempfile.TemporaryDirectory() as name, private_domain(Path(name)):
        # Cases that start at the same time must not find the same domain free.
        os.environ['ROS_DOMAIN_ID'] = str(free_domain(_DOMAINS_APART * os.getpid()))
        return score(case, Trial(case, Path(name)).run())


def _row(case: Case, outcome: Outcome) -> tuple[str, ...]:
    marks = {'FINITE': not outcome.non_finite, 'RESUMED': outcome.resumed, 'READY': outcome.ready}
    name = case.name + ''.join(f' (NOT {mark})' for mark, holds in marks.items() if not holds)
    ((reason, count),) = outcome.rejected.most_common(1) or (('', 0),)
    return (
        name,
        _seconds(outcome.withdrawn_s),
        _seconds(outcome.named_s),
        f'{outcome.wrong_s:.1f}',
        f'{outcome.worst:.1f}',
        _seconds(outcome.back_s),
        f'{count} {reason}' if count else '-',
        outcome.text,
    )


def _seconds(value: float) -> str:
    return f'{value:.1f}' if math.isfinite(value) else '-'


class Arrival(NamedTuple):
    """What arrived when [ns]: a message, or a sentence of the middleware."""

    time_ns: int
    what: Any


class Listener(Peer):
    """A controller and a display.

    Attributes:
        estimates: Estimates by topic.
        diagnostics: Single statuses of ``/diagnostics``.
        events: When the publisher of the resistance was lost, or came back.

    """

    def __init__(self) -> None:
        super().__init__('controller')
        self.estimates: dict[str, list[Arrival]] = {topic.name: [] for topic in OUTPUT_TOPICS}
        self.diagnostics: list[Arrival] = []
        self.events: list[Arrival] = []
        for topic in OUTPUT_TOPICS:
            profile, events = estimate_qos(), None
            if topic is RESISTANCE_TOPIC:
                profile.liveliness_lease_duration = Duration(seconds=LEASE_S)
                events = SubscriptionEventCallbacks(liveliness=self._note_liveliness)
            note = partial(self._note, self.estimates[topic.name])
            self.node.create_subscription(message_class(topic), topic.name, note, profile, event_callbacks=events)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._note_statuses, estimate_qos())

    @staticmethod
    def _note(arrivals: list[Arrival], message: Any) -> None:
        arrivals.append(Arrival(time.time_ns(), message))

    def _note_statuses(self, array: Any) -> None:
        now_ns = time.time_ns()
        self.diagnostics.extend(Arrival(now_ns, status) for status in array.status)

    def _note_liveliness(self, event: Any) -> None:
        text = 'alive' if event.alive_count else 'not alive'
        self.events.append(Arrival(time.time_ns(), f'liveliness: the publisher is {text}'))


@dataclass(frozen=True, slots=True)
class Heard:
    listener: Listener  # The messages
    truth: Truth  # True values, by the time of day
    begin_ns: int  # Start of the fault [ns]
    end_ns: int  # Its end [ns]
    resumed: bool  # Whether the nodes had continued from their checkpoints


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
        command = [
            sys.executable,
            '-m',
            'benchmarks.sender',
            str(os.getpid()),
            name,
            str(self._rows_of(name)),
            *options[name],
        ]
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


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the topics showed; times from the start of the fault [s], infinite if it did not happen."""

    withdrawn_s: float  # Until the resistance was neither VALID nor HOLDING
    named_s: float  # Until diagnostics, or an event of the middleware, named the fault
    text: str  # What named it
    wrong_s: float  # Time that the resistance or the brake rate was VALID at more than 3 std from the truth [s]
    worst: float  # Largest error of a VALID resistance or brake rate [std]
    back_s: float  # From the end of the fault until the resistance was VALID or HOLDING for good again [s]
    non_finite: int  # Number of estimates with a number that is not finite
    rejected: Counter[str]  # Records and samples of the resistance rejected since then, by reason
    resumed: bool  # Whether the nodes had continued from their checkpoints
    ready: bool  # Whether they had published for some seconds before the fault


def score(case: Case, heard: Heard) -> Outcome:
    listener, begin_ns = heard.listener, heard.begin_ns
    named_s, text = _naming(case, heard)
    ratios = np.array([abs(ratio) for ratio in _ratios(case, heard)])
    statuses = [
        ((at_ns - begin_ns) / NS_PER_S, message.status) for at_ns, message in listener.estimates[RESISTANCE_TOPIC.name]
    ]
    unfit_s = [at_s for at_s, status in statuses if at_s >= 0.0 and status not in _FIT]
    end_s = (heard.end_ns - begin_ns) / NS_PER_S
    is_back = bool(statuses) and statuses[-1][1] in _FIT
    return Outcome(
        withdrawn_s=min(unfit_s, default=math.inf),
        named_s=named_s,
        text=text,
        wrong_s=float(np.sum(ratios > 3.0)) * _PERIOD_S,
        worst=float(ratios.max(initial=0.0)),
        back_s=max([0.0, *(at_s - end_s for at_s in unfit_s)]) if is_back else math.inf,
        non_finite=sum(not _is_finite(message) for made in listener.estimates.values() for _, message in made),
        rejected=_counts(heard, after=True) - _counts(heard, after=False),
        resumed=heard.resumed,
        ready=any(at_s < -_READY_S for at_s, _ in statuses),
    )


def _naming(case: Case, heard: Heard) -> tuple[float, str]:
    """Return when something named the fault [s], and what."""
    found = [(at_ns, str(text)) for at_ns, text in heard.listener.events]
    for at_ns, status in heard.listener.diagnostics:
        if status.level != DiagnosticStatus.OK:
            found.append((at_ns, f'{status.name.partition(": ")[2]}: {status.message}'))
    for at_ns, text in sorted(found):
        if at_ns >= heard.begin_ns and re.search(case.expected, text):
            # The first sentence, without time and action.
            return (at_ns - heard.begin_ns) / NS_PER_S, _SINCE.split(text)[0].partition('; ')[0]
    return math.inf, '-'


def _ratios(case: Case, heard: Heard) -> Iterable[float]:
    """Return the errors of the VALID estimates since the start of the fault [std]."""
    step_ns = round(sum(BY_NAME[name].clock_step_s for name in case.faults) * NS_PER_S)
    for topic in (RESISTANCE_TOPIC, BRAKE_RATE_TOPIC):
        for at_ns, message in heard.listener.estimates[topic.name]:
            if at_ns < heard.begin_ns or message.status != Status.VALID:
                continue
            stamp_ns = stamp_of(message)
            # By which of the two clocks: what is VALID is not old.
            true_ns = min(stamp_ns, stamp_ns - step_ns, key=lambda time_ns: abs(at_ns - time_ns))
            yield _ratio(message, heard, true_ns)


def _ratio(message: Any, heard: Heard, time_ns: int) -> float:
    point = heard.truth.truth_at_ns(time_ns)
    if hasattr(message, 'brake_rate'):
        assert point.brake_rate is not None
        return float((message.brake_rate - point.brake_rate) / message.brake_rate_std)
    davis, v = point.resistance, message.speed
    return float((message.resistance - davis.a - davis.b * v - davis.c * v * v) / message.resistance_std)


def _is_finite(message: Any) -> bool:
    kinds = message.get_fields_and_field_types().items()
    names = [name for name, kind in kinds if kind.startswith('double') and name not in MAY_BE_UNKNOWN]
    return all(bool(np.isfinite(getattr(message, name)).all()) for name in names)


def _counts(heard: Heard, *, after: bool) -> Counter[str]:
    """Return what the resistance has rejected by reason: until the start of the fault, or until the end."""
    found: Counter[str] = Counter()
    for at_ns, status in heard.listener.diagnostics:
        if status.name == _ESTIMATOR and (after or at_ns < heard.begin_ns):
            counts = [item for item in status.values if item.key.startswith(_REJECTED)]
            found = Counter({item.key.removeprefix(_REJECTED): int(item.value) for item in counts})
    return found
