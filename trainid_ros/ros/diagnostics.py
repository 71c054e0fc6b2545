# SPDX-License-Identifier: Apache-2.0
"""What arrives on the inputs of a node, what is wrong with inputs and estimate, since when, and what to do.

``/diagnostics`` has one status for the estimator and one for each input; wrong publishers are logged. Ages are measured
with the node's clock, so they are correct under simulated time too.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from statistics import median
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
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
from trainid_ros.interface.results import Reason, Status, deviation_of, quantities
from trainid_ros.ros.inputs import label_of, required_inputs, subscribed_topics
from trainid_ros.ros.topics import NO_PUBLISHER_EVENTS, Publishers, estimate_qos, is_hash, sort_publishers, time_message
from trainid_ros.setup.pipelines import brake_findings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Output, Rejection
    from trainid_ros.ros.inputs import AnyTopic, InputGroup, NodeMapping
    from trainid_ros.ros.node import ManagedNode, NodeParameters
    from trainid_ros.setup.pipelines import EstimatorKind
    from trainid_ros.stream.alignment import AlignmentConfig
    from trainid_ros.stream.input_faults import InputFaults

NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, LinAlgError)
"""What arithmetic on an invalid state raises; in old versions of numpy LinAlgError is not a ValueError."""
# Rates and rejections are counted over this time [ns].
_WINDOW_NS: Final = 5 * NS_PER_S
# Difference of stamps from the clock of the node above which another clock set them, or messages were buffered [s].
_MAX_AGE_S: Final = 2.0
# Inputs that are silent for longer are missing, and not compared [s].
_MAX_SILENCE_S: Final = 2.5
_MESSAGE_REJECTED: Final = {
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


def _kept() -> deque[Any]:
    return deque(maxlen=4096)  # messages of an input: 5 s at 800 Hz


@dataclass(eq=False)
class InputMonitor:
    """Arrivals on one input topic, timed with the node's clock."""

    topic: AnyTopic
    longest_s: float  # Longest time between messages that the estimators can bridge at any rate [s]
    slowest_s: float  # Longest acceptable interval between messages [s]
    optional: bool  # True if the estimators can run without it
    count: int = 0  # Messages received
    newest_ns: int = 0  # Stamp of the last message [ns], 0 before the first
    publishers: Publishers = field(default_factory=Publishers)  # Who publishes on it
    _last_ns: int = 0
    _arrivals: deque[tuple[int, int]] = field(default_factory=_kept)  # When messages came, and their delays [ns]
    _rejected: deque[tuple[int, Rejection]] = field(default_factory=_kept)

    def arrived(self, stamp_ns: int, now_ns: int) -> None:
        """Record a message with this stamp [ns] that arrived now [ns]."""
        self.count += 1
        self.newest_ns = stamp_ns
        if self._arrivals and now_ns < self._arrivals[-1][0]:
            self._arrivals.clear()
            self._rejected.clear()
        self._arrivals.append((now_ns, now_ns - stamp_ns))
        self._last_ns = now_ns

    def rejected(self, rejection: Rejection, now_ns: int) -> None:
        """Record that one of the last messages was not used [ns]."""
        self._rejected.append((now_ns, rejection))

    def rate(self, now_ns: int) -> float:
        """Return the message rate over the last seconds [Hz]; NaN while unknown, as with a clock that stands still."""
        self._forget_before(now_ns - _WINDOW_NS)
        times = [time_ns for time_ns, _ in self._arrivals]
        if not times or times[-1] == times[0]:
            return math.nan
        return (len(times) - 1) * NS_PER_S / (times[-1] - times[0])

    def _forget_before(self, begin_ns: int) -> None:
        for past in (self._arrivals, self._rejected):
            while past and past[0][0] < begin_ns:
                past.popleft()

    @property
    def delay_s(self) -> float:
        """Smallest time from the stamp to the arrival of the last messages [s]."""
        # Within a second: one may be held up.
        recent = (delay_ns for time_ns, delay_ns in self._arrivals if time_ns >= self._last_ns - NS_PER_S)
        return min(recent, default=0) / NS_PER_S

    def judge_rejections(self, now_ns: int) -> Finding | None:
        """Return why the messages of the last seconds were not used; None if only a few were rejected."""
        self._forget_before(now_ns - _WINDOW_NS)
        count = len(self._rejected)
        if count <= 2 + 0.1 * len(self._arrivals):  # as after a jump of the stamps, and one in ten
            return None
        last = self._rejected[-1][1]
        text = f'{min(count, len(self._arrivals))} of the last {len(self._arrivals)} messages not used: {_shown(last)}'
        return Finding(DiagnosticStatus.ERROR, text, _MESSAGE_REJECTED[last.reason])

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
        rate, delay_s = self.rate(now_ns), self._arrivals[-1][1] / NS_PER_S if self._arrivals else 0.0
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
        self._max_skew_s = alignment.max_lag + 0.1  # by jitter
        self.by_topic: dict[AnyTopic, InputMonitor] = {}
        for topic in topics:
            times = [longest[item] for item in required_inputs(topic)]
            longest_s = min(times, default=0.0)
            slowest_s = max(longest_s, alignment.max_interval)
            self.by_topic[topic] = InputMonitor(topic, longest_s, slowest_s, optional=not times)

    def arrived(self, topic: AnyTopic, stamp_ns: int, now_ns: int, rejected: Iterable[Rejection]) -> None:
        """Record a message and the messages that were rejected with it.

        Rejections come later than their messages: a stamp that does not fit waits for the next ones.
        """
        for rejection in rejected:
            if rejection.reason not in _MESSAGE_REJECTED:  # nothing is wrong with a topic faster than the period
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
                found.append(
                    f'no {label_of(topic)} {f"for {item.missing_for_s(now_ns):.1f} s" if item.count else "yet"}'
                )
            elif not item.optional and (rejections := item.judge_rejections(now_ns)) is not None:
                found.append(f'{label_of(topic)}: {rejections.text}')
            elif skew_s := self.skew_s(topic, now_ns):
                found.append(f'{label_of(topic)}: {_apart(skew_s)} those of the other inputs')
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
    return ', '.join(name if n == 1 else f'{name} ({n} of this name)' for name, n in Counter(names).items())


@dataclass(eq=False)
class StepTimes:
    """Computing time of the estimator per sample."""

    longest: float = 0.0  # The longest step since the start [s]
    overruns: int = 0  # Steps since then that delayed the next sample, at 5 Hz
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=3000))  # ten minutes at 5 Hz

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
    fault: str = ''  # Why the estimator cannot continue, '' if it can
    unsaved: str = ''  # Why the state cannot be saved now, '' if it can
    # Since when the estimate has its status [ns], by the node's clock; 0 if not known, as after a jump of the clock
    since_ns: int = 0
    step_times: StepTimes = field(default_factory=StepTimes)

    def forget(self) -> None:
        """Forget what configuring the node has made."""
        self.inputs = self.pipeline = None
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


# Level, meaning and what to do of each status.
_STATUSES: Final = {
    Status.UNINITIALIZED: (DiagnosticStatus.WARN, 'no sample yet', 'wait for the inputs'),
    Status.CONVERGING: (
        DiagnosticStatus.WARN,
        'not certain enough to be used yet',
        'drive on, it learns at changing speeds',
    ),
    Status.VALID: (DiagnosticStatus.OK, 'fit to use, updating', ''),
    Status.HOLDING: (DiagnosticStatus.OK, 'fit to use, not updating now', ''),
    Status.STALE: (DiagnosticStatus.STALE, 'inputs missing, last estimate kept', 'restore the inputs that are named'),
    Status.FAULT: (
        DiagnosticStatus.ERROR,
        'the estimator cannot continue',
        'call the service reset of the node; if it fails again, report the log',
    ),
}
# Why samples are rejected although all inputs arrive, and what to do.
_REJECTED: Final = {
    Reason.SPEED_STUCK: ('ato/speed is stuck', 'check the speed sensor'),
    Reason.CONTRADICTION: ('speed and forces contradict each other', 'check the inputs if this lasts'),
    Reason.FORCE_MISSING: ('no ato/force at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.GRADIENT_MISSING: ('no ato/gradient at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.BRAKE_COMMAND_MISSING: ('no ato/brake_command at the stamps of ato/speed', 'synchronise their clocks'),
}


@dataclass(frozen=True, slots=True)
class EstimatorSpec:
    """What distinguishes one estimator node from the others."""

    kind: EstimatorKind[Any]  # What it estimates
    shown: tuple[str, ...]  # Fields to show in the diagnostics, the most important first
    # Returns further diagnostics, as names and values, for the prior and the current estimate
    details: Callable[[Any, Any], Iterable[tuple[str, str]]] = lambda _prior, _live: ()


def _unusable(output: Output[Any]) -> tuple[str, str] | None:
    """Return why the newest sample was rejected and what to do, None if it was not, or if that is in order."""
    rejection = output.last_rejection
    if output.status in {Status.STALE, Status.FAULT} or rejection is None or rejection.stamp_ns != output.stamp_ns:
        return None
    return _REJECTED.get(rejection.reason)


def _condemned(faults: InputFaults) -> tuple[tuple[str, str], ...]:
    """Return which inputs contradict each other, and which estimates wait; nothing while they agree."""
    if not faults.finding:
        return ()
    return ('inputs', ', '.join(faults.inputs)), ('holds_back', ', '.join(faults.holds_back))


def _unit(estimate: Any, name: str) -> str:
    unit = quantities(type(estimate))[name].unit
    return '' if unit == '1' else unit


def _compared(shown: tuple[str, ...], prior: Any, live: Any) -> Iterable[tuple[str, object]]:
    for name in shown:
        unit = f' [{_unit(live, name)}]' if _unit(live, name) else ''
        yield f'{name}{unit}', f'{getattr(live, name):.6g}'
        if not math.isnan(deviation := deviation_of(live, name)):
            yield f'{name} std{unit}', f'{deviation:.3g}'
        yield f'{name} prior{unit}', f'{getattr(prior, name):.6g}'


class DiagnosticsPublisher:
    """Publishes the status of an estimator and of its inputs."""

    def __init__(self, context: NodeContext, spec: EstimatorSpec) -> None:
        self._context, self._node, self._spec = context, context.node, spec
        self._publisher = context.node.create_publisher(
            DiagnosticArray, '/diagnostics', estimate_qos(), event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._name = context.node.get_fully_qualified_name().strip('/')
        self._now_ns = self._published_ns = 0
        self._clock_problem = ''
        self._busy_s = 0.0
        self._known: dict[AnyTopic, Finding] = {}
        self._problems: dict[str, Finding] = {}
        # Hash of the definition with which a topic is subscribed, by topic and type
        self._definitions: dict[tuple[AnyTopic, str], str] = {}

    def publish(self) -> None:
        """Publish everything; called once per diagnostic period."""
        context = self._context
        self._note_stall()
        if context.inputs is not None:
            context.inputs.drain()  # what waits has arrived: the inputs are not late where this node is
        before_ns, self._now_ns = self._now_ns, self._node.now_ns()
        self._clock_problem = self._find_clock_problem(before_ns)
        self._problems = {
            name: replace(found, since_ns=self._problems[name].since_ns if name in self._problems else self._now_ns)
            for name, found in self._find_problems().items()
        }
        array = DiagnosticArray()
        array.header.stamp = time_message(self._now_ns)
        if context.pipeline is None or context.inputs is None:
            self._known.clear()
            array.status = [self._idle()]
        else:
            monitors = context.monitors.by_topic.values()
            array.status = [
                self.estimator_status(context.pipeline),
                *(self._input(context.inputs, monitor) for monitor in monitors),
            ]
        named = context.mapping.mapping.named
        for status in array.status:
            status.message = named(status.message)
            for item in status.values:
                item.value = named(item.value)
        self._publisher.publish(array)

    def _note_stall(self) -> None:
        """Note how much later than it should this call comes: the inputs were kept waiting, too."""
        before_ns, self._published_ns = self._published_ns, self._node.steady_ns()
        period_s = float(self._context.parameters.value('diagnostic_period'))
        late_s = (self._published_ns - before_ns) / NS_PER_S - period_s
        self._busy_s = late_s if before_ns and late_s > 0.8 else 0.0

    def _status(self, name: str, level: bytes, message: str, values: Iterable[tuple[str, object]]) -> Any:
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values]
        return DiagnosticStatus(
            level=level, name=f'{self._name}: {name}', message=message, hardware_id='', values=pairs
        )

    def _idle(self) -> Any:
        """Return the estimator's status while the node is not configured."""
        state, failure = self._node.state, self._node.failure
        level = DiagnosticStatus.ERROR if failure else DiagnosticStatus.WARN
        action = f'{failure}; correct this, then configure again' if failure else 'configure and activate it'
        return self._status(
            'estimator', level, Finding(level, state, action).sentence(self._now_ns), (('state', state),)
        )

    def estimator_status(self, pipeline: EstimatorPipeline[Any]) -> Any:
        """Return the status of a configured estimator."""
        context, now_ns, since_ns = self._context, self._now_ns, self._context.since_ns
        output, spec, steps = pipeline.current(), self._spec, context.step_times
        findings = [*self._problems.values(), self._judge_estimate(output, pipeline.why_converging)]
        levels = [finding.level for finding in findings]
        # An error comes before STALE, whose number is higher.
        level = DiagnosticStatus.ERROR if DiagnosticStatus.ERROR in levels else max(levels)
        known = (('time in status [s]', f'{(now_ns - since_ns) / NS_PER_S:.1f}'),) if 0 < since_ns <= now_ns else ()
        step_times = zip(('p50', 'p99', 'max'), (*steps.quantiles(), steps.longest), strict=True)
        values = (
            ('state', self._node.state),
            *known,
            ('status', output.status.name),
            ('used', output.used),
            ('rejected', output.rejected),
            *((f'rejected.{reason.name}', count) for reason, count in sorted(pipeline.rejections.items())),
            *_condemned(pipeline.stream.faults),
            ('last rejection', 'none' if output.last_rejection is None else output.last_rejection),
            *_compared(spec.shown, pipeline.prior, output.estimate),
            ('consistency', pipeline.consistency),
            ('consistency ratio', f'{pipeline.consistency.ratio:.3f}'),
            *spec.details(pipeline.prior, output.estimate),
            *((f'step time {name} [ms]', f'{seconds * 1e3:.3f}') for name, seconds in step_times),
            ('overruns', steps.overruns),
            ('resets', pipeline.resets),
        )
        return self._status('estimator', level, '; '.join(finding.sentence(now_ns) for finding in findings), values)

    def _judge_estimate(self, output: Output[Any], why_converging: str) -> Finding:
        """Return what is the case with the estimate, with the most important value of it."""
        status, state, first = output.status, self._node.state, self._spec.shown[0]
        level, meaning, action = _STATUSES[status]
        reasons = {
            Status.STALE: self._context.missing_inputs(),
            Status.FAULT: self._context.fault,
            Status.CONVERGING: why_converging,
        }
        reason = f' ({reasons[status]})' if reasons.get(status) else ''
        value = f'{first} {getattr(output.estimate, first):.4g} {_unit(output.estimate, first)}'.rstrip()
        text = f'{status.name}: {meaning}{reason}; {value}'
        if state != 'active':
            return Finding(DiagnosticStatus.WARN, f'{state}, inputs are ignored; last {text}', 'activate it')
        # Nothing is valid while one of these problems lasts, whatever is driven.
        if status is Status.CONVERGING and {'contradiction', 'brake'} & self._problems.keys():
            action = ''
        return Finding(level, text, action, self._context.since_ns)

    def _input(self, inputs: InputGroup, monitor: InputMonitor) -> Any:
        """Return the status of one input, after a look in the graph for its publishers."""
        topic, now_ns = self._node.resolve_topic_name(monitor.topic.name), self._now_ns
        self._look(inputs, monitor, topic)
        finding = self._judge(monitor, now_ns)
        level, message = finding.level, finding.sentence(now_ns)
        heard, unheard = monitor.publishers.heard, monitor.publishers.unheard
        if self._clock_problem:
            level, message = max(level, DiagnosticStatus.WARN), f'{self._clock_problem}; {message}'
        values = (
            ('topic', topic),
            ('rate [Hz]', f'{monitor.rate(now_ns):.2f}'),
            ('age [s]', f'{monitor.age_s(now_ns):.3f}'),
            ('time since last message [s]', f'{monitor.missing_for_s(now_ns):.3f}'),
            ('count', monitor.count),
            ('publishers', len(heard) + len(unheard)),
            ('heard', ', '.join(heard) or 'none'),
            ('not heard', '; '.join(unheard) or 'none'),
        )
        return self._status(f'input {label_of(monitor.topic)}', level, message, values)

    def _find_problems(self) -> dict[str, Finding]:
        """Return what is wrong beside the status of the estimate, by name, the worst first."""
        warn, pipeline, found = DiagnosticStatus.WARN, self._context.pipeline, dict[str, Finding]()
        if pipeline is not None and pipeline.stream.finding:
            holds = pipeline.trust.finding != ''  # whether the contradiction holds back this estimator
            found['contradiction'] = Finding(
                DiagnosticStatus.ERROR if holds else warn,
                f'inputs contradict each other: {pipeline.stream.finding}',
                'check units, signs, stamps and publishers of the inputs, and the train file; '
                f'{"nothing is learned meanwhile" if holds else "this estimate does not depend on it"}',
            )
        if pipeline is not None and (brake := brake_findings(pipeline)):
            found['brake'] = Finding(warn, '; '.join(brake), 'correct it; no brake rate is valid meanwhile')
        if pipeline is not None and self._context.kind.adhesion and (slip := pipeline.adhesion().estimate).slipping:
            word = 'slips' if slip.slip > 0.0 else 'slides'
            found['slip'] = Finding(
                warn,
                f'the measured axle {word} ({slip.slip:+.0%}); adhesion {slip.adhesion:.3f} ± {slip.adhesion_std:.3f}',
                'allow for longer stopping distances; nothing is learned from this axle meanwhile',
            )
        if pipeline is not None and (waiting := self._context.parameters.waiting):
            text = f'parameters were set that do not act yet: {", ".join(waiting)}'
            found['parameters'] = Finding(warn, text, 'configure the node again, or set them back')
        if self._clock_problem:
            found['clock'] = Finding(warn, self._clock_problem)
        if pipeline is not None and (rejected := _unusable(pipeline.current())) is not None:
            found['rejected'] = Finding(warn, f'samples are rejected: {rejected[0]}', rejected[1])
        if pipeline is not None and pipeline.consistency.is_alarm:
            text = f'errors exceed the stated uncertainty: {pipeline.consistency}'
            found['errors'] = Finding(warn, text, 'compare train file and inputs with the train')
        if problem := self._context.unsaved:
            action = 'make room on the disk, or correct checkpoint_file'
            found['unsaved'] = Finding(warn, f'not saved: {problem}', action)
        if self._busy_s:
            text = f'this node was busy or stopped for {self._busy_s:.1f} s'
            found['busy'] = Finding(warn, text, 'give it more computing time')
        return found

    def _look(self, inputs: InputGroup, monitor: InputMonitor, name: str) -> None:
        """Look in the graph for the publishers of a topic, of which this is the full name; log what is wrong."""
        before, logger = monitor.publishers, self._node.get_logger()
        monitor.publishers = self._publishers(inputs, monitor.topic, name)
        if not inputs.subscriptions[monitor.topic].may_mix:
            monitor.publishers = monitor.publishers.at_a_time()
        logged = inputs.logged.get(monitor.topic, Publishers())
        if before != monitor.publishers or before == logged:  # the graph knows names later than publishers
            return
        inputs.logged[monitor.topic] = before
        if before.unheard and before.unheard != logged.unheard:
            logger.error(f'{name}: {"; ".join(before.unheard)}')
        if len(before.heard) > max(1, len(logged.heard)):
            logger.warning(f'{name}: more than one publisher: {_names(before.heard)}')

    def _publishers(self, inputs: InputGroup, topic: AnyTopic, name: str) -> Publishers:
        subscription, infos = inputs.subscriptions[topic], self._node.get_publishers_info_by_topic(name)
        if infos and (problem := subscription.unreadable()) is not None:
            return problem
        if not (wanted := subscription.type):
            return Publishers()
        key = (topic, wanted)
        if key not in self._definitions:
            for info in self._node.get_subscriptions_info_by_topic(name):
                is_own = info.node_name == inputs.subscriber and info.topic_type == wanted
                if is_own and is_hash(text := str(info.topic_type_hash)):
                    self._definitions[key] = text
        return sort_publishers(infos, wanted, self._definitions.get(key, ''), subscription.profile)

    def _judge(self, monitor: InputMonitor, now_ns: int) -> Finding:
        """Return what is the case with an input, and since when."""
        skew_s = self._context.monitors.skew_s(monitor.topic, now_ns)
        finding = monitor.judge(now_ns, self._context.timeout_s(monitor.topic), skew_s)
        known = self._known.get(monitor.topic)
        # The text changes with its numbers; what to do is the same as long as the matter is.
        since_ns = known.since_ns if known is not None and known.action == finding.action else now_ns
        if finding.level != DiagnosticStatus.OK:
            finding = replace(finding, since_ns=finding.since_ns or since_ns)
        self._known[monitor.topic] = finding
        return finding

    def _find_clock_problem(self, before_ns: int) -> str:
        """Return what is wrong with simulated time, '' if nothing; ``before_ns`` was the time of the last call."""
        if not self._node.get_clock().ros_time_is_active:
            return ''
        if self._now_ns == 0:
            return 'use_sim_time is set, but no /clock has arrived: play a bag with its clock, or set it to false'
        if len(infos := self._node.get_publishers_info_by_topic('/clock')) > 1:
            names = _names(sorted(f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos))
            return f'{len(infos)} publishers of /clock: {names}: stop all but one'
        return '/clock has stopped: resume its publisher' if self._now_ns == before_ns else ''
