# SPDX-License-Identifier: Apache-2.0
"""Publishes ``/diagnostics`` of a node: one status for the estimator and one for each input; logs wrong publishers.

Ages are measured with the node's clock, so they are correct under simulated time too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Status, deviation_of, quantities
from trainid_ros.ros.input_monitor import Finding, InputMonitor
from trainid_ros.ros.topics import NO_PUBLISHER_EVENTS, Publishers, estimate_qos, is_hash, sort_publishers, time_message
from trainid_ros.setup.pipelines import brake_findings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Output
    from trainid_ros.ros.checkpoints import Checkpoints
    from trainid_ros.ros.estimate_publisher import StatusChanges
    from trainid_ros.ros.input_monitor import NodeContext, StepTimes
    from trainid_ros.ros.inputs import AnyTopic, InputGroup
    from trainid_ros.setup.pipelines import EstimatorKind

# Level, meaning and what to do of each status.
_STATUSES: Final = {
    Status.UNINITIALIZED: (DiagnosticStatus.WARN, 'no sample yet', 'wait for the inputs'),
    Status.CONVERGING: (
        DiagnosticStatus.WARN,
        'converging, not yet fit to use',
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


@dataclass(frozen=True, slots=True)
class NodeHealth:
    """State of the node apart from its estimator."""

    name: str  # Name of the node
    state: str  # Its lifecycle state
    failure: str  # Reason of the last failed transition, '' if it succeeded
    now_ns: int  # The node's time [ns]
    clock_problem: str  # What is wrong with the clock, '' if nothing is
    since_ns: int = 0  # Since when the estimate has its status [ns]
    missing: str = ''  # Which inputs are missing, '' if none is
    fault: str = ''  # Why the estimator cannot continue, '' if it can
    # What is wrong beside the status of the estimate, by name, the worst first
    problems: Mapping[str, Finding] = field(default_factory=dict)


def idle_status(health: NodeHealth) -> Any:
    """Return the estimator's status while the node is not configured."""
    level = DiagnosticStatus.ERROR if health.failure else DiagnosticStatus.WARN
    action = f'{health.failure}; correct this, then configure again' if health.failure else 'configure and activate it'
    message = Finding(level, health.state, action).sentence(health.now_ns)
    return _status(f'{health.name}: estimator', level, message, (('state', health.state),))


def unusable(output: Output[Any]) -> tuple[str, str] | None:
    """Return why the newest sample was rejected and what to do, None if it was not, or if that is in order."""
    rejection = output.last_rejection
    if output.status in {Status.STALE, Status.FAULT} or rejection is None or rejection.stamp_ns != output.stamp_ns:
        return None
    return _REJECTED.get(rejection.reason)


def _judge(health: NodeHealth, output: Output[Any], value: str, why_converging: str) -> Finding:
    """Return what is the case with the estimate; ``value`` is the most important one of it."""
    status = output.status
    level, meaning, action = _STATUSES[status]
    reasons = {Status.STALE: health.missing, Status.FAULT: health.fault, Status.CONVERGING: why_converging}
    reason = reasons.get(status, '')
    text = f'{status.name}: {meaning}{f" ({reason})" if reason else ""}; {value}'
    if health.state != 'active':
        return Finding(DiagnosticStatus.WARN, f'{health.state}, inputs are ignored; last {text}', 'activate it')
    # Nothing is valid while one of these problems lasts, whatever is driven.
    if status is Status.CONVERGING and {'contradiction', 'brake'} & health.problems.keys():
        action = ''
    return Finding(level, text, action, health.since_ns)


def estimator_status(
    health: NodeHealth, spec: EstimatorSpec, pipeline: EstimatorPipeline[Any], prior: Any, steps: StepTimes
) -> Any:
    """Return the status of a configured estimator."""
    output, first = pipeline.current(), spec.shown[0]
    value = f'{first} {getattr(output.estimate, first):.4g} {_unit(output.estimate, first)}'.rstrip()
    findings = [*health.problems.values(), _judge(health, output, value, pipeline.why_converging)]
    message = '; '.join(finding.sentence(health.now_ns) for finding in findings)
    levels = [finding.level for finding in findings]
    # An error comes before STALE, whose number is higher.
    level = DiagnosticStatus.ERROR if DiagnosticStatus.ERROR in levels else max(levels)
    known_s = (health.now_ns - health.since_ns) / NS_PER_S if 0 < health.since_ns <= health.now_ns else None
    step_times = zip(('p50', 'p99', 'max'), (*steps.quantiles(), steps.longest), strict=True)
    values = (
        ('state', health.state),
        *(() if known_s is None else (('time in status [s]', f'{known_s:.1f}'),)),
        ('status', output.status.name),
        ('used', output.used),
        ('rejected', output.rejected),
        *((f'rejected.{reason.name}', count) for reason, count in sorted(pipeline.rejections.items())),
        ('last rejection', 'none' if output.last_rejection is None else output.last_rejection),
        *_compared(spec.shown, prior, output.estimate),
        ('consistency', pipeline.consistency),
        ('consistency ratio', f'{pipeline.consistency.ratio:.3f}'),
        *spec.details(prior, output.estimate),
        *((f'step time {name} [ms]', f'{seconds * 1e3:.3f}') for name, seconds in step_times),
        ('overruns', steps.overruns),
        ('resets', pipeline.resets),
    )
    return _status(f'{health.name}: estimator', level, message, values)


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


def input_status(health: NodeHealth, monitor: InputMonitor, topic: str, finding: Finding) -> Any:
    """Return the status of one input; ``topic`` is its remapped name, ``finding`` what is the case."""
    now_ns, level, message = health.now_ns, finding.level, finding.sentence(health.now_ns)
    heard, unheard = monitor.publishers.heard, monitor.publishers.unheard
    if health.clock_problem:
        level, message = max(level, DiagnosticStatus.WARN), f'{health.clock_problem}; {message}'
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
    return _status(f'{health.name}: input {monitor.label}', level, message, values)


def _status(name: str, level: bytes, message: str, values: Iterable[tuple[str, object]]) -> Any:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id='', values=pairs)


class DiagnosticsPublisher:
    """Publishes the status of an estimator and of its inputs."""

    def __init__(
        self, context: NodeContext, spec: EstimatorSpec, checkpoints: Checkpoints, changes: StatusChanges
    ) -> None:
        self._context, self._node, self._spec = context, context.node, spec
        self._checkpoints, self._changes = checkpoints, changes
        self._publisher = context.node.create_publisher(
            DiagnosticArray, '/diagnostics', estimate_qos(), event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._now_ns = 0
        self._published_ns = 0
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
        health = self._health(self._node.now_ns())
        array = DiagnosticArray()
        array.header.stamp = time_message(health.now_ns)
        if context.pipeline is None or context.inputs is None:
            self._known.clear()
            array.status = [idle_status(health)]
        else:
            own = estimator_status(health, self._spec, context.pipeline, context.prior, context.step_times)
            array.status = [own, *self._inputs(health, context.inputs)]
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

    def _health(self, now_ns: int) -> NodeHealth:
        node, clock_problem = self._node, self._clock_problem(now_ns)
        self._problems = {
            name: replace(found, since_ns=self._problems[name].since_ns if name in self._problems else now_ns)
            for name, found in self._find_problems(clock_problem).items()
        }
        return NodeHealth(
            name=node.get_fully_qualified_name().strip('/'),
            state=node.state,
            failure=node.failure,
            now_ns=now_ns,
            clock_problem=clock_problem,
            since_ns=self._changes.since_ns,
            missing=self._context.missing_inputs(),
            fault=self._context.fault,
            problems=self._problems,
        )

    def _inputs(self, health: NodeHealth, inputs: InputGroup) -> Iterator[DiagnosticStatus]:
        for topic, monitor in self._context.monitors.by_topic.items():
            name = self._node.resolve_topic_name(topic.name)
            self._look(inputs, monitor, name)
            yield input_status(health, monitor, name, self._judge(monitor, health.now_ns))

    def _find_problems(self, clock_problem: str) -> dict[str, Finding]:
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
        if clock_problem:
            found['clock'] = Finding(warn, clock_problem)
        if pipeline is not None and (rejected := unusable(pipeline.current())) is not None:
            found['rejected'] = Finding(warn, f'samples are rejected: {rejected[0]}', rejected[1])
        if pipeline is not None and pipeline.consistency.is_alarm:
            text = f'errors exceed the stated uncertainty: {pipeline.consistency}'
            found['errors'] = Finding(warn, text, 'compare train file and inputs with the train')
        if problem := self._checkpoints.problem:
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
        if monitor.publishers.unheard and monitor.publishers.unheard != before.unheard:
            logger.error(f'{name}: {"; ".join(monitor.publishers.unheard)}')
        if len(monitor.publishers.heard) > max(1, len(before.heard)):
            logger.warning(f'{name}: more than one publisher: {", ".join(monitor.publishers.heard)}')

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

    def _clock_problem(self, now_ns: int) -> str:
        """Return what is wrong with simulated time, '' if nothing."""
        before, self._now_ns = self._now_ns, now_ns
        if not self._node.get_clock().ros_time_is_active:
            return ''
        if now_ns == 0:
            return 'use_sim_time is set, but no /clock has arrived: play a bag with its clock, or set it to false'
        return '/clock has stopped: resume its publisher' if now_ns == before else ''
