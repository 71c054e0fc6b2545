# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node around any estimator; it converts messages and computes nothing itself.

Estimates are published from the callback of the message that completes their sample; timers only detect
missing input. They run on a steady clock, which a stopped ``/clock`` cannot stall.
"""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from trainid_ros.errors import InputError, TrainIdError
from trainid_ros.estimators.pipeline import EstimatorPipeline, EstimatorSettings
from trainid_ros.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    NS_PER_S,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
    InputTopic,
    Record,
)
from trainid_ros.results import Status
from trainid_ros.ros.diagnostics import (
    InputMonitor,
    NodeHealth,
    ShownValue,
    StepTimes,
    Watchdog,
    estimator_status,
    idle_status,
    input_status,
)
from trainid_ros.ros.inputs import InputGroup, SharedInputs
from trainid_ros.ros.node import ManagedNode, NodeParameters, guarded
from trainid_ros.ros.parameter_specs import (
    ALGORITHM,
    TRAIN_PARAMETERS,
    ParameterSpec,
    build_settings,
    build_train_file,
    estimator_parameters,
    qos_overrides,
    requested_algorithm,
)
from trainid_ros.ros.services import NUMERICAL_ERRORS, EstimatorServices
from trainid_ros.ros.topics import (
    diagnostics_qos,
    estimate_qos,
    fill_estimate,
    latched_qos,
    message_class,
    overridable,
    publisher_events,
    time_message,
)
from trainid_ros.stream.sample_stream import TimeJumpPolicy
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from trainid_ros.ros.jobs import Job
    from trainid_ros.stream.sample_stream import SampleStream, StreamEvent
    from trainid_ros.train.train_file import TrainFile

_FIRST_WATCH_S: Final = 0.1
# Statuses that already report missing input.
_ALREADY_REPORTED: Final = (Status.STALE, Status.FAULT)
_SUCCESS: Final = TransitionCallbackReturn.SUCCESS


def _no_details(_prior: Any, _live: Any) -> Iterable[tuple[str, str]]:
    return ()


@dataclass(frozen=True, slots=True)
class EstimatorSpec:
    """What distinguishes one estimator node from the others.

    Attributes:
        job: What it estimates.
        shown: Values to show in the diagnostics, the most important first.
        details: Returns further diagnostics, as names and values, for the prior and the current estimate.

    """

    job: Job
    shown: tuple[ShownValue, ...]
    details: Callable[[Any, Any], Iterable[tuple[str, str]]] = _no_details


class EstimatorNode(ManagedNode):
    """Lifecycle node that runs one estimator pipeline."""

    def __init__(
        self, spec: EstimatorSpec, arguments: Sequence[str] = (), inputs: SharedInputs | None = None, **options: Any
    ) -> None:
        """Declare all parameters and create the services; everything else is set up on configure.

        Args:
            spec: The estimator to run.
            arguments: ROS arguments of the process, searched for parameter files.
            inputs: Inputs that the node shares with others of the process, None if it runs alone.
            options: Options of the rclpy node.

        """
        super().__init__(spec.job.node_name, **options)
        self.spec = spec
        self._inputs = inputs or SharedInputs()
        self.job = spec.job
        self._message = message_class(spec.job.topic)
        expected = qos_overrides(self.job, self.resolve_topic_name)
        self.parameters = NodeParameters(self, self._parameter_specs(), expected=expected)
        self.parameters.check_sections(arguments, self.job.node_name)
        self._preload_train_file()
        self.parameters.report()
        self.pipeline: EstimatorPipeline[Any] | None = None
        self._diagnosed_ns = 0
        self._settings = EstimatorSettings()
        self._prior: Any = None
        self._input_group: InputGroup | None = None
        self._monitors: dict[InputTopic, InputMonitor] = {}
        self._estimates: Any = None
        self._last_valid: Any = None
        self._jump_handle: Any = None
        self._watchdog_timer: Any = None
        self._forget()
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', diagnostics_qos())
        self._diagnostic_timer = self._make_diagnostic_timer()
        self._services_offered = EstimatorServices(self)

    def _parameter_specs(self) -> tuple[ParameterSpec, ...]:
        overrides = self._parameter_overrides  # rclpy gives no public access to them
        given = {name: parameter.value for name, parameter in overrides.items()}
        algorithms = self.job.algorithms
        return estimator_parameters(algorithms, requested_algorithm(given, algorithms))

    @property
    def algorithm(self) -> str:
        """Name of the running algorithm."""
        return str(self.parameters.value(ALGORITHM))

    def _make_diagnostic_timer(self) -> Any:
        period = float(self.parameters.value('diagnostic_period'))
        return self.create_timer(period, self.publish_diagnostics, clock=self._steady)

    # Transitions

    @guarded
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the pipeline from the parameters; subscribe."""
        self.failure = ''
        self.parameters.check()
        train_file = self._train_file()
        self._settings = build_settings(self.parameters.values(), self.job.algorithms, self.job.field)
        self.pipeline = self.job.pipeline(train_file, self._settings)
        self._prior = self.pipeline.current().estimate
        self.watchdog = Watchdog(round(self._settings.pipeline.stale_after * NS_PER_S))
        self._step_times = StepTimes()
        self._open()
        self.destroy_timer(self._diagnostic_timer)
        self._diagnostic_timer = self._make_diagnostic_timer()
        return super().on_configure(state)

    @guarded
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to process inputs."""
        self.watchdog.restart()
        self._watchdog_timer = self.create_timer(_FIRST_WATCH_S, self._watch, clock=self._steady)
        result = super().on_activate(state)
        self._listening = result == _SUCCESS
        self.get_logger().info(f'active: {self.algorithm} on {self.resolve_topic_name(self.job.topic.name)}')
        return result

    # Resources

    def _preload_train_file(self) -> None:
        """Show the values of the train file from the start; an unusable file is only logged until configure."""
        try:
            self._load_train_file()
        except InputError as error:
            self.get_logger().error(str(error))

    def _load_train_file(self) -> TrainFile | None:
        path = str(self.parameters.value('train_file'))
        if not path:
            return None
        train_file = load_train_file(Path(path).expanduser())
        self.parameters.fall_back({item.name: item.of(train_file) for item in TRAIN_PARAMETERS}, path)
        return train_file

    def _train_file(self) -> TrainFile:
        base = self._load_train_file()
        return build_train_file(self.parameters.values(), frozenset(self.parameters.given), base)

    def _open(self) -> None:
        job = self.job
        self._estimates = self._offer(job.topic.name, estimate_qos())
        if job.topic.last_valid:
            self._last_valid = self._offer(job.topic.last_valid, latched_qos())
        alignment = self._settings.alignment
        longest = {
            SPEED_TOPIC: alignment.max_dt,
            FORCE_TOPIC: alignment.max_gap,
            GRADIENT_TOPIC: alignment.max_gap,
            BRAKE_TOPIC: alignment.command_timeout,
        }
        for topic in INPUT_TOPICS:
            longest_s, optional = longest.get(topic, 0.0), topic not in longest
            self._monitors[topic] = InputMonitor(topic, longest_s, alignment.max_interval, optional=optional)
        self._input_group = self._inputs.join(self)
        back = Duration(nanoseconds=-round(alignment.max_jump_back * NS_PER_S))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=False)
        # The clock drops callbacks whose handle is not kept.
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._note_jump)

    def _offer(self, topic: str, profile: Any) -> Any:
        return self.create_lifecycle_publisher(
            self._message,
            topic,
            profile,
            event_callbacks=publisher_events(self.get_logger(), topic),
            qos_overriding_options=overridable(),
        )

    def _pause(self) -> None:
        self._listening = False
        if self.pipeline is not None:
            self.pipeline.forget_records()
        if self._watchdog_timer is not None:
            self.destroy_timer(self._watchdog_timer)
            self._watchdog_timer = None

    def _release(self) -> None:
        self._pause()
        self._inputs.leave(self)
        for publisher in (self._estimates, self._last_valid):
            if publisher is not None:
                self.destroy_lifecycle_publisher(publisher)
        if self._jump_handle is not None:
            self._jump_handle.unregister()
        self._monitors = {}
        self._input_group = self._estimates = self._last_valid = self._jump_handle = self._prior = None
        self._forget()

    def _forget(self) -> None:
        self.pipeline = None
        self.watchdog = Watchdog(0)
        self._step_times = StepTimes()
        self._jumped_s = 0.0
        self._listening = False

    # Data

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _steady_ns(self) -> int:
        return int(self._steady.now().nanoseconds)

    def running_pipeline(self) -> EstimatorPipeline[Any] | None:
        """Return the pipeline if it takes in records now, after following a jump of the clock."""
        pipeline = self.pipeline
        if not self._listening or pipeline is None:
            return None
        self._follow_jump(pipeline)
        return pipeline

    def step(
        self, pipeline: EstimatorPipeline[Any], record: Record, events: dict[SampleStream, list[StreamEvent]]
    ) -> list[Any]:
        """Pass a record to the pipeline; return the outputs of the samples it completes.

        An error of the estimator becomes a FAULT and does not end the process.

        Args:
            pipeline: The pipeline of this node.
            record: The record.
            events: What the streams made of the record; that of the pipeline is added if it is missing.

        """
        resets, start = pipeline.resets, time.perf_counter()
        outputs: list[Any] = []
        try:
            if pipeline.stream not in events:
                events[pipeline.stream] = pipeline.stream.push(record)
            pipeline.take(events[pipeline.stream], outputs.append)
        except TrainIdError as error:
            outputs = [self.fail(pipeline, str(error))]
        except NUMERICAL_ERRORS:
            outputs = [self.fail(pipeline, traceback.format_exc())]
        if outputs:
            self._step_times.add(time.perf_counter() - start)
        if pipeline.resets != resets:
            self.get_logger().warning('stamps jumped back: estimator reset (time_jump_policy)')
        return outputs

    def publish(self, outputs: Iterable[Any]) -> None:
        """Publish outputs of the pipeline."""
        for output in outputs:
            self._publish(output)

    def count(self, topic: InputTopic, stamp_ns: int) -> None:
        """Note that a message with this stamp [ns] has arrived."""
        now_ns = self._now_ns()
        self._monitors[topic].arrived(stamp_ns, now_ns)
        if self._listening and self.pipeline is not None:
            self.watchdog.saw(self.pipeline.newest_ns, now_ns, self._steady_ns())

    def fail(self, pipeline: EstimatorPipeline[Any], reason: str) -> Any:
        """Put the pipeline into FAULT and return its output; log the reason once."""
        if pipeline.status is not Status.FAULT:
            self.get_logger().error(f'{self.algorithm} cannot continue until it is reset: {reason}')
        return pipeline.fail()

    def _publish(self, output: Any) -> None:
        message = fill_estimate(self._message(), output)
        self._estimates.publish(message)
        if self._last_valid is not None and message.status == int(Status.VALID):
            self._last_valid.publish(message)

    def _watch(self) -> None:
        pipeline, inputs = self.pipeline, self._input_group
        if pipeline is None or inputs is None:
            return
        inputs.drain()
        self._follow_jump(pipeline)
        # Even the fastest topic is not overdue before its own timeout.
        self.watchdog.limit_ns = min(pipeline.timeout_ns(topic) for topic in range(len(REQUIRED_TOPICS)))
        if self.watchdog.is_missing(self._now_ns(), self._steady_ns()) and pipeline.status not in _ALREADY_REPORTED:
            self._publish(pipeline.mark_stale())
        simulated = self.get_clock().ros_time_is_active
        self._watchdog_timer.timer_period_ns = self.watchdog.pause_ns(self._steady_ns(), simulated=simulated)
        self._watchdog_timer.reset()

    # Time

    def _note_jump(self, jump: Any) -> None:
        # Called while the clock is being set; the jump is handled once the clock has its new time.
        self._jumped_s = jump.delta.nanoseconds / NS_PER_S

    def _follow_jump(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Reset after a backward jump of the clock, unless the stamps have shown it already."""
        if self._jumped_s == 0.0:
            return
        jumped_s, self._jumped_s = self._jumped_s, 0.0
        policy = self._settings.pipeline.time_jump_policy
        limit_ns = round(self._settings.alignment.max_jump_back * NS_PER_S)
        follow = policy is TimeJumpPolicy.RESET and pipeline.newest_ns - self._now_ns() > limit_ns
        if follow:
            pipeline.reset()
        self.watchdog.restart()
        done = 'estimator reset' if follow else 'estimator continues'
        self.get_logger().warning(f'clock jumped by {jumped_s:.3f} s: {done} (time_jump_policy {policy.value})')

    # Diagnostics

    def publish_diagnostics(self) -> None:
        """Publish the status of the estimator and of its inputs."""
        now_ns = self._now_ns()
        health = NodeHealth(
            self.get_fully_qualified_name().strip('/'), self.state, self.failure, now_ns, self._clock_problem(now_ns)
        )
        array = DiagnosticArray()
        array.header.stamp = time_message(now_ns)
        if self.pipeline is None:
            array.status = [idle_status(health)]
        else:
            steps = self._step_times.summary()
            details = self.spec.details(self._prior, self.pipeline.current().estimate)
            array.status = [estimator_status(health, self.pipeline, self.spec.shown, self._prior, steps, details)]
            for monitor in self._monitors.values():
                topic = self.resolve_topic_name(monitor.topic.name)
                stale_s = (
                    0.0 if monitor.optional else self.pipeline.timeout_ns(INPUT_TOPICS.index(monitor.topic)) / NS_PER_S
                )
                array.status.append(input_status(health, monitor, topic, self.count_publishers(topic), stale_s))
        self._diagnostics.publish(array)

    def _clock_problem(self, now_ns: int) -> str:
        """Return what is wrong with simulated time, empty if nothing; called once per diagnostic period."""
        before, self._diagnosed_ns = self._diagnosed_ns, now_ns
        if not self.get_clock().ros_time_is_active:
            return ''
        if now_ns == 0:
            return 'use_sim_time is set, but no /clock has arrived'
        return '/clock has stopped' if now_ns == before else ''
