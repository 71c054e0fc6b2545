# SPDX-License-Identifier: Apache-2.0
"""Publishes ``/diagnostics`` of one estimator node, and logs wrong publishers of its inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from trainid_ros.brake_rate.brake_findings import brake_findings
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.ros.diagnostics import NodeHealth, Problem, estimator_status, idle_status, input_status, unusable
from trainid_ros.ros.input_monitor import Finding, InputMonitor
from trainid_ros.ros.publishers import Publishers, is_hash, sort_publishers
from trainid_ros.ros.topics import NO_PUBLISHER_EVENTS, diagnostics_qos, time_message

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.ros.estimator_node import EstimatorNode
    from trainid_ros.ros.foreign_topics import AnyTopic

# A node that comes later than this to its diagnostics has kept its inputs waiting, too [s].
_BUSY_S: Final = 0.8


class DiagnosticsPublisher:
    """Publishes the status of an estimator and of its inputs."""

    def __init__(self, node: EstimatorNode) -> None:
        self._node = node
        self._publisher = node.create_publisher(
            DiagnosticArray, '/diagnostics', diagnostics_qos(), event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._now_ns = 0
        self._published_ns = 0
        self._busy_s = 0.0
        self._known: dict[AnyTopic, Finding] = {}
        self._began: dict[Problem, int] = {}
        self._definitions: dict[tuple[AnyTopic, str], str] = {}

    def publish(self) -> None:
        """Publish everything; called once per diagnostic period."""
        node = self._node
        self._note_stall()
        if node.pipeline is not None:
            node.inputs.drain()  # what waits has arrived: the inputs are not late where this node is
        health = self._health(node.now_ns())
        array = DiagnosticArray()
        array.header.stamp = time_message(health.now_ns)
        if node.pipeline is None:
            self._known.clear()
            array.status = [idle_status(health)]
        else:
            array.status = [self._estimator(health, node.pipeline), *self._inputs(health)]
        for status in array.status:
            status.message = node.mapping.named(status.message)
            for item in status.values:
                item.value = node.mapping.named(item.value)
        self._publisher.publish(array)

    def _note_stall(self) -> None:
        """Note how much later than it should this call comes."""
        before_ns, self._published_ns = self._published_ns, self._node.steady_ns()
        late_s = (self._published_ns - before_ns) / NS_PER_S - float(self._node.parameters.value('diagnostic_period'))
        self._busy_s = late_s if before_ns and late_s > _BUSY_S else 0.0

    def _health(self, now_ns: int) -> NodeHealth:
        node, clock_problem = self._node, self._clock_problem(now_ns)
        self._note_problems(now_ns, clock_problem)
        return NodeHealth(
            name=node.get_fully_qualified_name().strip('/'),
            state=node.state,
            failure=node.failure,
            now_ns=now_ns,
            clock_problem=clock_problem,
            since_ns=node.status_changes.since_ns,
            missing=node.missing_inputs(),
            fault=node.fault,
            unsaved=node.checkpoints.problem,
            busy_s=self._busy_s,
            began=self._began,
        )

    def _estimator(self, health: NodeHealth, pipeline: EstimatorPipeline[Any]) -> DiagnosticStatus:
        node = self._node
        details = node.spec.details(node.prior, pipeline.current().estimate)
        steps = node.step_times.summary()
        return estimator_status(health, pipeline, node.spec.shown, node.prior, steps, details)

    def _inputs(self, health: NodeHealth) -> Iterator[DiagnosticStatus]:
        for monitor in self._node.monitors.by_topic.values():
            topic = self._node.resolve_topic_name(monitor.topic.name)
            yield input_status(health, monitor, topic, self._judge(monitor, topic, health.now_ns))

    def _note_problems(self, now_ns: int, clock_problem: str) -> None:
        """Note when each present problem began."""
        pipeline = self._node.pipeline
        present: dict[Problem, object] = {
            Problem.CLOCK: clock_problem,
            Problem.UNSAVED: self._node.checkpoints.problem,
            Problem.BUSY: self._busy_s,
        }
        if pipeline is not None:
            present |= {
                Problem.CONTRADICTION: pipeline.stream.finding,
                Problem.BRAKE: brake_findings(pipeline),
                Problem.REJECTED: unusable(pipeline.current()),
                Problem.ERRORS: pipeline.consistency.is_alarm,
            }
        self._began = {problem: self._began.get(problem, now_ns) for problem, holds in present.items() if holds}

    def _judge(self, monitor: InputMonitor, topic: str, now_ns: int) -> Finding:
        """Return what is the case with an input, since when, after a look at the graph."""
        node, before = self._node, monitor.publishers
        monitor.publishers = self._publishers(monitor.topic, topic)
        if not node.inputs.subscriptions.may_mix(monitor.topic):
            monitor.publishers = monitor.publishers.at_a_time()
        if monitor.publishers.unheard and monitor.publishers.unheard != before.unheard:
            node.get_logger().error(f'{topic}: {"; ".join(monitor.publishers.unheard)}')
        if len(monitor.publishers.heard) > max(1, len(before.heard)):
            node.get_logger().warning(f'{topic}: more than one publisher: {", ".join(monitor.publishers.heard)}')
        skew_s = node.monitors.skew_s(monitor.topic, now_ns)
        finding = monitor.judge(now_ns, node.timeout_s(monitor.topic), skew_s)
        known = self._known.get(monitor.topic)
        # The text changes with its numbers; what to do is the same as long as the matter is.
        since_ns = known.since_ns if known is not None and known.action == finding.action else now_ns
        if finding.level != DiagnosticStatus.OK:
            finding = Finding(finding.level, finding.text, finding.action, finding.since_ns or since_ns)
        self._known[monitor.topic] = finding
        return finding

    def _publishers(self, topic: AnyTopic, name: str) -> Publishers:
        """Return who publishes on a topic, after a look at the graph; ``name`` is its full name."""
        subscriptions, infos = self._node.inputs.subscriptions, self._node.get_publishers_info_by_topic(name)
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
                is_own = info.node_name == self._node.inputs.subscriber and info.topic_type == wanted
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
