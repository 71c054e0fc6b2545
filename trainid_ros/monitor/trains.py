# SPDX-License-Identifier: Apache-2.0
"""What is known of each train, and what a person is shown of it at one moment: plain values, without ROS.

Known are the messages, when they arrived, and what the nodes report on ``/diagnostics``. Two clocks are used: a steady
one [s] for arrivals, and that of the stamps [ns] for ages.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum
from itertools import pairwise
from statistics import median
from typing import Any, Final, NamedTuple

from trainid_ros.interface.records import (
    ADHESION_TOPIC,
    BRAKE_RATE_TOPIC,
    INPUT_TOPICS,
    KM_H,
    MASS_TOPIC,
    NS_PER_S,
    RESISTANCE_TOPIC,
    SPEED_MODEL_TOPIC,
    SPEED_TOPIC,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    InputTopic,
    MassRecord,
    OutputTopic,
    Record,
    SpeedRecord,
    status_of,
)
from trainid_ros.interface.results import Status, deviations
from trainid_ros.resistance.davis_posterior import resistance_std
from trainid_ros.setup.pipelines import KINDS


class Level(IntEnum):
    """Level of a diagnostic message; the same numbers as in ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3

    @property
    def severity(self) -> int:
        """How bad it is: unlike by the numbers, an error is worse than STALE."""
        return (Level.OK, Level.WARN, Level.STALE, Level.ERROR).index(self)

    @classmethod
    def _missing_(cls, value: object) -> Level:  # noqa: ARG003 - any other number, which may come from other software
        return cls.ERROR


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong or in progress."""

    level: Level  # How bad it is
    source: str  # Node or input that it is about
    text: str  # What is the case, since when, and what to do


@dataclass(frozen=True, slots=True)
class InputView:
    """One input."""

    name: str  # Topic, without the namespace of the train; of a remapped one both names
    value: str  # Its newest value with its unit, '' before the first
    rate: float  # Messages in a second [Hz], NaN if unknown
    age_s: float  # Age of the newest stamp [s], NaN if unknown or of another clock
    silent_s: float  # Time since the last message [s], infinite before the first
    publishers: tuple[str, ...]  # Nodes that publish it
    optional: bool  # True if the estimators can run without it


@dataclass(frozen=True, slots=True)
class Point:
    """An estimate of the past: how long ago [s], its value and standard deviation, in the unit of the estimate."""

    ago_s: float
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class EstimateView:
    """One estimate."""

    name: str  # What is estimated
    quantity: str  # The value that is shown
    unit: str  # Its unit, '' for none
    value: float  # The value, NaN before the first message
    std: float  # Its standard deviation
    details: str  # Further values as text
    status: Status | None  # Status, None before the first message
    status_s: float  # Time for which it has this status [s]
    is_longer: bool  # True if it had the status before it was first seen, for an unknown time
    idle: str  # Lifecycle state of its node if that is known and not active, else ''
    silent_s: float  # Time since the last message [s], infinite before the first
    is_silent: bool  # True if messages should have come since then
    is_published: bool  # True if a node publishes the topic
    used: int  # Samples used
    rejected: int  # Samples not used
    # Why, with their numbers, the most frequent first; empty before the first diagnostics
    reasons: tuple[tuple[str, int], ...]
    history: tuple[Point, ...]  # Past values, the oldest first


@dataclass(frozen=True, slots=True)
class TrainView:
    """One train."""

    namespace: str  # Namespace of its topics, '/' for the root
    time: str  # Time of day
    speed_kmh: float  # Speed [km/h], NaN if unknown
    inputs: tuple[InputView, ...]  # Its inputs
    estimates: tuple[EstimateView, ...]  # Its estimates
    findings: tuple[Finding, ...]  # What is wrong or in progress, the worst first
    has_diagnostics: bool  # True if any of its nodes has reported


def number(value: float, digits: int = 3) -> str:
    """Return a number with a fixed count of decimals, an absurd one with a power of ten; a dash if it is not finite."""
    if not math.isfinite(value):
        return '–'
    return f'{value:.{digits}f}' if abs(value) < 1e9 else f'{value:.{digits}e}'


def with_band(estimate: EstimateView) -> str:
    """Return value, standard deviation and unit of an estimate."""
    return f'{number(estimate.value)} ± {number(estimate.std)} {estimate.unit}'.rstrip()


def state_of(estimate: EstimateView) -> str:
    """Return what a person should know first of an estimate: its status, or that it does not come."""
    if estimate.status is None:
        return estimate.idle.upper() or ('nothing yet' if estimate.is_published else 'no node')
    if estimate.is_silent:
        return f'{estimate.idle.upper() or "SILENT"} {duration(estimate.silent_s, 1)}'
    return f'{estimate.status.name} {"≥ " if estimate.is_longer else ""}{duration(estimate.status_s)}'


def duration(seconds: float, digits: int = 0) -> str:
    """Return a time span [s] in a few characters, with decimals below a minute if wanted."""
    if seconds < 60.0:
        return f'{seconds:.{digits}f} s' if digits else f'{int(seconds)} s'
    minutes, rest = divmod(int(seconds), 60)
    return f'{minutes}:{rest:02d} min' if minutes < 60 else f'{minutes // 60}:{minutes % 60:02d} h'


def rejections(estimate: EstimateView) -> str:
    """Return how many samples were not used, and why."""
    reasons = ', '.join(f'{name.lower().replace("_", " ")} {count}' for name, count in estimate.reasons)
    return f'used {estimate.used}, rejected {estimate.rejected}{f": {reasons}" if reasons else ""}'


class ShownEstimate(NamedTuple):
    """How one estimate is shown."""

    topic: OutputTopic  # Its topic
    name: str  # What is estimated
    unit: str  # Unit of the value shown, '' for none
    quantity: Callable[[Any], str]  # Names the value shown, given the newest message
    # Value and standard deviation of a message, given the newest message
    value: Callable[[Any, Any], tuple[float, float]]
    details: Callable[[Any], str]  # Further values of a message as text


def reference_speed(message: Any) -> float:
    """Return the speed at which a resistance is shown [m/s]: the middle of those learned from, in steps of 5 km/h.

    The present speed changes all the time, and w with it: a change of the estimate would not be seen.
    """
    # Messages may hold any number.
    if not 0.0 <= message.speed_min <= message.speed_max < 1000.0 or message.speed_max == 0.0:
        return 50.0 / KM_H
    middle = 0.5 * KM_H * float(message.speed_min + message.speed_max)
    return max(round(middle / 5.0), 1) * 5.0 / KM_H


def resistance_at(message: Any, speed: float) -> tuple[float, float]:
    """Return w and its standard deviation [N/kN] at a speed [m/s]."""
    w = message.a + message.b * speed + message.c * speed * speed
    is_known = all(abs(item) < 1e280 for item in message.covariance)
    return float(w), resistance_std(message.covariance, speed) if is_known else math.nan


def _resistance_details(message: Any) -> str:
    a, b, c = deviations(message.covariance)
    text = f'a {message.a:.2f} ± {a:.2f}  b {message.b:.4f} ± {b:.4f}  c {message.c:.5f} ± {c:.5f}'
    if not message.speed_max > 0.0:
        return f'{text}  nothing learned yet'
    return f'{text}  seen {KM_H * message.speed_min:.0f} to {KM_H * message.speed_max:.0f} km/h'


def mass_factor(message: Any) -> tuple[float, float]:
    """Return the mass factor and its standard deviation [1]; it is inversely proportional to b1."""
    variance = float(message.covariance[10])  # of b1, in that of (a1, a2, b1, d0)
    spread = math.sqrt(max(variance, 0.0)) / message.b1 if message.b1 > 0.0 else math.nan
    return float(message.mass_factor), float(message.mass_factor) * spread


def _model_details(message: Any) -> str:
    stated = math.sqrt(max(message.prediction_variance, 0.0))
    known = f' (stated ± {stated:.3f})' if stated > 0.0 else ''
    return f'prediction error {message.prediction_error:+.3f} m/s{known}  a1 {message.a1:.3g}  a2 {message.a2:.5f}'


def _brake_details(message: Any) -> str:
    is_current = message.status not in (Status.STALE, Status.FAULT)
    seen = 'braking now' if message.observable and is_current else 'seen only while braking'
    return f'{seen}  brake acts with {-message.control_acceleration:.2f} m/s²'


SHOWN: Final = (
    ShownEstimate(
        RESISTANCE_TOPIC,
        'resistance',
        'N/kN',
        lambda newest: f'w at {KM_H * reference_speed(newest):.0f} km/h',
        lambda message, newest: resistance_at(message, reference_speed(newest)),
        _resistance_details,
    ),
    ShownEstimate(
        SPEED_MODEL_TOPIC, 'speed model', '', lambda _: 'mass factor', lambda m, _: mass_factor(m), _model_details
    ),
    ShownEstimate(
        BRAKE_RATE_TOPIC,
        'brake rate',
        '',
        lambda _: '1 = nominal',
        lambda message, _: (float(message.brake_rate), float(message.brake_rate_std)),
        _brake_details,
    ),
)

VIEWED: Final = (
    *SHOWN,
    ShownEstimate(
        ADHESION_TOPIC,
        'adhesion',
        '',
        lambda _: 'force over weight',
        lambda message, _: (float(message.adhesion), float(message.adhesion_std)),
        lambda message: f'used {message.used:.3f}, at least {message.at_least:.3f}, slip {message.slip:+.0%}',
    ),
)
"""What a recording shows: the monitor has the adhesion only as a warning while the axle slips."""


def value_text(values: Sequence[tuple[float, str, int]]) -> str:
    """Return the values of an input, each given with its unit and decimals; those that are not known are left out."""
    return '  '.join(f'{value:.{digits}f} {unit}' for value, unit, digits in values if math.isfinite(value))


class Arrivals:
    """Arrivals on one topic, by a clock that never jumps [s], and what came last, None before the first."""

    def __init__(self) -> None:
        self.newest: Any = None
        self._times: deque[float] = deque(maxlen=512)

    def add(self, now_s: float, newest: Any = None) -> None:
        """Record a message."""
        self.newest = newest
        self._times.append(now_s)

    def rate(self, now_s: float) -> float:
        """Return the messages in a second over the last five seconds [Hz], NaN while unknown."""
        if len(self._times) < 2:  # one message has no rate
            return math.nan
        begin_s = max(now_s - 5.0, self._times[0])
        recent = sum(time > begin_s for time in self._times)
        return recent / (now_s - begin_s) if now_s > begin_s else math.nan

    def silent_s(self, now_s: float) -> float:
        """Return the time since the last message [s], infinite before the first."""
        return now_s - self._times[-1] if self._times else math.inf

    def is_late(self, now_s: float) -> bool:
        """Return whether messages came, and another one should have come by now."""
        steps = [after - before for before, after in pairwise(list(self._times)[-8:])]
        # An active node publishes at least once a second; slower messages may be late by as much of their interval.
        latest_s = max(1.4, 2.5 * median(steps)) if steps else 1.4
        return bool(self._times) and self.silent_s(now_s) > latest_s


ESTIMATOR: Final = 'estimator'
INPUT: Final = 'input '
# A node reports once a second; older reports of it no longer hold [s].
_REPORT_S: Final = 3.5


@dataclass(frozen=True, slots=True)
class Report:
    """One status of ``/diagnostics``: level, message and values, and when it arrived [s]."""

    level: Level
    message: str
    values: Mapping[str, str]
    time_s: float

    def number(self, key: str) -> float:
        """Return a value as a number, NaN if it is none."""
        try:
            return float(self.values.get(key, ''))
        except ValueError:
            return math.nan

    def rejections(self) -> Counter[str]:
        """Return the rejected samples by reason."""
        counts = ((key.partition('rejected.')[2], n) for key, n in self.values.items() if key.startswith('rejected.'))
        # Any program may send longer numbers.
        return Counter({reason: int(n) for reason, n in counts if n.isdecimal() and len(n) <= 15})

    def status_s(self, status: Status, now_s: float) -> float:
        """Return for how long the estimate has had this status [s], NaN if the report does not say."""
        since_s = self.number('time in status [s]')
        is_known = self.values.get('status') == status.name and 0.0 <= since_s < math.inf
        return since_s + now_s - self.time_s if is_known else math.nan


class Reports:
    """The newest report of each node of a train on each subject: 'estimator' or one of its inputs."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], Report] = {}
        self._grew_s: dict[tuple[str, str], float] = {}

    def __bool__(self) -> bool:
        return bool(self._newest)

    def add(self, node: str, subject: str, report: Report) -> None:
        """Take in a report; what the node no longer reports beside it is forgotten."""
        last = self._newest.get((node, subject))
        if last is None or last.values.get('count') != report.values.get('count'):
            self._grew_s[node, subject] = report.time_s
        self._newest = {
            key: old for key, old in self._newest.items() if key[0] != node or report.time_s - old.time_s < _REPORT_S
        }
        self._newest[node, subject] = report

    def is_known(self, node: str) -> bool:
        """Return whether a node has reported."""
        return (node, ESTIMATOR) in self._newest

    def estimator(self, node: str, now_s: float) -> Report | None:
        """Return the report of a node on its estimator, None if there is none that still holds."""
        report = self._newest.get((node, ESTIMATOR))
        return report if report is not None and now_s - report.time_s < _REPORT_S else None

    def inputs(self, now_s: float, namespace: str) -> dict[str, InputView]:
        """Return the inputs by name, as the node that heard each last reports it; remapped: not in the namespace."""
        seen: dict[str, InputView] = {}
        for (node, subject), report in sorted(self._newest.items()):
            if not subject.startswith(INPUT):
                continue
            name, topic = subject.removeprefix(INPUT), report.values.get('topic', '')
            is_usual = topic in ('', f'{namespace.rstrip("/")}/{name}') or all(name != own.name for own in INPUT_TOPICS)
            item = _input(
                name if is_usual else f'{topic} ({name})',
                report,
                now_s - self._grew_s[node, subject],
                optional=name == MASS_TOPIC.name,
            )
            if name not in seen or item.silent_s < seen[name].silent_s:
                seen[name] = item
        return seen

    def findings(self, now_s: float) -> Iterable[Finding]:
        """Yield what is reported as not in order, each input once, as the node that takes it worst says it."""
        worst: dict[str, Finding] = {}
        for (node, subject), report in sorted(self._newest.items()):
            if now_s - report.time_s >= _REPORT_S or report.level is Level.OK:
                continue
            source = subject.removeprefix(INPUT) if subject.startswith(INPUT) else node.rpartition('/')[2]
            if source not in worst or report.level.severity > worst[source].level.severity:
                worst[source] = Finding(report.level, source, report.message)
        yield from worst.values()


def _input(name: str, report: Report, unchanged_s: float, *, optional: bool) -> InputView:
    """Return an input that a node reports, whose count of messages has been the same for some time [s]."""
    silent_s, heard = report.number('time since last message [s]'), report.values.get('heard', '')
    grows = unchanged_s < 1.5  # [s]; if not, it is silent, whatever the clock of its node says
    rate = report.number('rate [Hz]') if grows else math.nan
    silent_s = math.inf if math.isnan(silent_s) else silent_s if grows else max(silent_s, unchanged_s)
    return InputView(name, '', rate, _known_age_s(report.number('age [s]')), silent_s, (heard,), optional)


def _known_age_s(age_s: float) -> float:
    # Stamps that differ more from this clock are of another one, as those of a bag.
    return age_s if abs(age_s) < 3600.0 else math.nan


class _Estimate(Arrivals):
    """Estimates that arrived, the last one at a time of the clock of the stamps."""

    def __init__(self, shown: ShownEstimate) -> None:
        super().__init__()
        self.shown, self.arrived_ns = shown, 0
        self.status_since_s, self.is_longer = 0.0, True
        self.history: deque[tuple[float, Any]] = deque(maxlen=400)  # more than any chart shows

    def take(self, message: Any, now_s: float, clock_ns: int) -> None:
        is_first = self.newest is None or self.is_late(now_s)
        if is_first or message.status != self.newest.status:
            self.status_since_s, self.is_longer = now_s, is_first
        self.add(now_s, message)
        self.arrived_ns = clock_ns
        if not self.history or now_s - self.history[-1][0] >= 0.5:  # [s]
            self.history.append((now_s, message))


class Train:
    """What is known of the train of one namespace, '/' for the root."""

    def __init__(self, namespace: str) -> None:
        self.namespace = namespace
        self._inputs = {topic.name: Arrivals() for topic in INPUT_TOPICS}
        self._estimates = {item.topic.name: _Estimate(item) for item in SHOWN}
        self.reports = Reports()
        self._publishers: Mapping[str, tuple[str, ...]] = {}
        self._owners: dict[str, tuple[str, ...]] = {}

    def on_input(self, topic: InputTopic, record: Record, now_s: float) -> None:
        """Take in an input that arrived now [s]."""
        self._inputs[topic.name].add(now_s, record)

    def on_estimate(self, topic: OutputTopic, message: Any, now_s: float, clock_ns: int) -> None:
        """Take in an estimate that arrived now, by both clocks; the message is any object with its fields."""
        if (item := self._estimates.get(topic.name)) is not None:
            item.take(message, now_s, clock_ns)

    def on_publishers(self, publishers: Mapping[str, tuple[str, ...]]) -> None:
        """Take in the nodes that publish each topic, by its name without the namespace."""
        self._publishers = publishers
        self._owners |= {topic: nodes for topic, nodes in publishers.items() if nodes}  # those that ended too

    def silent_s(self, now_s: float) -> float:
        """Return the time since the last message on any topic [s], infinite before the first."""
        return min(item.silent_s(now_s) for item in (*self._inputs.values(), *self._estimates.values()))

    def view(self, now_s: float, clock_ns: int) -> TrainView:
        """Return what to show at a time of the steady clock [s] and of that of the stamps [ns]."""
        estimates = tuple(self._estimate(item, now_s) for item in self._estimates.values())
        findings = (*self._silent(estimates), *self.reports.findings(now_s))
        return TrainView(
            namespace=self.namespace,
            time=f'{_clock(clock_ns)} UTC',
            speed_kmh=KM_H * self._speed(now_s),
            inputs=tuple(self._all_inputs(now_s, clock_ns)),
            estimates=estimates,
            findings=tuple(_merged(sorted(findings, key=_rank))),
            has_diagnostics=bool(self.reports),
        )

    def _speed(self, now_s: float) -> float:
        """Return the present speed [m/s], as an estimator states it where it is measured on another topic."""
        measured = self._inputs[SPEED_TOPIC.name]
        if isinstance(measured.newest, SpeedRecord):
            return math.nan if measured.is_late(now_s) else measured.newest.speed
        current = (Status.CONVERGING, Status.VALID, Status.HOLDING)
        for item in self._estimates.values():
            stated = getattr(item.newest, 'speed', None)
            if stated is not None and not item.is_late(now_s) and status_of(item.newest) in current:
                return float(stated)
        return math.nan

    def _all_inputs(self, now_s: float, clock_ns: int) -> Iterable[InputView]:
        """Yield the inputs of the interface, and remapped ones and those of a mapping as the nodes report them."""
        reported = self.reports.inputs(now_s, self.namespace)
        foreign = [item for name, item in reported.items() if name not in self._inputs]
        for name, item in self._inputs.items():
            if name in reported and reported[name].name != name:
                yield reported[name]
            elif not foreign or name in reported:
                yield self._input(name, item, now_s, clock_ns)
        yield from foreign

    def _input(self, name: str, item: Arrivals, now_s: float, clock_ns: int) -> InputView:
        value, age_s = '', math.nan
        if item.newest is not None:
            value, age_s = _value(item.newest), _known_age_s((clock_ns - item.newest.stamp_ns) / NS_PER_S)
        publishers, optional = self._publishers.get(name, ()), name == MASS_TOPIC.name
        return InputView(name, value, item.rate(now_s), age_s, item.silent_s(now_s), publishers, optional)

    def _estimate(self, item: _Estimate, now_s: float) -> EstimateView:
        shown, newest = item.shown, item.newest
        value, std = (math.nan, math.nan) if newest is None else shown.value(newest, newest)
        status = None if newest is None else status_of(newest)
        report = self.reports.estimator(self._node(shown.topic), now_s)
        status_s, is_longer = _status_s(item, report, now_s)
        state = '' if report is None else report.values.get('state', '')
        reasons = [] if report is None else report.rejections().most_common()
        return EstimateView(
            name=shown.name,
            quantity='' if newest is None else shown.quantity(newest),
            unit=shown.unit,
            value=value,
            std=std,
            details='' if newest is None else shown.details(newest),
            status=status,
            status_s=status_s,
            is_longer=is_longer,
            idle='' if state == 'active' else state,
            silent_s=item.silent_s(now_s),
            is_silent=item.is_late(now_s),
            is_published=bool(self._publishers.get(shown.topic.name)),
            used=0 if newest is None else int(newest.used),
            # Reasons come more seldom than estimates: shown with them is their sum.
            rejected=sum(count for _, count in reasons) or (0 if newest is None else int(newest.rejected)),
            reasons=tuple(reasons),
            history=tuple(Point(now_s - time_s, *shown.value(past, newest)) for time_s, past in item.history),
        )

    def _node(self, topic: OutputTopic) -> str:
        """Return the node of an estimate, as it names itself in diagnostics."""
        names = [name.strip('/') for name in self._owners.get(topic.name, ())]
        (node,) = (kind.node_name for kind in KINDS if kind.topic is topic)
        usual = f'{self.namespace}/{node}'.strip('/')
        return next((name for name in (*names, usual) if self.reports.is_known(name)), (*names, usual)[0])

    def _silent(self, estimates: Iterable[EstimateView]) -> Iterable[Finding]:
        """Yield the estimates that stopped coming; a node that is not active says so itself."""
        for view, item in zip(estimates, self._estimates.values(), strict=True):
            if view.is_silent and not view.idle:
                since = _clock(item.arrived_ns)
                text = f'no estimate since {since} UTC: the node has ended or hangs, start it again'
                yield Finding(Level.ERROR, self._node(item.shown.topic).rpartition('/')[2], text)


class Trains:
    """The trains of a ROS graph by namespace."""

    def __init__(self) -> None:
        self.by_namespace: dict[str, Train] = {}

    def add(self, namespace: str) -> Train:
        """Return the train of a namespace, '/' for the root; a new one if it is not known yet."""
        return self.by_namespace.setdefault(namespace, Train(namespace))

    def on_diagnostics(self, name: str, report: Report) -> None:
        """Take in one status; those of other software, and of trains that are not shown, are left out."""
        node, separator, subject = name.partition(': ')
        train = self.by_namespace.get(f'/{node.rpartition("/")[0]}')
        if separator and train is not None and (subject == ESTIMATOR or subject.startswith(INPUT)):
            train.reports.add(node, subject, report)

    def has_messages(self, now_s: float) -> bool:
        """Return whether any message has arrived by now [s]."""
        return any(math.isfinite(train.silent_s(now_s)) for train in self.by_namespace.values())

    def drop_ended(self, published: Collection[str], now_s: float) -> list[str]:
        """Forget the trains that ended some time ago, given those with publishers; return them.

        If no other train is left, they stay: what has ended is the news.
        """
        trains = self.by_namespace.items()
        # A minute of silence is longer than a node takes to start again.
        ended = [name for name, train in trains if train.silent_s(now_s) > 60.0 and name not in published]
        if len(ended) == len(trains):
            return []
        for name in ended:
            del self.by_namespace[name]
        return ended

    def views(self, now_s: float, clock_ns: int) -> tuple[TrainView, ...]:
        """Return what to show of all trains, by namespace."""
        return tuple(train.view(now_s, clock_ns) for _, train in sorted(self.by_namespace.items()))


def _status_s(item: _Estimate, report: Report | None, now_s: float) -> tuple[float, bool]:
    """Return for how long an estimate has had its status [s], and whether for an unknown time before that.

    A change that was seen here comes first: the clock of the node, by which it reports, may stand still.
    """
    if item.is_longer and report is not None and item.newest is not None:
        reported_s = report.status_s(status_of(item.newest), now_s)
        if not math.isnan(reported_s):
            return reported_s, False
    return now_s - item.status_since_s, item.is_longer


def _merged(findings: Iterable[Finding]) -> Iterable[Finding]:
    """Yield findings that say the same as one, with all their sources."""
    alike: dict[tuple[Level, str], list[str]] = {}
    for item in findings:
        alike.setdefault((item.level, item.text), []).append(item.source)
    for (level, text), sources in alike.items():
        yield Finding(level, ', '.join(sources), text)


def _rank(finding: Finding) -> tuple[int, bool, str]:
    """Sort the worst first, and of equal ones the inputs, which are the cause, before the estimators."""
    return -finding.level.severity, finding.source.endswith('_estimator'), finding.source


def _value(record: Record) -> str:
    match record:
        case SpeedRecord():
            return value_text(((KM_H * record.speed, 'km/h', 1), (record.position, 'm', 0)))
        case ForceRecord():
            return value_text(((record.force / 1000.0, 'kN', 1),))
        case GradientRecord():
            return value_text(((record.gradient, '‰', 1),)) + (' tunnel' if record.tunnel else '')
        case BrakeRecord():
            return value_text(((record.target_acceleration, 'm/s²', 2),)) + (' emergency' if record.emergency else '')
        case MassRecord():
            return value_text(((record.mass / 1000.0, 't', 1),))


def _clock(time_ns: int) -> str:
    return f'{datetime.fromtimestamp(time_ns // NS_PER_S, UTC):%H:%M:%S}'
