# SPDX-License-Identifier: Apache-2.0
"""What arrives on the inputs of a node, what is wrong with it, since when, and what to do; the state of the work."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from statistics import median
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.linalg import LinAlgError

from trainid_ros.interface.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    MASS_TOPIC,
    NS_PER_S,
    SPEED_TOPIC,
)
from trainid_ros.interface.results import Reason
from trainid_ros.ros.inputs import label_of, required_inputs, subscribed_topics
from trainid_ros.ros.topics import Publishers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Rejection
    from trainid_ros.ros.inputs import AnyTopic, InputGroup, NodeMapping
    from trainid_ros.ros.node import ManagedNode, NodeParameters
    from trainid_ros.setup.pipelines import EstimatorKind
    from trainid_ros.stream.alignment import AlignmentConfig

NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, LinAlgError)
"""What arithmetic on an invalid state raises; in old versions of numpy LinAlgError is not a ValueError."""
# Rates and rejections are counted over this time [ns].
_WINDOW_NS: Final = 5 * NS_PER_S
# Difference of stamps from the clock of the node above which another clock set them, or messages were buffered [s].
_MAX_AGE_S: Final = 2.0
# Messages kept of each input: 5 s at 800 Hz.
_MAX_KEPT: Final = 4096
# Inputs that are silent for longer are missing, and not compared [s].
_MAX_SILENCE_S: Final = 2.5
_REJECTED: Final = {
    Reason.NOT_FINITE: 'correct the sensor or its publisher',
    Reason.OUT_OF_RANGE: 'correct its unit or sign',
    Reason.ZERO_STAMP: 'let its publisher set the stamp',
    Reason.LATE: 'send it sooner, or raise alignment.max_lag',
    Reason.DUPLICATE: 'let its publisher send each message once, with a stamp of its own',
    Reason.STAMP_JUMP: 'synchronise its clock with those of the other inputs',
}


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong, in words."""

    level: Any  # Level of the diagnostics
    text: str  # What is the case
    action: str = ''  # What to do, '' if nothing
    since_ns: int = 0  # Since when, by the node's clock [ns]; 0 if not known

    def sentence(self, now_ns: int) -> str:
        """Return everything in one line, at a time of the node's clock [ns]."""
        since = f', since {clock_time(self.since_ns)}' if 0 < self.since_ns <= now_ns else ''
        return f'{self.text}{since}' + (f': {self.action}' if self.action else '')


def clock_time(time_ns: int) -> str:
    """Return a time [ns] as date and time of day."""
    return f'{datetime.fromtimestamp(time_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC'


class InputMonitor:
    """Arrivals on one input topic, timed with the node's clock.

    Attributes:
        topic: The topic.
        label: Its name, with what is read from it if it is not our own.
        longest_s: Longest time between messages that the estimators can bridge at any rate [s].
        slowest_s: Longest acceptable interval between messages [s].
        optional: True if the estimators can run without it.
        count: Messages received.
        newest_ns: Stamp of the last message [ns], 0 before the first.
        publishers: Who publishes on it.
    """

    def __init__(self, topic: AnyTopic, longest_s: float, slowest_s: float, *, optional: bool) -> None:
        self.topic = topic
        self.label = label_of(topic)
        self.longest_s = longest_s
        self.slowest_s = max(longest_s, slowest_s)
        self.optional = optional
        self.count = self.newest_ns = self._last_ns = 0
        self.publishers = Publishers()
        self._arrivals: deque[int] = deque(maxlen=_MAX_KEPT)
        self._delays: deque[int] = deque(maxlen=_MAX_KEPT)
        self._rejected: deque[tuple[int, Rejection]] = deque(maxlen=_MAX_KEPT)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """Record a message with this stamp [ns] that arrived now [ns]."""
        self.count += 1
        self.newest_ns = stamp_ns
        if self._arrivals and now_ns < self._arrivals[-1]:
            for past in (self._arrivals, self._delays, self._rejected):
                past.clear()
        self._arrivals.append(now_ns)
        self._delays.append(now_ns - stamp_ns)
        self._last_ns = now_ns

    def rejected(self, rejection: Rejection, now_ns: int) -> None:
        """Record that one of the last messages was not used [ns]."""
        self._rejected.append((now_ns, rejection))

    def rate(self, now_ns: int) -> float:
        """Return the message rate over the last seconds [Hz]; NaN while unknown, as with a clock that stands still."""
        self._forget_before(now_ns - _WINDOW_NS)
        if not self._arrivals or self._arrivals[-1] == self._arrivals[0]:
            return math.nan
        return (len(self._arrivals) - 1) * NS_PER_S / (self._arrivals[-1] - self._arrivals[0])

    def _forget_before(self, begin_ns: int) -> None:
        while self._arrivals and self._arrivals[0] < begin_ns:
            self._arrivals.popleft()
            self._delays.popleft()
        while self._rejected and self._rejected[0][0] < begin_ns:
            self._rejected.popleft()

    @property
    def delay_s(self) -> float:
        """Smallest time from the stamp to the arrival of the last messages [s]."""
        recent = bisect_left(self._arrivals, self._last_ns - NS_PER_S)  # within a second: one may be held up
        return min(islice(self._delays, recent, None), default=0) / NS_PER_S

    def judge_rejections(self, now_ns: int) -> Finding | None:
        """Return why the messages of the last seconds were not used; None if only a few were rejected."""
        self._forget_before(now_ns - _WINDOW_NS)
        count = len(self._rejected)
        if count <= 2 + 0.1 * len(self._arrivals):  # as after a jump of the stamps, and one in ten
            return None
        last = self._rejected[-1][1]
        text = f'{min(count, len(self._arrivals))} of the last {len(self._arrivals)} messages not used: {_shown(last)}'
        return Finding(DiagnosticStatus.ERROR, text, _REJECTED[last.reason])

    def missing_for_s(self, now_ns: int) -> float:
        """Return the time since the last message [s], infinite before the first."""
        if not self.count:
            return math.inf
        return max(now_ns - self._last_ns, 0) / NS_PER_S

    def age_s(self, now_ns: int) -> float:
        """Return the age of the newest stamp [s], NaN before the first message."""
        return (now_ns - self.newest_ns) / NS_PER_S if self.count else math.nan

    def is_missing(self, now_ns: int, stale_s: float) -> bool:
        """Return whether a required input is missing; ``stale_s`` is its timeout [s]."""
        return not self.optional and self.missing_for_s(now_ns) > stale_s

    def judge(self, now_ns: int, stale_s: float, skew_s: float = 0.0) -> Finding:
        """Return the most important thing to know about the input, whose timeout is ``stale_s``.

        Its stamps are ``skew_s`` behind those of the other inputs [s], 0 if that is too small to report.
        """
        publishers, is_missing = self.publishers, self.is_missing(now_ns, max(stale_s, self.longest_s))
        # A publisher that was killed still counts as heard for a while.
        if publishers.unheard and (is_missing or not (publishers.heard and self.count)):
            return Finding(DiagnosticStatus.ERROR, '; '.join(publishers.unheard), publishers.remedy)
        if self.optional and not self.count:
            used = '; the parameter is used' if self.topic is MASS_TOPIC else ''
            return Finding(DiagnosticStatus.OK, f'optional, not received{used}')
        if is_missing:
            return self._missing(now_ns)
        if len(publishers.heard) > 1:
            text = f'{len(publishers.heard)} publishers, whose messages mix: {_names(publishers.heard)}'
            return Finding(DiagnosticStatus.WARN, text, 'stop all but one')
        if publishers.unheard:
            return Finding(DiagnosticStatus.WARN, '; '.join(publishers.unheard), 'correct or stop this publisher')
        return self._judge_messages(now_ns, skew_s)

    def _judge_messages(self, now_ns: int, skew_s: float) -> Finding:
        rejections = self.judge_rejections(now_ns)
        if skew_s:
            text = f'{_apart(skew_s)} those of the other inputs{f", {rejections.text}" if rejections else ""}'
            action = 'synchronise the clocks of the inputs, or send the late one sooner'
            if abs(skew_s) >= 3600.0:  # no message is as late
                action = (
                    'set the clock of its computer, or give its publisher the same use_sim_time as those of the others'
                )
            return Finding(DiagnosticStatus.WARN, text, action)
        if rejections is not None:
            return rejections
        rate, delay_s = self.rate(now_ns), self._delays[-1] / NS_PER_S if self._delays else 0.0
        if abs(delay_s) > _MAX_AGE_S and not self.optional:
            text = f"{_apart(delay_s)} this node's clock"
            action = 'for a bag set use_sim_time and play it with /clock; on a train synchronise the clocks'
            return Finding(DiagnosticStatus.WARN, text, action)
        if rate * self.slowest_s < 1.0 and not self.optional:
            text = f'too slow: {rate:.2f} Hz, at least {1.0 / self.slowest_s:.2f} Hz needed'
            return Finding(DiagnosticStatus.WARN, text, 'let its publisher send more often')
        return Finding(DiagnosticStatus.OK, 'received' if math.isnan(rate) else f'{rate:.1f} Hz')

    def _missing(self, now_ns: int) -> Finding:
        heard = self.publishers.heard
        since = f'no message for {self.missing_for_s(now_ns):.1f} s' if self.count else 'never received'
        if heard:
            action = f'check sensor and network of {_names(heard)}, or whether it is active'
            text = f'{since}, {len(heard)} publisher(s), but no messages arrive'
        else:
            action = 'start the node that publishes it' + ('' if self.count else ', or remap the topic to its name')
            text = f'{since}, no publisher'
        return Finding(DiagnosticStatus.STALE, text, action, self._last_ns)


class InputMonitors:
    """The monitors of all inputs of a node, by topic; the alignment says how long each input may be missing."""

    def __init__(self, alignment: AlignmentConfig, topics: Iterable[AnyTopic] = subscribed_topics()) -> None:
        longest = {
            SPEED_TOPIC: alignment.max_dt,
            FORCE_TOPIC: alignment.max_gap,
            GRADIENT_TOPIC: alignment.max_gap,
            BRAKE_TOPIC: alignment.command_hold or alignment.command_timeout,
        }
        slowest_s = alignment.max_interval
        self._max_skew_s = alignment.max_lag + 0.1  # by jitter
        self.by_topic = {
            topic: InputMonitor(topic, min(required, default=0.0), slowest_s, optional=not required)
            for topic in topics
            for required in [[longest[item] for item in required_inputs(topic)]]
        }

    def arrived(self, topic: AnyTopic, stamp_ns: int, now_ns: int, rejected: Iterable[Rejection]) -> None:
        """Record a message and the messages that were rejected with it.

        Rejections come later than their messages: a stamp that does not fit waits for the next ones.
        """
        for rejection in rejected:
            if rejection.reason not in _REJECTED:  # nothing is wrong with a topic faster than the period
                continue
            owners = [item for item in self.by_topic.values() if item.newest_ns == rejection.stamp_ns != stamp_ns]
            (owners[0] if owners else self.by_topic[topic]).rejected(rejection, now_ns)
        self.by_topic[topic].arrived(stamp_ns, now_ns)

    def skew_s(self, topic: AnyTopic, now_ns: int) -> float:
        """Return how far the stamps of an input are behind those of the others as they arrive [s], 0 if not far."""
        arriving = [item for item in self.by_topic.values() if item.missing_for_s(now_ns) < _MAX_SILENCE_S]
        own, others = self.by_topic[topic], [item for item in arriving if item.topic is not topic and not item.optional]
        if own.optional or own not in arriving or not others:
            return 0.0
        usual_s = median(item.delay_s for item in others)
        skew_s = own.delay_s - usual_s
        # Where all are of another clock than this node, as those of a bag played fast, that cannot be known.
        return skew_s if abs(skew_s) > self._max_skew_s and abs(usual_s) < _MAX_AGE_S else 0.0

    def describe_missing(self, now_ns: int, timeout_s: Callable[[AnyTopic], float]) -> str:
        """Return which required inputs are missing or unusable, and since when, '' if none is; timeouts in [s]."""
        found = []
        for topic, item in self.by_topic.items():
            if item.is_missing(now_ns, timeout_s(topic)):
                found.append(f'no {item.label} {f"for {item.missing_for_s(now_ns):.1f} s" if item.count else "yet"}')
            elif not item.optional and (rejections := item.judge_rejections(now_ns)) is not None:
                found.append(f'{item.label}: {rejections.text}')
            elif skew_s := self.skew_s(topic, now_ns):
                found.append(f'{item.label}: {_apart(skew_s)} those of the other inputs')
        return ', '.join(found)


def _apart(delay_s: float) -> str:
    """Describe lagging stamps, or leading ones at a negative delay [s]."""
    return f'stamps are {shown_time(abs(delay_s))} {"behind" if delay_s > 0.0 else "ahead of"}'


def shown_time(time_s: float) -> str:
    """Return a time [s] in the largest unit of which it is at least two."""
    units = ((365.25 * 86400.0, 'years'), (86400.0, 'days'), (3600.0, 'h'), (60.0, 'min'))
    size, unit = next((item for item in units if time_s >= 2.0 * item[0]), (1.0, 's'))
    return f'{time_s / size:.1f} {unit}'


def _shown(last: Rejection) -> str:
    name = last.reason.name
    if last.reason is Reason.NOT_FINITE:
        return f'{name} ({last.value:g})'
    if last.reason is Reason.OUT_OF_RANGE:
        return f'{name} ({last.value:.6g} is {"below" if last.value < last.limit else "above"} {last.limit:.6g})'
    if last.reason is Reason.ZERO_STAMP:
        return f'{name} (the stamp is {"0" if last.stamp_ns == 0 else "negative"})'
    return name if last.reason is Reason.DUPLICATE else f'{name} ({shown_time(abs(last.value))})'


def _names(names: Sequence[str]) -> str:
    return ', '.join(dict.fromkeys(names))


class StepTimes:
    """Computing time of the estimator per sample.

    Attributes:
        longest: The longest step since the start [s].
        overruns: Number of steps since then that delayed the next sample, at 5 Hz.
    """

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=3000)  # ten minutes at 5 Hz
        self.longest = 0.0
        self.overruns = 0

    def add(self, seconds: float) -> None:
        """Record the time of one step [s]."""
        self._recent.append(seconds)
        self.longest = max(self.longest, seconds)
        self.overruns += seconds > 0.2

    def quantiles(self) -> tuple[float, float]:
        """Return the 50 % and the 99 % quantile of the recent steps [s]; zeros before the first."""
        p50, p99 = np.percentile(self._recent, (50.0, 99.0)) if self._recent else (0.0, 0.0)
        return float(p50), float(p99)


@dataclass(slots=True)
class NodeContext:
    """The node, as far as ROS goes, and the state of its work."""

    node: ManagedNode  # Clocks, timers, logger, graph and lifecycle state
    kind: EstimatorKind[Any]  # What it estimates
    parameters: NodeParameters
    mapping: NodeMapping
    monitors: InputMonitors
    # These are None while the node is not configured
    inputs: InputGroup | None = None
    pipeline: EstimatorPipeline[Any] | None = None
    prior: Any = None  # Estimate before the first record
    fault: str = ''  # Why the estimator cannot continue, '' if it can
    step_times: StepTimes = field(default_factory=StepTimes)

    def forget(self) -> None:
        """Forget what configuring the node has made."""
        self.inputs = self.pipeline = self.prior = None
        self.fault, self.step_times = '', StepTimes()

    def timeout_s(self, topic: AnyTopic) -> float:
        """Return how long a topic may be missing [s]; 0 for one that need not come."""
        required = required_inputs(topic)
        if self.pipeline is None or not required:
            return 0.0
        return min(self.pipeline.timeout_ns(INPUT_TOPICS.index(item)) for item in required) / NS_PER_S

    def missing_inputs(self) -> str:
        """Return which inputs do not arrive and for how long, '' if all do."""
        lacking = '' if self.inputs is None else self.inputs.lacking
        found = (self.monitors.describe_missing(self.node.now_ns(), self.timeout_s), lacking)
        return ', '.join(text for text in found if text)
