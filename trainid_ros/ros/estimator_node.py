# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node around any estimator; it converts messages and computes nothing itself.

Estimates are published from the callback of the message that completes their sample; timers only detect
missing input. They run on a steady clock, which a stopped ``/clock`` cannot stall.
"""

from __future__ import annotations

import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.serialization import serialize_message

from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, REQUIRED_TOPICS
from trainid_ros.interface.results import Rejection, Status
from trainid_ros.ros.checkpoints import Checkpoints
from trainid_ros.ros.diagnostics import EstimatorSpec, StepTimes
from trainid_ros.ros.diagnostics_publisher import DiagnosticsPublisher
from trainid_ros.ros.estimate_publisher import EstimatePublisher
from trainid_ros.ros.foreign_topics import required_inputs
from trainid_ros.ros.input_monitor import InputMonitors
from trainid_ros.ros.inputs import InputGroup, SharedInputs
from trainid_ros.ros.node import ManagedNode, NodeParameters, guarded
from trainid_ros.ros.node_mapping import NodeMapping
from trainid_ros.ros.services import NUMERICAL_ERRORS, EstimatorServices
from trainid_ros.ros.status_changes import HEARTBEAT_NS, REPEATED, StatusChanges
from trainid_ros.ros.topics import SerializedEstimate, fill_estimate, message_class
from trainid_ros.ros.watchdog import Watchdog
from trainid_ros.setup.parameter_specs import (
    ALGORITHM,
    TRAIN_PARAMETERS,
    ParameterSpec,
    build_settings,
    build_train_file,
    estimator_parameters,
    qos_overrides,
    requested_algorithm,
)
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.stream.sample_stream import LARGEST_STEP_S, TimeJumpPolicy
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from trainid_ros.estimators.pipeline_group import SharedRecord
    from trainid_ros.ros.foreign_topics import AnyTopic
    from trainid_ros.train.train_file import TrainFile

_FIRST_WATCH_S: Final = 0.1
_SHORTEST_WATCH_NS: Final = NS_PER_S // 100
_SUCCESS: Final = TransitionCallbackReturn.SUCCESS


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
        self.mapping = NodeMapping(self)
        expected = qos_overrides(self.job.topic, self.resolve_topic_name, self.mapping.topics)
        self.parameters = NodeParameters(self, self._parameter_specs(), expected=expected)
        self.parameters.check_sections(arguments, self.job.node_name)
        self._preload_train_file()
        self.parameters.report()
        self.parameters.on_live_change = self._retune
        self.checkpoints = Checkpoints(self)
        self.pipeline: EstimatorPipeline[Any] | None = None
        self._settings = EstimatorSettings()
        self.prior: Any = None
        self._input_group: InputGroup | None = None
        self.monitors = InputMonitors(self._settings.alignment)
        self.status_changes = StatusChanges(self.get_logger(), self.missing_inputs)
        self._publisher: EstimatePublisher | None = None
        self._jump_handle: Any = None
        self._watchdog_timer: Any = None
        self._forget()
        self._diagnostics = DiagnosticsPublisher(self)
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

    def about(self) -> str:
        """Return what the node does, for the log."""
        return f'{self.algorithm} on {self.resolve_topic_name(self.job.topic.name)}'

    def _make_diagnostic_timer(self) -> Any:
        period = float(self.parameters.value('diagnostic_period'))
        return self.create_timer(period, self._diagnostics.publish, clock=self._steady)

    # Transitions

    @guarded
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the pipeline from the parameters; subscribe."""
        self.failure = ''
        self.parameters.check()
        train_file = self._train_file()
        settings = build_settings(self.parameters.values(), self.job.algorithms, self.job.field)
        self._settings = self.mapping.configure(train_file, settings)
        pipeline = self.job.pipeline(train_file, self._settings)
        self.prior = pipeline.current().estimate
        self.checkpoints.open(pipeline, train_file, self._settings)
        self.pipeline = pipeline
        self.watchdog = Watchdog(round(self._settings.pipeline.stale_after * NS_PER_S))
        self.step_times = StepTimes()
        self.status_changes.restart(self.now_ns())
        self._open()
        return super().on_configure(state)

    @guarded
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to process inputs."""
        self.watchdog.restart()
        self._watchdog_timer = self.create_timer(_FIRST_WATCH_S, self._watch, clock=self._steady)
        result = super().on_activate(state)
        self._listening = result == _SUCCESS
        self.checkpoints.resume()
        self.latch_loaded()
        return result

    def _retune(self, names: Collection[str]) -> None:
        """Apply changes of parameters that take effect at once."""
        if 'diagnostic_period' in names:
            self.destroy_timer(self._diagnostic_timer)
            self._diagnostic_timer = self._make_diagnostic_timer()
        if 'checkpoint_period' in names and self._listening:
            self.checkpoints.resume()
        if 'stale_after' in names and self.pipeline is not None:
            self.pipeline.set_stale_after(float(self.parameters.value('stale_after')))

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
        self._publisher = EstimatePublisher(self, self.job.topic, self.status_changes)
        alignment = self._settings.alignment
        self._input_group = self._inputs.join(self)
        self.monitors = InputMonitors(alignment, self._input_group.topics)
        back = Duration(nanoseconds=-round(alignment.max_jump_back * NS_PER_S))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=False)
        # The clock drops callbacks whose handle is not kept.
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._note_jump)

    def _pause(self) -> None:
        self.checkpoints.pause(self.pipeline, running=self._listening)
        self._listening = False
        if self.pipeline is not None:
            self.pipeline.interrupt()
        if self._watchdog_timer is not None:
            self.destroy_timer(self._watchdog_timer)
            self._watchdog_timer = None

    def _release(self) -> None:
        self.checkpoints.close(self.pipeline, running=self._listening)
        self._pause()
        self._inputs.leave(self)
        if self._publisher is not None:
            self._publisher.close()
        if self._jump_handle is not None:
            self._jump_handle.unregister()
        self._input_group = self._publisher = self._jump_handle = self.prior = None
        self._forget()

    def _forget(self) -> None:
        self.pipeline = None
        self.watchdog = Watchdog(0)
        self.step_times = StepTimes()
        self.fault = ''
        self._rejected: list[Rejection] = []
        self._jumped_s = 0.0
        self._listening = False

    # Data

    def now_ns(self) -> int:
        """Return the time of the node's clock [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def running_pipeline(self) -> EstimatorPipeline[Any] | None:
        """Return the pipeline if it takes in records now, after following a jump of the clock."""
        pipeline = self.pipeline
        if not self._listening or pipeline is None:
            return None
        self._follow_jump(pipeline)
        return pipeline

    def step(self, pipeline: EstimatorPipeline[Any], record: SharedRecord) -> list[Any]:
        """Pass a record to the pipeline of this node; return the outputs of the samples it completes.

        An error of the estimator becomes a FAULT and does not end the process.
        """
        resets, start = pipeline.resets, time.perf_counter()
        outputs: list[Any] = []
        try:
            events = record.events(pipeline.stream)
            self._rejected += [event for event in events if isinstance(event, Rejection)]
            pipeline.take(events, outputs.append)
        except TrainIdError as error:
            outputs = [self.fail(pipeline, str(error))]
        except NUMERICAL_ERRORS:
            outputs = [self.fail(pipeline, traceback.format_exc())]
        if outputs:
            self.step_times.add(time.perf_counter() - start)
        if pipeline.resets != resets:
            self.checkpoints.note_wiped()
            self.get_logger().warning('stamps jumped back: estimator reset (time_jump_policy)')
        return outputs

    def serialize(self, output: Any) -> SerializedEstimate:
        """Return an output of the pipeline as a message that is ready to be sent."""
        message = fill_estimate(self._message(), output)
        return SerializedEstimate(Status(message.status), serialize_message(message))

    def publish(self, estimates: Sequence[SerializedEstimate]) -> None:
        """Publish estimates; the rest that follows from them is done by :meth:`conclude`."""
        self.publisher.publish(estimates)

    def announce(self, output: Any) -> None:
        """Publish an output that no message has caused."""
        self.publish([self.serialize(output)])
        self.publisher.conclude(self.now_ns())

    def latch_loaded(self) -> None:
        """Latch the estimate of a loaded state, for which late subscribers would else wait until the next sample."""
        if self.pipeline is None or not self.pipeline.samples:
            return
        self.watchdog.saw(self.pipeline.newest_ns, self.now_ns(), self.steady_ns())
        self.publisher.latch_loaded(self.serialize(self.pipeline.current()))

    def conclude(self, topic: AnyTopic, stamp_ns: int) -> None:
        """Latch and log what was published, and note that a message with this stamp [ns] has arrived."""
        now_ns = self.now_ns()
        self.publisher.conclude(now_ns)
        self.monitors.arrived(topic, stamp_ns, now_ns, self._rejected)
        self._rejected = []
        if self._listening and self.pipeline is not None:
            self.watchdog.saw(self.pipeline.newest_ns, now_ns, self.steady_ns())

    def fail(self, pipeline: EstimatorPipeline[Any], reason: str) -> Any:
        """Put the pipeline into FAULT and return its output; log the reason once."""
        if pipeline.status is not Status.FAULT:
            self.fault = reason.strip().splitlines()[-1]
            self.get_logger().error(f'{self.algorithm} cannot continue until it is reset: {reason}')
        return pipeline.fail()

    def _watch(self) -> None:
        pipeline, inputs = self.pipeline, self._input_group
        if pipeline is None or inputs is None:
            return
        inputs.drain()
        self._follow_jump(pipeline)
        # Even the fastest topic is not overdue before its own timeout.
        self.watchdog.limit_ns = min(pipeline.timeout_ns(topic) for topic in range(len(REQUIRED_TOPICS)))
        steady_ns = self.steady_ns()
        if self.watchdog.is_missing(self.now_ns(), steady_ns) and pipeline.status not in REPEATED:
            self.announce(pipeline.mark_stale())
        elif pipeline.status in REPEATED and steady_ns - self.publisher.published_ns >= HEARTBEAT_NS:
            self.announce(pipeline.current())
        self._watchdog_timer.timer_period_ns = self._next_watch_ns(pipeline.status)
        self._watchdog_timer.reset()

    def _next_watch_ns(self, status: Status) -> int:
        """Return how long to wait before watching again [ns]."""
        steady_ns, simulated = self.steady_ns(), self.get_clock().ros_time_is_active
        waited_ns = steady_ns - self.publisher.published_ns if status in REPEATED else 0
        heartbeat_ns = max(HEARTBEAT_NS - waited_ns, _SHORTEST_WATCH_NS)
        return min(self.watchdog.pause_ns(steady_ns, simulated=simulated), heartbeat_ns)

    def timeout_s(self, topic: AnyTopic) -> float:
        """Return how long a topic may be missing [s]; 0 for one that need not come."""
        required = required_inputs(topic)
        if self.pipeline is None or not required:
            return 0.0
        return min(self.pipeline.timeout_ns(INPUT_TOPICS.index(item)) for item in required) / NS_PER_S

    def missing_inputs(self) -> str:
        """Return which inputs do not arrive and for how long, '' if all do."""
        found = [self.monitors.describe_missing(self.now_ns(), self.timeout_s)]
        if self._input_group is not None:
            found.append(self._input_group.lacking)
        return ', '.join(text for text in found if text)

    @property
    def inputs(self) -> InputGroup:
        """The subscriptions of a configured node."""
        assert self._input_group is not None
        return self._input_group

    @property
    def publisher(self) -> EstimatePublisher:
        """The publishers of a configured node."""
        assert self._publisher is not None
        return self._publisher

    # Time

    def _note_jump(self, jump: Any) -> None:
        # Called while the clock is being set; the jump is handled once the clock has its new time.
        self._jumped_s = jump.delta.nanoseconds / NS_PER_S

    def _follow_jump(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Reset after a backward jump of the clock, unless the stamps have shown it already."""
        if self._jumped_s == 0.0:
            return
        jumped_s, self._jumped_s = self._jumped_s, 0.0
        self.status_changes.forget_time()
        policy = self._settings.pipeline.time_jump_policy
        limit_ns = round(LARGEST_STEP_S * NS_PER_S)
        follow = policy is TimeJumpPolicy.RESET and pipeline.newest_ns - self.now_ns() > limit_ns
        if follow:
            pipeline.reset()
            self.checkpoints.note_wiped()
        self.watchdog.restart()
        done = 'estimator reset' if follow else 'estimator continues'
        self.get_logger().warning(f'clock jumped by {jumped_s:.3f} s: {done} (time_jump_policy {policy.value})')
