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
from trainid_ros.ros.topics import (
    NO_PUBLISHER_EVENTS,
    Publishers,
    diagnostics_qos,
    is_hash,
    sort_publishers,
    time_message,
)
from trainid_ros.setup.pipelines import brake_findings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import Output
    from trainid_ros.ros.checkpoints import Checkpoints
    from trainid_ros.ros.context import NodeContext, StepTimeSummary
    from trainid_ros.ros.estimate_publisher import StatusChanges
    from trainid_ros.ros.inputs import AnyTopic, InputGroup
    from trainid_ros.setup.pipelines import EstimatorKind

_LEVELS: Final = {
    Status.UNINITIALIZED: DiagnosticStatus.WARN,
    Status.CONVERGING: DiagnosticStatus.WARN,
    Status.VALID: DiagnosticStatus.OK,
    Status.HOLDING: DiagnosticStatus.OK,
    Status.STALE: DiagnosticStatus.STALE,
    Status.FAULT: DiagnosticStatus.ERROR,
}
_MEANINGS: Final = {
    Status.UNINITIALIZED: 'no sample yet',
    Status.CONVERGING: 'converging, not yet fit to use',
    Status.VALID: 'fit to use, updating',
    Status.HOLDING: 'fit to use, not updating now',
    Status.STALE: 'inputs missing, last estimate kept',
    Status.FAULT: 'the estimator cannot continue',
}
_ACTIONS: Final = {
    Status.UNINITIALIZED: 'wait for the inputs',
    Status.CONVERGING: 'drive on, it learns at changing speeds',
    Status.STALE: 'restore the inputs that are named',
    Status.FAULT: 'call the service reset of the node; if it fails again, report the log',
}
# Why samples are rejected although all inputs arrive, and what to do.
_REJECTED: Final = {
    Reason.SPEED_STUCK: ('ato/speed is stuck', 'check the speed sensor'),
    Reason.CONTRADICTION: ('speed and forces contradict each other', 'check the inputs if this lasts'),
    Reason.FORCE_MISSING: ('no ato/force at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.GRADIENT_MISSING: ('no ato/gradient at the stamps of ato/speed', 'synchronise their clocks'),
    Reason.BRAKE_COMMAND_MISSING: ('no ato/brake_command at the stamps of ato/speed', 'synchronise their clocks'),
}


def _no_details(_prior: Any, _live: Any) -> Iterable[tuple[str, str]]:
    return ()


@dataclass(frozen=True, slots=True)
class EstimatorSpec:
    """What distinguishes one estimator node from the others."""

    kind: EstimatorKind[Any]  # What it estimates
    shown: tuple[str, ...]  # Fields to show in the diagnostics, the most important first
    # Returns further diagnostics, as names and values, for the prior and the current estimate
    details: Callable[[Any, Any], Iterable[tuple[str, str]]] = _no_details


# Nothing is valid while one of these problems lasts, whatever is driven.
_BLOCKING: Final = frozenset({'contradiction', 'brake'})


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
    reasons = {Status.STALE: health.missing, Status.FAULT: health.fault, Status.CONVERGING: why_converging}
    reason = reasons.get(status, '')
    text = f'{status.name}: {_MEANINGS[status]}{f" ({reason})" if reason else ""}; {value}'
    if health.state != 'active':
        return Finding(DiagnosticStatus.WARN, f'{health.state}, inputs are ignored; last {text}', 'activate it')
    # What to do about a problem comes before driving on.
    action = '' if status is Status.CONVERGING and _BLOCKING & health.problems.keys() else _ACTIONS.get(status, '')
    return Finding(_LEVELS[status], text, action, health.since_ns)


def estimator_status(
    health: NodeHealth,
    pipeline: EstimatorPipeline[Any],
    shown: tuple[str, ...],
    prior: Any,
    steps: StepTimeSummary,
    details: Iterable[tuple[str, str]],
) -> Any:
    """Return the status of a configured estimator."""
    output, first = pipeline.current(), shown[0]
    value = f'{first} {getattr(output.estimate, first):.4g} {_unit(output.estimate, first)}'.rstrip()
    findings = [*health.problems.values(), _judge(health, output, value, pipeline.why_converging)]
    message = '; '.join(finding.sentence(health.now_ns) for finding in findings)
    levels = [finding.level for finding in findings]
    # An error comes before STALE, whose number is higher.
    level = DiagnosticStatus.ERROR if DiagnosticStatus.ERROR in levels else max(levels)
    known_s = (health.now_ns - health.since_ns) / NS_PER_S if 0 < health.since_ns <= health.now_ns else None
    rejections = sorted(pipeline.rejections.items())
    quantiles = (('p50', steps.p50), ('p99', steps.p99), ('max', steps.longest))
    values = (
        ('state', health.state),
        *(() if known_s is None else (('time in status [s]', f'{known_s:.1f}'),)),
        ('status', output.status.name),
        ('used', output.used),
        ('rejected', output.rejected),
        *((f'rejected.{reason.name}', count) for reason, count in rejections),
        ('last rejection', 'none' if output.last_rejection is None else output.last_rejection),
        *_compared(shown, prior, output.estimate),
        ('consistency', pipeline.consistency),
        ('consistency ratio', f'{pipeline.consistency.ratio:.3f}'),
        *details,
        *((f'step time {name} [ms]', f'{seconds * 1e3:.3f}') for name, seconds in quantiles),
        ('overruns', steps.overruns),
        ('resets', pipeline.resets),
    )
    return _status(f'{health.name}: estimator', level, message, values)


def _unit(estimate: Any, name: str) -> str:
    """Return the unit of a field, '' for a ratio."""
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
    if health.clock_problem:
        level, message = max(level, DiagnosticStatus.WARN), f'{health.clock_problem}; {message}'
    values = (
        ('topic', topic),
        ('rate [Hz]', f'{monitor.rate(now_ns):.2f}'),
        ('age [s]', f'{monitor.age_s(now_ns):.3f}'),
        ('time since last message [s]', f'{monitor.missing_for_s(now_ns):.3f}'),
        ('count', monitor.count),
        ('publishers', monitor.publishers.count),
        ('heard', ', '.join(monitor.publishers.heard) or 'none'),
        ('not heard', '; '.join(monitor.publishers.unheard) or 'none'),
    )
    return _status(f'{health.name}: input {monitor.label}', level, message, values)


def _status(name: str, level: bytes, message: str, values: Iterable[tuple[str, object]]) -> Any:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values]
    return DiagnosticStatus(level=level, name=name, message=message, hardware_id='', values=pairs)


# A node that comes later than this to its diagnostics has kept its inputs waiting, too [s].
_BUSY_S: Final = 0.8


class DiagnosticsPublisher:
    """Publishes the status of an estimator and of its inputs.

    Args:
        context: The node and the state of its work.
        spec: The estimator.
        checkpoints: Its checkpoints.
        changes: Changes of its status.
        inputs: Returns the inputs of a configured node.
    """

    def __init__(
        self,
        context: NodeContext,
        spec: EstimatorSpec,
        checkpoints: Checkpoints,
        changes: StatusChanges,
        inputs: Callable[[], InputGroup],
    ) -> None:
        self._context, self._node, self._spec = context, context.node, spec
        self._checkpoints, self._changes, self._inputs_of = checkpoints, changes, inputs
        self._publisher = context.node.create_publisher(
            DiagnosticArray, '/diagnostics', diagnostics_qos(), event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._now_ns = 0
        self._published_ns = 0
        self._busy_s = 0.0
        self._known: dict[AnyTopic, Finding] = {}
        self._problems: dict[str, Finding] = {}
        self._definitions: dict[tuple[AnyTopic, str], str] = {}

    def publish(self) -> None:
        """Publish everything; called once per diagnostic period."""
        context = self._context
        self._note_stall()
        if context.pipeline is not None:
            self._inputs_of().drain()  # what waits has arrived: the inputs are not late where this node is
        health = self._health(self._node.now_ns())
        array = DiagnosticArray()
        array.header.stamp = time_message(health.now_ns)
        if context.pipeline is None:
            self._known.clear()
            array.status = [idle_status(health)]
        else:
            array.status = [self._estimator(health, context.pipeline), *self._inputs(health)]
        for status in array.status:
            status.message = context.mapping.named(status.message)
            for item in status.values:
                item.value = context.mapping.named(item.value)
        self._publisher.publish(array)

    def _note_stall(self) -> None:
        """Note how much later than it should this call comes."""
        before_ns, self._published_ns = self._published_ns, self._node.steady_ns()
        late_s = (self._published_ns - before_ns) / NS_PER_S - float(
            self._context.parameters.value('diagnostic_period')
        )
        self._busy_s = late_s if before_ns and late_s > _BUSY_S else 0.0

    def _health(self, now_ns: int) -> NodeHealth:
        node, clock_problem = self._node, self._clock_problem(now_ns)
        self._problems = {
            name: replace(found, since_ns=self._problems[name].since_ns if name in self._problems else now_ns)
            for name, found in self._find_problems(clock_problem).items()
            if found.text
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

    def _estimator(self, health: NodeHealth, pipeline: EstimatorPipeline[Any]) -> DiagnosticStatus:
        spec, prior = self._spec, self._context.prior
        details = spec.details(prior, pipeline.current().estimate)
        steps = self._context.step_times.summary()
        return estimator_status(health, pipeline, spec.shown, prior, steps, details)

    def _inputs(self, health: NodeHealth) -> Iterator[DiagnosticStatus]:
        for monitor in self._context.monitors.by_topic.values():
            topic = self._node.resolve_topic_name(monitor.topic.name)
            yield input_status(health, monitor, topic, self._judge(monitor, topic, health.now_ns))

    def _find_problems(self, clock_problem: str) -> dict[str, Finding]:
        """Return what may be wrong beside the status of the estimate, the worst first; without text it is not."""
        warn, pipeline, unsaved = DiagnosticStatus.WARN, self._context.pipeline, self._checkpoints.problem
        contradiction = brake = rejected = to_do = errors = ''
        holds = False  # Whether the contradiction holds back this estimator
        if pipeline is not None:
            contradiction, brake = pipeline.stream.finding, '; '.join(brake_findings(pipeline))
            holds = pipeline.trust.finding != ''
            rejected, to_do = unusable(pipeline.current()) or ('', '')
            errors = str(pipeline.consistency) if pipeline.consistency.is_alarm else ''

        def found(reason: object, text: str, action: str, level: bytes = warn) -> Finding:
            return Finding(level, text.format(reason) if reason else '', action)

        return {
            'contradiction': found(
                contradiction,
                'inputs contradict each other: {}',
                'check units, signs, stamps and publishers of the inputs, and the train file; '
                f'{"nothing is learned meanwhile" if holds else "this estimate does not depend on it"}',
                DiagnosticStatus.ERROR if holds else warn,
            ),
            'brake': found(brake, '{}', 'correct it; no brake rate is valid meanwhile'),
            'clock': found(clock_problem, '{}', ''),
            'rejected': found(rejected, 'samples are rejected: {}', to_do),
            'errors': found(
                errors, 'errors exceed the stated uncertainty: {}', 'compare train file and inputs with the train'
            ),
            'unsaved': found(unsaved, 'not saved: {}', 'make room on the disk, or correct checkpoint_file'),
            'busy': found(self._busy_s, 'this node was busy or stopped for {:.1f} s', 'give it more computing time'),
        }

    def _judge(self, monitor: InputMonitor, topic: str, now_ns: int) -> Finding:
        """Return what is the case with an input, since when, after a look at the graph."""
        node, before = self._node, monitor.publishers
        monitor.publishers = self._publishers(monitor.topic, topic)
        if not self._inputs_of().subscriptions.may_mix(monitor.topic):
            monitor.publishers = monitor.publishers.at_a_time()
        if monitor.publishers.unheard and monitor.publishers.unheard != before.unheard:
            node.get_logger().error(f'{topic}: {"; ".join(monitor.publishers.unheard)}')
        if len(monitor.publishers.heard) > max(1, len(before.heard)):
            node.get_logger().warning(f'{topic}: more than one publisher: {", ".join(monitor.publishers.heard)}')
        skew_s = self._context.monitors.skew_s(monitor.topic, now_ns)
        finding = monitor.judge(now_ns, self._context.timeout_s(monitor.topic), skew_s)
        known = self._known.get(monitor.topic)
        # The text changes with its numbers; what to do is the same as long as the matter is.
        since_ns = known.since_ns if known is not None and known.action == finding.action else now_ns
        if finding.level != DiagnosticStatus.OK:
            finding = Finding(finding.level, finding.text, finding.action, finding.since_ns or since_ns)
        self._known[monitor.topic] = finding
        return finding

    def _publishers(self, topic: AnyTopic, name: str) -> Publishers:
        """Return who publishes on a topic, after a look at the graph; ``name`` is its full name."""
        subscriptions, infos = self._inputs_of().subscriptions, self._node.get_publishers_info_by_topic(name)
        if infos and (problem := subscriptions.problem(topic)) is not None:
            return problem
        if not (wanted := subscriptions.type(topic)):
            return Publishers()
        definition = self._definition(topic, name, wanted)
        return sort_publishers(infos, wanted, definition, subscriptions.profile(topic))

    def _definition(self, topic: AnyTopic, name: str, wanted: str) -> str:
        """Return the hash of the definition with which a topic is subscribed, '' while it is not known."""
        key = (topic, wanted)
        if key not in self._definitions:
            for info in self._node.get_subscriptions_info_by_topic(name):
                is_own = info.node_name == self._inputs_of().subscriber and info.topic_type == wanted
                if is_own and is_hash(text := str(info.topic_type_hash)):
                    self._definitions[key] = text
        return self._definitions.get(key, '')

    def _clock_problem(self, now_ns: int) -> str:
        """Return what is wrong with simulated time, '' if nothing."""
        before, self._now_ns = self._now_ns, now_ns
        if not self._node.get_clock().ros_time_is_active:
            return ''
        if now_ns == 0:
            return 'use_sim_time is set, but no /clock has arrived: play a bag with its clock, or set it to false'
        return '/clock has stopped: resume its publisher' if now_ns == before else ''
