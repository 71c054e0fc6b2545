# SPDX-License-Identifier: Apache-2.0
"""What is known of each train, from the messages that arrived and the times at which they did.

Two clocks are used: a steady one [s] for arrivals, and that of the stamps [ns] for ages.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.messages import OUTPUT_TOPICS, status_of
from trainid_ros.monitor.arrivals import Arrivals
from trainid_ros.monitor.shown_estimates import KMH, SHOWN, ShownEstimate, value_text
from trainid_ros.monitor.view import EstimateView, Finding, InputView, Level, Point, TrainView
from trainid_ros.records import (
    INPUT_TOPICS,
    MASS_TOPIC,
    NS_PER_S,
    SPEED_TOPIC,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    SpeedRecord,
)
from trainid_ros.ros.jobs import JOBS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from trainid_ros.messages import OutputTopic
    from trainid_ros.records import InputTopic, Record

# Past values are kept at this step and so many of them, which is longer than any chart.
_STEP_S: Final = 0.5
_POINTS: Final = 400
# Stamps that differ more from this clock are of another one, as those of a bag [s].
_OTHER_CLOCK_S: Final = 3600.0
# A node reports once a second; older reports of it no longer hold [s].
_REPORT_S: Final = 3.5
_REJECTED: Final = 'rejected.'
_INPUT: Final = 'input '
_ORDER: Final = (Level.ERROR, Level.STALE, Level.WARN)
_NUMBER: Final = re.compile(r'\d+')
_NODES: Final = {job.topic.name: job.node_name for job in JOBS}
"""Usual name of the node that publishes an estimate, by topic."""


@dataclass(frozen=True, slots=True)
class Report:
    """One status of ``/diagnostics``: level, message and values, and when it arrived [s]."""

    level: Level
    message: str
    values: Mapping[str, str]
    time_s: float


@dataclass(slots=True)
class _Input:
    """What arrived on the topic of an input."""

    topic: InputTopic
    arrivals: Arrivals = field(default_factory=Arrivals)
    record: Record | None = None


@dataclass(slots=True)
class _Estimate:
    """What arrived on the topic of an estimate."""

    shown: ShownEstimate
    arrivals: Arrivals = field(default_factory=Arrivals)
    message: Any = None
    status_since_s: float = 0.0
    history: deque[tuple[float, Any]] = field(default_factory=lambda: deque(maxlen=_POINTS))

    def add(self, message: Any, now_s: float) -> None:
        self.arrivals.add(now_s)
        if self.message is None or message.status != self.message.status:
            self.status_since_s = now_s
        self.message = message
        if not self.history or now_s - self.history[-1][0] >= _STEP_S:
            self.history.append((now_s, message))


class Train:
    """What is known of the train of one namespace."""

    def __init__(self, namespace: str) -> None:
        """Set the namespace, '/' for the root."""
        self.namespace = namespace
        self._inputs = {topic.name: _Input(topic) for topic in INPUT_TOPICS}
        self._estimates = {item.topic.name: _Estimate(item) for item in SHOWN}
        self._reports: dict[tuple[str, str], Report] = {}
        self._publishers: Mapping[str, tuple[str, ...]] = {}

    def on_input(self, topic: InputTopic, record: Record, now_s: float) -> None:
        """Take in an input that arrived now [s]."""
        item = self._inputs[topic.name]
        item.arrivals.add(now_s)
        item.record = record

    def on_estimate(self, topic: OutputTopic, message: Any, now_s: float) -> None:
        """Take in an estimate that arrived now [s]; the message is any object with the fields of its type."""
        self._estimates[topic.name].add(message, now_s)

    def on_report(self, node: str, subject: str, report: Report) -> None:
        """Take in a status that a node of this train gave of itself ('estimator') or of one of its inputs."""
        self._reports[node, subject] = report

    def on_publishers(self, publishers: Mapping[str, tuple[str, ...]]) -> None:
        """Take in the nodes that publish each topic, by its name without the namespace."""
        self._publishers = publishers

    def view(self, now_s: float, clock_ns: int) -> TrainView:
        """Return what to show at a time of the steady clock [s] and of that of the stamps [ns]."""
        speed = self._inputs[SPEED_TOPIC.name].record
        estimates = tuple(self._estimate(item, now_s) for item in self._estimates.values())
        return TrainView(
            namespace=self.namespace,
            time=f'{_clock(clock_ns)} UTC',
            speed_kmh=KMH * speed.speed if isinstance(speed, SpeedRecord) else math.nan,
            inputs=(
                *(self._input(item, now_s, clock_ns) for item in self._inputs.values()),
                *self._foreign_inputs(now_s),
            ),
            estimates=estimates,
            findings=tuple(_merged(sorted((*_silent(estimates, clock_ns), *self._reported(now_s)), key=_rank))),
        )

    def _input(self, item: _Input, now_s: float, clock_ns: int) -> InputView:
        record = item.record
        age_s = math.nan if record is None else (clock_ns - record.stamp_ns) / NS_PER_S
        return InputView(
            name=item.topic.name,
            value='' if record is None else _value(record),
            rate=item.arrivals.rate(now_s),
            age_s=age_s if abs(age_s) < _OTHER_CLOCK_S else math.nan,
            silent_s=item.arrivals.silent_s(now_s),
            publishers=self._publishers.get(item.topic.name, ()),
            optional=item.topic is MASS_TOPIC,
        )

    def _foreign_inputs(self, now_s: float) -> Iterable[InputView]:
        """Yield the inputs that the nodes read from other topics, by a mapping, as the nodes report them."""
        seen = set(self._inputs)
        for (_, subject), report in self._current(now_s):
            name = subject.removeprefix(_INPUT)
            if name == subject or name in seen:
                continue
            seen.add(name)
            numbers = {key: _number(text) for key, text in report.values.items()}
            age_s = numbers.get('age [s]', math.nan)
            yield InputView(
                name=name,
                value='',
                rate=numbers.get('rate [Hz]', math.nan),
                age_s=age_s if abs(age_s) < _OTHER_CLOCK_S else math.nan,
                silent_s=numbers.get('time since last message [s]', math.inf),
                publishers=(report.values.get('heard', ''),),
                optional=False,
            )

    def _estimate(self, item: _Estimate, now_s: float) -> EstimateView:
        shown, newest = item.shown, item.message
        value, std = (math.nan, math.nan) if newest is None else shown.value(newest, newest)
        reasons = self._reasons(shown.topic, now_s)
        return EstimateView(
            name=shown.name,
            quantity='' if newest is None else shown.quantity(newest),
            unit=shown.unit,
            value=value,
            std=std,
            details='' if newest is None else shown.details(newest),
            status=None if newest is None else status_of(newest),
            status_s=now_s - item.status_since_s,
            silent_s=item.arrivals.silent_s(now_s),
            is_silent=item.arrivals.is_late(now_s),
            is_published=bool(self._publishers.get(shown.topic.name)),
            used=0 if newest is None else int(newest.used),
            rejected=0 if newest is None else int(newest.rejected),
            reasons=tuple(reasons.most_common()),
            history=tuple(Point(now_s - time_s, *shown.value(past, newest)) for time_s, past in item.history),
        )

    def _reasons(self, topic: OutputTopic, now_s: float) -> Counter[str]:
        """Return the rejections by reason of the estimator of a topic."""
        for (node, subject), report in self._current(now_s):
            if subject == 'estimator' and node.endswith(_NODES[topic.name]):
                counts = {key: text for key, text in report.values.items() if key.startswith(_REJECTED)}
                return Counter({key.removeprefix(_REJECTED): int(n) for key, n in counts.items() if n.isdecimal()})
        return Counter()

    def _reported(self, now_s: float) -> Iterable[Finding]:
        """Yield what nodes report as not in order, each input once, as the node that takes it worst says it."""
        worst: dict[str, Finding] = {}
        for (node, subject), report in self._current(now_s):
            source = subject.removeprefix(_INPUT) if subject.startswith(_INPUT) else node.rpartition('/')[2]
            finding = Finding(report.level, source, report.message)
            if report.level is not Level.OK and (source not in worst or _rank(finding) < _rank(worst[source])):
                worst[source] = finding
        yield from worst.values()

    def _current(self, now_s: float) -> list[tuple[tuple[str, str], Report]]:
        return sorted(item for item in self._reports.items() if now_s - item[1].time_s < _REPORT_S)


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
        if separator and train is not None and (subject == 'estimator' or subject.startswith(_INPUT)):
            train.on_report(node, subject, report)

    def views(self, now_s: float, clock_ns: int) -> tuple[TrainView, ...]:
        """Return what to show of all trains, by namespace."""
        return tuple(train.view(now_s, clock_ns) for _, train in sorted(self.by_namespace.items()))


def _silent(estimates: Iterable[EstimateView], clock_ns: int) -> Iterable[Finding]:
    """Yield the estimates that stopped coming."""
    for item, topic in zip(estimates, OUTPUT_TOPICS, strict=True):
        if item.is_silent:
            since = _clock(clock_ns - round(item.silent_s * NS_PER_S))
            text = (
                f'no estimate for {item.silent_s:.1f} s, since {since} UTC: the node has ended or hangs, start it again'
            )
            yield Finding(Level.ERROR, _NODES[topic.name], text)


def _merged(findings: Iterable[Finding]) -> Iterable[Finding]:
    """Return findings that differ in their numbers alone as one, with all their sources."""
    alike: dict[tuple[Level, str], list[Finding]] = {}
    for item in findings:
        alike.setdefault((item.level, _NUMBER.sub('', item.text)), []).append(item)
    for same in alike.values():
        yield Finding(same[0].level, ', '.join(item.source for item in same), same[0].text)


def _rank(finding: Finding) -> tuple[int, bool, str]:
    """Sort the worst first, and of equal ones the inputs, which are the cause, before the estimators."""
    return _ORDER.index(finding.level), finding.source.endswith('_estimator'), finding.source


def _value(record: Record) -> str:
    match record:
        case SpeedRecord():
            return value_text(((KMH * record.speed, 'km/h', 1), (record.position, 'm', 0)))
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


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
