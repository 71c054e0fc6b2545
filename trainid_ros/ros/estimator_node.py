# SPDX-License-Identifier: Apache-2.0
"""The three estimator nodes and their programs; a node converts messages and computes nothing itself.

Estimates are published from the callback of the message that completes their sample; timers only detect
missing input. They run on a steady clock, which a stopped ``/clock`` cannot stall. Some estimates are also latched,
logged, or repeated without new input.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from trainid_ros.bag import missing_package_error
from trainid_ros.estimators.pipeline import EstimatorPipeline, SharedRecord
from trainid_ros.interface.errors import InputError, TrainIdError
from trainid_ros.interface.records import NS_PER_S, REQUIRED_TOPICS, output_topic
from trainid_ros.interface.results import Rejection, ResistanceEstimate, SpeedModelEstimate, Status, parameters
from trainid_ros.resistance.davis_posterior import observe
from trainid_ros.ros.checkpoints import Checkpoints
from trainid_ros.ros.diagnostics import (
    NUMERICAL_ERRORS,
    DiagnosticsPublisher,
    EstimatorSpec,
    InputMonitors,
    NodeContext,
    StepTimes,
)
from trainid_ros.ros.inputs import AnyTopic, NodeMapping, SharedInputs
from trainid_ros.ros.node import ManagedNode, NodeParameters, guarded, run_node
from trainid_ros.ros.topics import (
    SerializedEstimate,
    estimate_message,
    latched_qos,
    message_class,
    offered_estimate_qos,
    overridable,
    publisher_events,
)
from trainid_ros.setup.event_recorder import EventRecorder
from trainid_ros.setup.params_file import (
    ALGORITHM,
    build_settings,
    build_train_file,
    estimator_parameters,
    filed_values,
    qos_overrides,
    requested_algorithm,
)
from trainid_ros.setup.pipelines import (
    BRAKE_RATE_KIND,
    RESISTANCE_KIND,
    SPEED_MODEL_KIND,
    EstimatorSettings,
    force_findings,
)
from trainid_ros.stream.sample_stream import MAX_STEP_S, TimeJumpPolicy
from trainid_ros.train.train_file import TrainFile, dump_train_file, load_train_file

# Statuses that are published again without new samples, after this time [ns]: in time for the deadline of 1 s.
REPEATED: Final = frozenset({Status.STALE, Status.FAULT})
HEARTBEAT_NS: Final = NS_PER_S * 8 // 10
_NOT_FIT: Final = frozenset({Status.CONVERGING, *REPEATED})
_JUMPS_LOGGED_EVERY_S: Final = 10.0
"""Least time between log lines on jumps of the clock [s], of which two players make 40 a second."""


def is_latched(status: Status, latched: Status | None) -> bool:
    """Return whether an estimate goes to the ``last_valid`` topic, after one of the status ``latched``, None before.

    VALID estimates do. Once there was one, so does the first that withdraws it (CONVERGING: a change or contradiction
    is suspected) or does not keep it up any more (STALE, FAULT), and the first that holds again.
    """
    if status is Status.VALID:
        return True
    if latched is None:
        return False
    return status is not latched if status in _NOT_FIT else status is Status.HOLDING and latched in _NOT_FIT


class StatusChanges:
    """Follows the status of the published estimates: since when it holds, and one log line for each change."""

    def __init__(self, context: NodeContext) -> None:
        self._context, self._logger = context, context.node.get_logger()
        self._status = Status.UNINITIALIZED
        self._had_inputs = False

    def follow(self, status: Status, now_ns: int) -> None:
        """Take in the status of a published estimate, at a time of the node's clock [ns]."""
        if status is self._status:
            return
        before, self._status = self._status, status
        if not (
            before.is_usable and status.is_usable
        ):  # VALID and HOLDING count as one: they take turns at every brake
            self._log(before, now_ns)
            self._context.since_ns = now_ns
        self._had_inputs |= status is not Status.STALE

    def _log(self, before: Status, now_ns: int) -> None:
        # Each line at most once a second.
        name, logger = self._status.name, self._logger
        if self._status is Status.STALE:
            why = self._context.missing_inputs() or 'stamps of an input are behind those of the others'
            kept = '' if before is Status.UNINITIALIZED else ', the last estimate stands'
            logger.warning(f'STALE{kept}: {why}', throttle_duration_sec=1.0)
        elif before is Status.STALE:
            text = 'inputs are back' if self._had_inputs else 'inputs have come'
            if self._had_inputs and 0 < self._context.since_ns <= now_ns:
                text += f', {(now_ns - self._context.since_ns) / NS_PER_S:.1f} s after STALE'
            logger.info(f'{name}: {text}', throttle_duration_sec=1.0)
        elif self._status.is_usable:
            logger.info(f'{name}: the estimate is fit to use', throttle_duration_sec=1.0)
        elif before.is_usable and self._status is not Status.FAULT:
            logger.warning(f'{name}: the estimate is not fit to use any more', throttle_duration_sec=1.0)
        elif before is Status.FAULT:
            logger.info(f'{name}: the estimator works again', throttle_duration_sec=1.0)


@dataclass(eq=False)
class Watchdog:
    """Finds whether no new input has arrived for too long."""

    limit_ns: int  # How long inputs may be missing [ns]
    _clock: tuple[int, int] = (0, 0)
    _seen: tuple[int, int] | None = None
    _newest_ns: int = 0

    def restart(self) -> None:
        """Begin to wait for input with the next check."""
        self._seen, self._newest_ns = None, 0

    def saw(self, newest_ns: int, now_ns: int, steady_ns: int) -> None:
        """Record the newest stamp so far [ns]; only a changed stamp counts as new input."""
        if newest_ns not in (0, self._newest_ns):
            self._seen, self._newest_ns = (now_ns, steady_ns), newest_ns

    def is_missing(self, now_ns: int, steady_ns: int) -> bool:
        """Return whether inputs have been missing for too long.

        The node's clock [ns] may be simulated, stop or jump; the steady one does none of this.
        """
        if now_ns != self._clock[0]:
            self._clock = (now_ns, steady_ns)
        if self._seen is None:
            self._seen = (now_ns, steady_ns)
        missing_for, missing_for_steady = now_ns - self._seen[0], steady_ns - self._seen[1]
        stopped = steady_ns - self._clock[1] > self.limit_ns
        # At high replay rates a short stall of the machine is long in simulated time, but is not a dropout.
        return (missing_for > self.limit_ns and missing_for_steady > min(self.limit_ns, NS_PER_S // 4)) or (
            stopped and missing_for_steady > self.limit_ns
        )

    def pause_ns(self, steady_ns: int, *, simulated: bool) -> int:
        """Return how long to wait with the next check, by the steady clock [ns]: until the limit can be exceeded."""
        if simulated:  # at any rate, so it has to be polled often
            return NS_PER_S // 10
        waited = 0 if self._seen is None else steady_ns - self._seen[1]
        margin = NS_PER_S // 100  # by which a timer may fire early
        return (self.limit_ns - waited if waited <= self.limit_ns else self.limit_ns) + margin


class EstimatePublisher:
    """The publishers of a configured node.

    Attributes:
        live: Publishes every estimate.
        adhesion: Publishes the adhesion, None where another node does.
        last_valid: Publishes latched ones, None where nothing is latched.
        latched: Status of the estimate that is latched, None before the first.
        published_ns: Steady time of the last estimate [ns], 0 before the first.
    """

    def __init__(self, context: NodeContext) -> None:
        self._node, self._changes = context.node, StatusChanges(context)
        context.since_ns = self._node.now_ns()
        topic = self._topic = context.kind.topic
        kind = message_class(topic)
        self.live = self._offer(kind, topic.name, offered_estimate_qos())
        also, self.adhesion = context.kind.adhesion, None
        if also is not None:
            self.adhesion = self._offer(message_class(also), also.name, offered_estimate_qos())
        self.last_valid = self._offer(kind, topic.last_valid, latched_qos()) if topic.last_valid else None
        self.latched: Status | None = None
        self.published_ns = 0
        self._sent: list[SerializedEstimate] = []

    def _offer(self, kind: Any, topic: str, profile: Any) -> Any:
        return self._node.create_lifecycle_publisher(
            kind,
            topic,
            profile,
            event_callbacks=publisher_events(self._node.get_logger(), topic),
            qos_overriding_options=overridable('publisher'),
        )

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in (self.live, self.adhesion, self.last_valid):
            if publisher is not None:
                self._node.destroy_lifecycle_publisher(publisher)

    def publish(self, estimates: Sequence[SerializedEstimate]) -> None:
        """Publish estimates; what follows from them is done by :meth:`conclude`, after those of other nodes."""
        for estimate in estimates:
            if estimate.topic is self._topic:
                self.live.publish(estimate.data)
                self._sent.append(estimate)
            elif self.adhesion is not None:
                self.adhesion.publish(estimate.data)

    def conclude(self, now_ns: int) -> None:
        """Latch and log what was published, at a time of the node's clock [ns]."""
        if not self._sent:
            return
        sent, self._sent = self._sent, []
        for estimate in sent:
            if is_latched(estimate.status, self.latched):
                self._latch(estimate)
            self._changes.follow(estimate.status, now_ns)
        self.published_ns = self._node.steady_ns()

    def latch_loaded(self, estimate: SerializedEstimate) -> None:
        """Latch the estimate of a loaded state, if it is worth it."""
        if estimate.status.is_usable or estimate.status is Status.STALE:
            self._latch(estimate)

    def _latch(self, estimate: SerializedEstimate) -> None:
        if self.last_valid is not None:
            self.last_valid.publish(estimate.data)
            self.latched = estimate.status


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
        super().__init__(spec.kind.node_name, **options)
        self._inputs = inputs or SharedInputs()
        mapping = NodeMapping(self)
        specs = estimator_parameters(spec.kind.algorithms, requested_algorithm(self.overrides, spec.kind.algorithms))
        expected = qos_overrides(self.resolve_topic_name, mapping.topics)
        parameters = NodeParameters(self, specs, arguments, expected)
        self._settings = EstimatorSettings()
        self.shared = NodeContext(self, spec.kind, parameters, mapping, InputMonitors(self._settings.alignment))
        try:  # to show the values of the train file from the start; an unusable one is only logged until configure
            self._load_train_file()
        except InputError as error:
            self.get_logger().error(str(error))
        parameters.report()
        parameters.on_live_change = self._retune
        self.checkpoints = Checkpoints(self.shared)
        self._publisher: EstimatePublisher | None = None
        self._jump_handle: Any = None
        self._watchdog_timer: Any = None
        self._forget()
        self._diagnostics = DiagnosticsPublisher(self.shared, spec)
        self._diagnostic_timer = self._make_diagnostic_timer()
        services = {
            'reset': self.reset_on_request,
            'save_checkpoint': self.save_on_request,
            'load_checkpoint': self.load_on_request,
            'save_recording': self.record_on_request,
        }
        for name, serve in services.items():
            self.create_service(Trigger, f'~/{name}', partial(self._answer, serve))

    @property
    def pipeline(self) -> EstimatorPipeline[Any] | None:
        """The pipeline of a configured node, else None."""
        return self.shared.pipeline

    @property
    def algorithm(self) -> str:
        """Name of the running algorithm."""
        return str(self.shared.parameters.value(ALGORITHM))

    def about(self) -> str:
        """Return what the node does, for the log."""
        given = f'; {self.shared.parameters.given_values}' if self.state == 'activating' else ''
        return f'{self.algorithm} on {self.resolve_topic_name(self.shared.kind.topic.name)}{given}'

    def _make_diagnostic_timer(self) -> Any:
        period = float(self.shared.parameters.value('diagnostic_period'))
        return self.create_timer(period, self._diagnostics.publish, clock=self.steady_clock)

    # Transitions

    @guarded
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the pipeline from the parameters; subscribe."""
        self.failure = ''
        parameters, kind = self.shared.parameters, self.shared.kind
        parameters.check()
        base = self._load_train_file()
        values = parameters.use()
        train_file = build_train_file(values, frozenset(parameters.given), base)
        settings = build_settings(values, kind.algorithms, kind.name)
        self._settings = self.shared.mapping.configure(train_file, settings)
        pipeline = kind.pipeline(train_file, self._settings)
        self.checkpoints.open(pipeline, train_file, self._settings)
        self.shared.pipeline = pipeline
        self.watchdog = Watchdog(round(self._settings.pipeline.stale_after * NS_PER_S))
        self.shared.step_times = StepTimes()
        self._open()
        self._open_recorder(train_file)
        return super().on_configure(state)

    @guarded
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to process inputs."""
        self.watchdog.restart()
        self._watchdog_timer = self.create_timer(0.1, self._watch, clock=self.steady_clock)  # then as it decides
        result = super().on_activate(state)
        self._listening = result == TransitionCallbackReturn.SUCCESS
        if self.shared.inputs is not None and self.shared.inputs.recorder is not None:
            self.shared.inputs.recorder.start_over()
        self.checkpoints.resume()
        self.latch_loaded()
        return result

    def _retune(self, names: Collection[str]) -> None:
        if 'diagnostic_period' in names:
            self.destroy_timer(self._diagnostic_timer)
            self._diagnostic_timer = self._make_diagnostic_timer()
        if 'checkpoint_period' in names and self._listening:
            self.checkpoints.resume()
        if 'stale_after' in names and self.shared.pipeline is not None:
            self.shared.pipeline.set_stale_after(float(self.shared.parameters.value('stale_after')))

    # Resources

    def _load_train_file(self) -> TrainFile | None:
        path = str(self.shared.parameters.value('train_file'))
        if not path:
            return None
        train_file = load_train_file(Path(path).expanduser())
        self.shared.parameters.fall_back(filed_values(train_file), path)
        return train_file

    def _open(self) -> None:
        self._publisher = EstimatePublisher(self.shared)
        alignment = self._settings.alignment
        self.shared.inputs = self._inputs.join(self, self, self.shared.mapping)
        self.shared.monitors = InputMonitors(alignment, self.shared.inputs.subscriptions)
        back = Duration(nanoseconds=-round(alignment.max_jump_back * NS_PER_S))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=False)
        # The clock drops callbacks whose handle is not kept.
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._note_jump)

    def _open_recorder(self, train_file: TrainFile) -> None:
        """Record the inputs if asked to, and the nodes that share them do not yet; InputError if that is impossible."""
        parameters, inputs, logger = self.shared.parameters, self.shared.inputs, self.get_logger()
        assert inputs is not None
        if (folder := str(parameters.value('record_folder'))) and inputs.recorder is None:
            try:  # what writes bags does not come from apt
                from trainid_ros.bag.writer import write_rows  # noqa: PLC0415
            except ModuleNotFoundError as error:
                raise missing_package_error(error) from None
            minutes = float(parameters.value('record_minutes'))
            path = Path(folder).expanduser()
            inputs.recorder = EventRecorder(path, minutes, write_rows, logger.info, logger.warning)
            # Once: that of a long line takes longer than there is between two messages.
            inputs.recorder.files['train.yaml'] = partial(str, dump_train_file(train_file))
        if inputs.recorder is not None:
            inputs.recorder.files[f'{self.get_name()}.json'] = self.checkpoints.text

    def _pause(self) -> None:
        self.checkpoints.pause(running=self._listening)
        if self.shared.inputs is not None and self.shared.inputs.recorder is not None:
            self.shared.inputs.recorder.flush()
        self._listening = False
        if self.shared.pipeline is not None:
            self.shared.pipeline.interrupt()
        if self._watchdog_timer is not None:
            self.destroy_timer(self._watchdog_timer)
            self._watchdog_timer = None

    def _release(self) -> None:
        self.checkpoints.close(running=self._listening)
        self._pause()
        self._inputs.leave(self)
        if self._publisher is not None:
            self._publisher.close()
        if self._jump_handle is not None:
            self._jump_handle.unregister()
        self._publisher = self._jump_handle = None
        self._forget()

    def _forget(self) -> None:
        self.shared.forget()
        self.watchdog = Watchdog(0)
        self._rejected: list[Rejection] = []
        self._jumped_s = 0.0
        self._listening = False

    # Data

    def running_pipeline(self) -> EstimatorPipeline[Any] | None:
        """Return the pipeline if it takes in records now, after following a jump of the clock."""
        pipeline = self.shared.pipeline
        if not self._listening or pipeline is None:
            return None
        self._follow_jump(pipeline)
        return pipeline

    def step(self, pipeline: EstimatorPipeline[Any], record: SharedRecord) -> list[SerializedEstimate]:
        """Pass a record to the pipeline of this node; return the estimates of the samples it completes.

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
            self.shared.step_times.add(time.perf_counter() - start)
        if pipeline.resets != resets:
            self.checkpoints.is_wiped = True
            self.get_logger().warning('stamps jumped back: estimator reset (time_jump_policy)')
        return [self.serialize(output) for output in outputs]

    def serialize(self, output: Any) -> SerializedEstimate:
        """Return an output of the pipeline as a message that is ready to be sent."""
        message = estimate_message(output)
        return SerializedEstimate(Status(message.status), serialize_message(message), output_topic(output.estimate))

    def announce(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Publish an output that no message has caused."""
        outputs: list[Any] = []
        pipeline.publish(outputs.append)
        self.publisher.publish([self.serialize(output) for output in outputs])
        self.publisher.conclude(self.now_ns())

    def latch_loaded(self) -> None:
        """Latch the estimate of a loaded state: late subscribers then have it before the next sample."""
        if self.shared.pipeline is None or not self.shared.pipeline.samples:
            return
        self.watchdog.saw(self.shared.pipeline.newest_ns, self.now_ns(), self.steady_ns())
        self.publisher.latch_loaded(self.serialize(self.shared.pipeline.current()))

    def conclude(self, topic: AnyTopic, stamp_ns: int) -> None:
        """Latch and log what was published, and note that a message with this stamp [ns] has arrived."""
        now_ns = self.now_ns()
        self.publisher.conclude(now_ns)
        self.shared.monitors.arrived(topic, stamp_ns, now_ns, self._rejected)
        self._rejected = []
        if self._listening and self.shared.pipeline is not None:
            self.watchdog.saw(self.shared.pipeline.newest_ns, now_ns, self.steady_ns())

    def fail(self, pipeline: EstimatorPipeline[Any], reason: str) -> Any:
        """Put the pipeline into FAULT and return its output; log the reason once."""
        if pipeline.status is not Status.FAULT:
            self.shared.fault = reason.strip().splitlines()[-1]
            self.get_logger().error(f'{self.algorithm} cannot continue until it is reset: {reason}')
        return pipeline.fail()

    def _watch(self) -> None:
        pipeline, inputs = self.shared.pipeline, self.shared.inputs
        if pipeline is None or inputs is None:
            return
        inputs.drain()
        self._follow_jump(pipeline)
        if inputs.recorder is not None:
            inputs.recorder.look(self.get_name(), pipeline)
        # Even the fastest topic is not overdue before its own timeout.
        self.watchdog.limit_ns = min(pipeline.timeout_ns(topic) for topic in range(len(REQUIRED_TOPICS)))
        steady_ns = self.steady_ns()
        if self.watchdog.is_missing(self.now_ns(), steady_ns) and pipeline.status not in REPEATED:
            pipeline.mark_stale()
            self.announce(pipeline)
        elif pipeline.status in REPEATED and steady_ns - self.publisher.published_ns >= HEARTBEAT_NS:
            self.announce(pipeline)
        steady_ns = self.steady_ns()
        waited_ns = steady_ns - self.publisher.published_ns if pipeline.status in REPEATED else 0
        pause_ns = self.watchdog.pause_ns(steady_ns, simulated=self.get_clock().ros_time_is_active)
        self._watchdog_timer.timer_period_ns = min(pause_ns, max(HEARTBEAT_NS - waited_ns, NS_PER_S // 100))
        self._watchdog_timer.reset()

    @property
    def publisher(self) -> EstimatePublisher:
        """The publishers of a configured node."""
        assert self._publisher is not None
        return self._publisher

    # Services, each of which responds in every lifecycle state

    def _answer(self, serve: Callable[[EstimatorPipeline[Any]], str], _request: Any, response: Any) -> Any:
        logger, pipeline = self.get_logger(), self.shared.pipeline
        if pipeline is None:
            response.success, response.message = False, f'{self.get_name()} is {self.state}: configure it first'
            return response
        try:
            response.success, response.message = True, serve(pipeline)
        except InputError as error:
            response.success, response.message = False, str(error)
        except NUMERICAL_ERRORS as error:
            self.fail(pipeline, traceback.format_exc())
            response.success, response.message = False, f'{type(error).__name__}: {error}'
        # Two calls: rclpy does not allow one line of code to log with different severities.
        if response.success:
            logger.info(response.message)
        else:
            logger.error(response.message)
        return response

    def reset_on_request(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Reset the estimator to the prior."""
        pipeline.reset()
        self.checkpoints.is_wiped = False
        self.watchdog.restart()
        if self.state != 'active':  # or else the next checkpoint comes soon
            self.checkpoints.save(pipeline)
        return f'reset to the prior; resets so far: {pipeline.resets}'

    def save_on_request(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Write the estimator's state to the checkpoint file."""
        return f'saved {self.algorithm} to {self.checkpoints.save_on_request(pipeline)}'

    def load_on_request(self, pipeline: EstimatorPipeline[Any]) -> str:
        """Load the estimator's state from the checkpoint file."""
        loaded = self.checkpoints.load_on_request(pipeline)
        self.latch_loaded()
        return f'loaded {self.algorithm} from {loaded}'

    def record_on_request(self, _pipeline: EstimatorPipeline[Any]) -> str:
        """Write the last inputs to a bag."""
        if self.shared.inputs is None or self.shared.inputs.recorder is None:
            raise InputError('nothing is recorded: start the node with the parameter record_folder')
        return self.shared.inputs.recorder.request(self.get_name())

    # Time

    def _note_jump(self, jump: Any) -> None:
        # Called while the clock is being set; the jump is handled once the clock has its new time.
        self._jumped_s = jump.delta.nanoseconds / NS_PER_S

    def _follow_jump(self, pipeline: EstimatorPipeline[Any]) -> None:
        """Reset after a backward jump of the clock, unless the stamps have shown it already."""
        if self._jumped_s == 0.0:
            return
        jumped_s, self._jumped_s = self._jumped_s, 0.0
        self.shared.since_ns = 0
        policy = self._settings.pipeline.time_jump_policy
        limit_ns = round(MAX_STEP_S * NS_PER_S)
        follow = policy is TimeJumpPolicy.RESET and pipeline.newest_ns - self.now_ns() > limit_ns
        if follow:
            pipeline.reset()
            self.checkpoints.is_wiped = True
        self.watchdog.restart()
        done = 'estimator reset' if follow else 'estimator continues'
        several = f'; {n} publishers of /clock: stop all but one' if (n := self.count_publishers('/clock')) > 1 else ''
        text = f'clock jumped by {jumped_s:.3f} s: {done} (time_jump_policy {policy.value}){several}'
        self.get_logger().warning(text, throttle_duration_sec=_JUMPS_LOGGED_EVERY_S)


def _details(prior: Any, live: Any) -> Iterator[tuple[str, str]]:
    yield 'findings', '; '.join(force_findings(live)) or 'none'
    yield 'force scale', f'{live.force_scale:.4f}'
    yield 'force scale std', f'{live.force_scale_std:.2g}'
    yield 'force delay [s]', f'{live.force_delay:.3f}'
    yield 'force delay std [s]', f'{live.force_delay_std:.2g}'
    seen = observe(live.covariance, prior.covariance, live.speed_min, live.speed_max)
    yield 'observability', seen.text
    for name, share in zip('abc', seen.shares, strict=True):
        yield f'{name} prior variance removed', f'{share:.3f}'
    yield 'resistance std at speeds seen, at most [N/kN]', f'{seen.std_observed:.3g}'
    yield 'resistance std at other speeds, at most [N/kN]', f'{seen.std_outside:.3g}'
    yield 'resistance known from [m/s]', f'{seen.known[0]:.1f}'
    yield 'resistance known to [m/s]', f'{seen.known[1]:.1f}'


RESISTANCE: Final = EstimatorSpec(RESISTANCE_KIND, ('resistance', *parameters(ResistanceEstimate)), _details)
SPEED_MODEL: Final = EstimatorSpec(
    SPEED_MODEL_KIND, ('prediction_error', *parameters(SpeedModelEstimate), 'a', 'b', 'c', 'mass_factor')
)
BRAKE_RATE: Final = EstimatorSpec(BRAKE_RATE_KIND, ('brake_rate', 'effective_particles'))
SPECS: Final = {spec.kind.node_name: spec for spec in (RESISTANCE, SPEED_MODEL, BRAKE_RATE)}
"""The nodes by name, in starting order."""


# The programs, each of which returns its exit code.
resistance_main, speed_model_main, brake_rate_main = (
    partial(run_node, partial(EstimatorNode, spec)) for spec in SPECS.values()
)
