# SPDX-License-Identifier: Apache-2.0
"""Play one bag through the live nodes: three estimators and a player, each a process, and a listener here."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Self

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from trainid_ros.bag.reader import BagReader, require_topics
from trainid_ros.demo.comparison import Fingerprint, fingerprint_of_message
from trainid_ros.demo.processes import Child, ProcessGroup
from trainid_ros.demo.view import Snapshot, View
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, OUTPUT_TOPICS, OutputTopic
from trainid_ros.interface.results import Estimate, Output, Reason, Status
from trainid_ros.recording import Recorder
from trainid_ros.ros.jobs import JOBS
from trainid_ros.ros.topics import message_class

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path
    from types import TracebackType

    from trainid_ros.bag.bag_replay import AnyOutput
    from trainid_ros.demo.bags import DemoBag

KINDS: Final = {job.node_name: job.topic.estimate for job in JOBS}
"""Class of the estimate by node, in starting order."""
_START_S: Final = 60.0
_QUIET_S: Final = 1.5
_DRAIN_S: Final = 120.0
_POLL_S: Final = 0.05
_END_S: Final = 2.0
# More than the messages in any demo bag: a node that falls behind catches up at the end and loses none.
_DEPTH: Final = 40000
_LOSSLESS: Final = {'history': 'keep_last', 'depth': _DEPTH, 'reliability': 'reliable'}
_REJECTED: Final = 'rejected.'


@dataclass(frozen=True, slots=True)
class LiveRun:
    """Result of the live run of a bag."""

    # Those of all messages received, by class of the estimate, in order of arrival
    fingerprints: dict[type, list[Fingerprint]]
    newest: dict[type, AnyOutput]  # Last output of each estimator
    rejections: dict[type, dict[Reason, int]]  # Rejected samples by reason, from the last diagnostics
    recorder: Recorder  # What recorded the estimates; the inputs are recorded later
    wall_s: float  # Time from the first to the last message [s]


def run_live(bag: DemoBag, rate: float, duration_s: float, folder: Path, view: View) -> LiveRun:
    """Play a bag to nodes in separate processes and collect what they publish.

    Args:
        bag: The bag.
        rate: Recorded seconds per second [1].
        duration_s: Length of the bag to play [s], 0 for all.
        folder: Where logs and parameters go; it must exist.
        view: Display of the progress.

    Raises:
        InputError: The bag cannot be played.
        NoAnswerError: A process failed; the message gives the end of its log.
    """
    start_ns, length_s = _extent(bag)
    length_s = min(length_s, duration_s) if duration_s > 0.0 else length_s
    snapshot = Snapshot(bag.title, rate, start_ns, length_s, bag.truth)
    parameters = folder / 'parameters.yaml'
    parameters.write_text(parameter_file(), encoding='utf-8')
    with ProcessGroup(folder) as group:
        for name in KINDS:
            arguments = ['run', '--node', name, '--train', str(bag.train_path)]
            group.start(name, [*arguments, '--ros-args', '--params-file', str(parameters.absolute())])
        with Listener() as listener:
            session = _Session(group, listener, snapshot, view)
            session.wait_for_nodes()
            limit = ['--duration', repr(duration_s)] if duration_s > 0.0 else []
            play = ['play', str(bag.path), '--rate', repr(rate), '--wait', str(len(KINDS)), *limit]
            # Without /clock: the nodes work by stamps, and simulated time would cost as much as the inputs.
            no_clock = ['--ros-args', '-p', 'publish_clock:=false']
            session.follow(group.start('bag_player', [*play, *no_clock]))
            if killed := group.stop():
                raise NoAnswerError(
                    f'{", ".join(child.name for child in killed)} did not stop on SIGTERM and was killed'
                )
            return session.result()


def _extent(bag: DemoBag) -> tuple[int, float]:
    with BagReader(bag.path) as reader:
        require_topics(reader)
        span = reader.time_range()
    if span is None:
        raise InputError(f'{bag.path}: no messages')
    return span[0], (span[1] - span[0]) / NS_PER_S


class _Session:
    """Polling loop of the listener during one live run."""

    def __init__(self, group: ProcessGroup, listener: Listener, snapshot: Snapshot, view: View) -> None:
        self._group = group
        self._listener = listener
        self._snapshot = snapshot
        self._view = view
        self._recorder = Recorder()
        self._fingerprints: dict[type, list[Fingerprint]] = {kind: [] for kind in KINDS.values()}
        self._first_s = self._last_s = 0.0

    def wait_for_nodes(self) -> None:
        """Wait until all nodes publish their estimates."""
        deadline = time.monotonic() + _START_S
        while not self._listener.has_all_publishers():
            self._check(self._group.ended())
            if time.monotonic() > deadline:
                raise NoAnswerError(f'the nodes did not start within {_START_S:g} s')
            time.sleep(_POLL_S)

    def follow(self, player: Child) -> None:
        """Collect estimates until the player has ended and nothing more arrives."""
        while player.process.poll() is None:
            self._pause(lambda: player.process.poll() is not None)
            self._check(child for child in self._group.ended() if child is not player)
        if player.process.returncode != 0:
            self._check((player,))
        deadline = time.monotonic() + _DRAIN_S
        quiet_end = time.monotonic() + _QUIET_S
        while time.monotonic() < min(quiet_end, deadline):
            if self._pause(lambda: False):
                quiet_end = time.monotonic() + _QUIET_S

    def result(self) -> LiveRun:
        """Return the result of the run."""
        snapshot = self._snapshot
        wall_s = self._last_s - self._first_s
        return LiveRun(self._fingerprints, snapshot.newest, snapshot.rejections, self._recorder, wall_s)

    def _pause(self, is_over: Callable[[], bool]) -> int:
        """Collect what has arrived, show it, and wait briefly unless ``is_over``."""
        received = []
        for item in self._listener.take():
            kind = type(item.output.estimate)
            self._fingerprints[kind].append(item.fingerprint)
            if not self._is_outside_the_bag(item.output):
                received.append(item)
                self._snapshot.newest[kind] = item.output
                self._recorder.on_output(item.output)
        if received:
            self._last_s = time.monotonic()
            self._first_s = self._first_s or self._last_s
        self._snapshot.received += len(received)
        self._snapshot.rejections = {KINDS[node]: counts for node, counts in self._listener.rejections.items()}
        self._view.show(self._snapshot)
        if not is_over():
            time.sleep(_POLL_S)
        return len(received)

    def _is_outside_the_bag(self, output: AnyOutput) -> bool:
        """Return True for a STALE message that only reports that nothing is played yet, or no longer."""
        before = self._snapshot.newest.get(type(output.estimate))
        repeats = before is not None and before.stamp_ns == output.stamp_ns
        end_ns = self._snapshot.start_ns + round((self._snapshot.duration_s - _END_S) * NS_PER_S)
        ended = repeats and output.stamp_ns > end_ns
        return output.status is Status.STALE and (output.stamp_ns == 0 or ended)

    @staticmethod
    def _check(ended: Iterable[Child]) -> None:
        """Raise NoAnswerError for a child that should not have ended."""
        for child in ended:
            code = child.process.returncode
            raise NoAnswerError(f'{child.name} ended with exit code {code} ({child.log}: {child.log_tail()})')


def parameter_file() -> str:
    """Return a ROS parameter file with QoS overrides: no message may be lost at any playback rate."""
    return yaml.safe_dump({job.node_name: {'ros__parameters': _overrides(job.topic)} for job in JOBS})


def _overrides(output: OutputTopic) -> dict[str, Any]:
    topics: dict[str, Any] = {f'/{topic.name}': {'subscription': dict(_LOSSLESS)} for topic in INPUT_TOPICS}
    topics[f'/{output.name}'] = {'publisher': dict(_LOSSLESS)}
    return {'qos_overrides': topics}


@dataclass(frozen=True, slots=True)
class Received:
    """A received message as an output, with its fingerprint."""

    output: AnyOutput
    fingerprint: Fingerprint


class Listener:
    """A node in the place of an ATO controller, polled for what has arrived; use as a context manager."""

    def __init__(self) -> None:
        self.rejections: dict[str, dict[Reason, int]] = {}
        self._context = rclpy.Context()
        self._node: Any = None
        self._estimates: dict[type[Estimate], Any] = {}
        self._diagnostics: Any = None
        self._names = {topic.estimate: tuple(item.name for item in fields(topic.estimate)) for topic in OUTPUT_TOPICS}

    def __enter__(self) -> Self:
        """Subscribe."""
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('ato_controller', context=self._context)
        qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        for topic in OUTPUT_TOPICS:
            subscription = self._node.create_subscription(message_class(topic), topic.name, _ignore, qos)
            self._estimates[topic.estimate] = subscription
        self._diagnostics = self._node.create_subscription(DiagnosticArray, '/diagnostics', _ignore, qos)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        if self._node is not None:
            self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def has_all_publishers(self) -> bool:
        """Return True once every estimate has a publisher."""
        return all(self._node.count_publishers(topic.name) for topic in OUTPUT_TOPICS)

    def take(self) -> list[Received]:
        """Return the estimates that arrived since the last call, by topic; keep the newest diagnostics."""
        for message in _waiting(self._diagnostics):
            self._note(message)
        return [
            self._received(kind, message)
            for kind, subscription in self._estimates.items()
            for message in _waiting(subscription)
        ]

    def _received(self, kind: type[Estimate], message: Any) -> Received:
        stamp = message.header.stamp
        stamp_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
        names = self._names[kind]
        estimate: Any = kind(**{name: _plain(getattr(message, name)) for name in names})
        output: AnyOutput = Output(
            stamp_ns=stamp_ns,
            estimate=estimate,
            status=Status(message.status),
            used=int(message.used),
            rejected=int(message.rejected),
            last_rejection=None,
        )
        return Received(output, fingerprint_of_message(message, stamp_ns, names))

    def _note(self, array: Any) -> None:
        for status in array.status:
            node, _, what = status.name.partition(': ')
            if what == 'estimator':
                pairs = ((item.key, item.value) for item in status.values)
                self.rejections[node] = {
                    Reason[key.removeprefix(_REJECTED)]: int(value) for key, value in pairs if key.startswith(_REJECTED)
                }


def _ignore(_message: Any) -> None:
    """Placeholder callback: messages are polled, which costs far less than a wait set for each."""


def _waiting(subscription: Any) -> list[Any]:
    messages = []
    with subscription.handle:
        while (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
            messages.append(taken[0])
    return messages


def _plain(value: Any) -> Any:
    return tuple(map(float, value)) if hasattr(value, '__len__') else value
