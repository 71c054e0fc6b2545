# SPDX-License-Identifier: Apache-2.0
"""Inputs of the estimator nodes: subscriptions in order of arrival, shared by the nodes of a process.

Nodes whose topics have the same names and quality of service share one set of subscriptions, and their pipelines one
stream where it would give the same samples. One message then takes this way: all streams take it in, all estimators
step, all estimates are published, and only then is anything counted.

With a mapping, messages of other topics become records first, by the code that reads bags. Those topics are subscribed
with the type that their publishers have, whenever these come.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeAlias

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from trainid_ros.estimators.pipeline import SharedRecord, share_streams
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import OWN, Signal, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    INPUT_TOPICS,
    MASS_TOPIC,
    NS_PER_S,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
    InputTopic,
    record_from_message,
)
from trainid_ros.ros.topics import (
    NO_SUBSCRIPTION_EVENTS,
    Publishers,
    foreign_class,
    input_qos,
    message_class,
    overridable,
    type_name,
)
from trainid_ros.setup.params_file import MAPPING_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.interface.records import Record
    from trainid_ros.ros.node import ManagedNode
    from trainid_ros.ros.topics import SerializedEstimate
    from trainid_ros.setup.event_recorder import EventRecorder
    from trainid_ros.setup.pipelines import EstimatorSettings
    from trainid_ros.train.train_file import TrainFile

# Quantities that are read, and the input that needs each; positions may be missing at times.
_INPUTS: Final[dict[str, InputTopic | None]] = {
    'speed': SPEED_TOPIC,
    'position': None,
    'force': FORCE_TOPIC,
    'gradient': GRADIENT_TOPIC,
    'brake_command': BRAKE_TOPIC,
    'mass': MASS_TOPIC,
}


@dataclass(frozen=True, slots=True)
class ForeignTopic:
    """A topic that a mapping names."""

    name: str  # Its name, as in the mapping
    quantities: tuple[str, ...]  # What is read from it

    @property
    def may_be_held(self) -> bool:
        """True if its messages may be rare, so that none must be lost and a late subscriber wants the last one."""
        return {'gradient', 'brake_command', 'mass'}.issuperset(self.quantities)


AnyTopic: TypeAlias = InputTopic | ForeignTopic


def label_of(topic: AnyTopic) -> str:
    """Return the name of a topic for people, with what is read from a foreign one."""
    return f'{topic.name} ({", ".join(topic.quantities)})' if isinstance(topic, ForeignTopic) else topic.name


def required_inputs(topic: AnyTopic) -> tuple[InputTopic, ...]:
    """Return the inputs that are required and do not come without a topic."""
    inputs = [_INPUTS[name] for name in topic.quantities] if isinstance(topic, ForeignTopic) else [topic]
    return tuple(item for item in REQUIRED_TOPICS if item in inputs)


def subscribed_topics(mapping: Mapping = OWN) -> tuple[AnyTopic, ...]:
    """Return the topics that the nodes subscribe to: our own that the mapping does not replace, and its own."""
    found: dict[str, dict[str, None]] = {}
    for quantity in _INPUTS:
        signal = getattr(mapping, quantity)
        for source in signal.sources if isinstance(signal, Signal) else ():
            found.setdefault(source.topic, {})[quantity] = None
    own = (topic for topic in INPUT_TOPICS if topic.name not in mapping.replaced)
    return (*own, *(ForeignTopic(name, tuple(quantities)) for name, quantities in found.items()))


def foreign_qos(topic: ForeignTopic, offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return a profile compatible with those of all publishers.

    It is reliable, or transient local, only if all of them offer it and the topic may be held.
    """
    profile = input_qos()
    if topic.may_be_held and all(item.reliability == ReliabilityPolicy.RELIABLE for item in offered):
        profile.reliability = ReliabilityPolicy.RELIABLE
        if all(item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in offered):
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


@dataclass(eq=False)
class InputSubscription:
    """The subscription to one topic; that to a foreign one is made again when its publishers have another type."""

    topic: AnyTopic
    _open: Callable[[Any, QoSProfile], Any]  # Subscribes with a message class and a profile
    _close: Callable[[Any], Any]
    current: Any = None  # The subscription, None before there is a publisher whose messages can be read
    type: str = ''  # Name of the type subscribed to, '' without one
    problem: str = ''  # Why messages cannot be read, '' if they can
    _profile: QoSProfile = field(default_factory=input_qos)
    _alive_ns: int = 0
    _number: int = 0
    _steps_back: deque[bool] = field(default_factory=lambda: deque(maxlen=20))

    def __post_init__(self) -> None:
        """Subscribe; to a foreign topic as soon as its type is known."""
        if isinstance(self.topic, InputTopic):
            kind = message_class(self.topic)
            self.current, self.type = self._open(kind, input_qos()), type_name(kind)

    @property
    def profile(self) -> QoSProfile:
        """Its quality of service, overrides of the user included."""
        profile: QoSProfile = self._profile if self.current is None else self.current.qos_profile
        return profile

    def unreadable(self) -> Publishers | None:
        """Return why messages cannot be read and what to do, None if they can."""
        if not self.problem:
            return None
        remedy = 'install it' if self.current is None else 'correct the mapping file or this publisher'
        return Publishers((), (self.problem,), remedy)

    def arrived(self, problem: str, steady_ns: int) -> None:
        """Note that a message came, and why it cannot be read, by a steady clock [ns]."""
        self.problem, self._alive_ns = problem, steady_ns

    def count(self, number: int | None) -> None:
        """Note the count of its publisher in a message, None if the middleware does not state it."""
        if number is not None:
            self._steps_back.append(number <= self._number)
            self._number = number

    @property
    def may_mix(self) -> bool:
        """False if the last messages certainly came from one publisher at a time.

        A publisher that was started again counts from one; the counts of two alternate.
        """
        return not self._steps_back or sum(self._steps_back) > 1

    def follow(self, publishers: Sequence[Any], steady_ns: int) -> bool:
        """Subscribe to a foreign topic as its publishers in the graph want it; return True if that is new.

        A publisher that was killed is in the graph for a while, so a type with which no messages come is left.
        """
        types = list(dict.fromkeys(info.topic_type for info in publishers))
        if not types or isinstance(self.topic, InputTopic):
            return False
        kind = self.type if self.type in types else types[0]
        if len(types) > 1 and kind == self.type and steady_ns - self._alive_ns > NS_PER_S:
            kind = types[(types.index(kind) + 1) % len(types)]
        profile = foreign_qos(self.topic, [info.qos_profile for info in publishers if info.topic_type == kind])
        if kind == self.type and profile == self._profile:
            return False
        self.close()
        self.type, self._profile, self._alive_ns, self.problem = kind, profile, steady_ns, ''
        try:
            self.current = self._open(foreign_class(kind), copy(profile))  # which rclpy changes
        except InputError as error:
            self.problem = str(error)
        except Exception as error:  # whatever a package of others raises must not end the node; it is tried again
            self.type, self.problem = '', f'{kind}: cannot be subscribed ({error})'
        return True

    def close(self) -> None:
        """End the subscription."""
        if self.current is not None:
            self._close(self.current)
        self.current, self.type = None, ''


class NodeMapping:
    """Where the inputs of a node come from, if not from our own topics.

    Attributes:
        topics: Topics that the file names, known from the start as they have parameters; none if it cannot be used,
            which is said on configure.
        mapping: The mapping of a configured node.
    """

    def __init__(self, node: ManagedNode) -> None:
        """Read the file, if the node is given one."""
        self._node = node
        self._make: Callable[[], MappedInputs] | None = None
        self.mapping = OWN
        self.topics: tuple[str, ...] = ()
        path = node.overrides.get(MAPPING_FILE.name)
        if isinstance(path, str) and path:
            with suppress(InputError):
                self.topics = load_mapping(Path(path).expanduser()).topics

    def configure(self, train_file: TrainFile, settings: EstimatorSettings) -> EstimatorSettings:
        """Read the file again; return settings that fit it; InputError if it cannot be used."""
        path = str(self._node.get_parameter(MAPPING_FILE.name).value)
        self._make = mapped_inputs(Path(path).expanduser() if path else None, train_file)
        inputs = self.inputs()
        self.mapping = OWN if inputs is None else inputs.mapping
        if inputs is None:
            return settings
        return replace(settings, alignment=inputs.mapping.alignment(settings.alignment))

    def inputs(self) -> MappedInputs | None:
        """Return what makes records of the messages of foreign topics, None without a mapping."""
        return None if self._make is None else self._make()


class _Arrival(NamedTuple):
    received_ns: int  # When the middleware received it, or when it was sent if that is not known [ns]
    number: int | None  # The count of its publisher, None if the middleware does not state it
    topic: AnyTopic
    message: Any


def _arrival(topic: AnyTopic, message: Any, info: Any) -> _Arrival:
    received_ns = int(info['received_timestamp'] or info['source_timestamp'])
    return _Arrival(received_ns, info['publication_sequence_number'], topic, message)


class Consumer(Protocol):
    """A node that takes in inputs."""

    checkpoints: Any  # Its Checkpoints
    publisher: Any  # Its EstimatePublisher, while it is configured

    def running_pipeline(self) -> EstimatorPipeline[Any] | None:
        """Return the pipeline if it takes in records now."""

    def step(self, pipeline: EstimatorPipeline[Any], record: SharedRecord) -> list[SerializedEstimate]:
        """Pass a record to the pipeline; return the estimates of the samples it completes, ready to be sent."""

    def conclude(self, topic: AnyTopic, stamp_ns: int) -> None:
        """Do the rest, after a message with this stamp [ns] was taken in by all."""


class InputGroup:
    """Nodes that take in the same topics through one set of subscriptions, which the first of them keeps.

    An executor takes one message of each subscription in turn. After a stall, the queue of a slow topic is therefore
    emptied before that of a fast one: its stamps run ahead by as many periods, which an estimator takes for a time
    jump. So whenever a message arrives, all queued messages are taken and sorted by arrival.

    Attributes:
        members: The nodes.
        subscriber: Name of the first node.
        subscriptions: The subscriptions by topic; a foreign one is made as soon as its type is known.
        recorder: Keeps the last inputs for recordings, None without any.
        logged: Publishers of each topic that the log has named, once for all nodes.
        mapped: What makes records of the messages of foreign topics, None without a mapping.
    """

    def __init__(self, node: ManagedNode, mapping: NodeMapping) -> None:
        self.members: list[Consumer] = []
        self._node = node
        self.subscriber = str(node.get_name())
        self.mapped = mapping.inputs()
        self.subscriptions = {
            topic: InputSubscription(topic, partial(self._subscribe, topic), node.destroy_subscription)
            for topic in subscribed_topics(mapping.mapping)
        }
        self.recorder: EventRecorder | None = None
        self.logged: dict[AnyTopic, Publishers] = {}
        self._said: set[tuple[str, str]] = set()
        self._discovery: Any = None
        if any(isinstance(topic, ForeignTopic) for topic in self.subscriptions):
            self._discovery = node.create_timer(0.25, self._discover, clock=node.steady_clock)
            self._discover()

    @property
    def lacking(self) -> str:
        """Why an input that no topic carries is not there, '' if all are."""
        if self.mapped is None or not self.mapped.lacks_position:
            return ''
        return 'no gradient of the line, as the position is not known yet'

    def remove(self, node: Consumer) -> bool:
        """Let a node leave; return True, and destroy the subscriptions, if it was the last one."""
        self.members.remove(node)
        if self.members:
            return False
        for subscription in self.subscriptions.values():
            subscription.close()
        if self._discovery is not None:
            self._node.destroy_timer(self._discovery)
        return True

    # Subscriptions

    def _subscribe(self, topic: AnyTopic, kind: Any, profile: QoSProfile) -> Any:
        def receive(message: Any, info: Any) -> None:
            self.drain(_arrival(topic, message, info))

        # Overrides of foreign topics are only declared where they are given: each type has its own default.
        start = f'qos_overrides.{self._node.resolve_topic_name(topic.name)}.subscription.'
        wanted = isinstance(topic, InputTopic) or any(name.startswith(start) for name in self._node.overrides)
        return self._node.create_subscription(
            kind,
            topic.name,
            receive,
            profile,
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
            qos_overriding_options=overridable('subscription') if wanted else None,
        )

    def _discover(self) -> None:
        steady_ns = self._node.steady_ns()
        for topic, subscription in self.subscriptions.items():
            if not isinstance(topic, ForeignTopic):
                continue
            name = self._node.resolve_topic_name(topic.name)
            if not subscription.follow(self._node.get_publishers_info_by_topic(name), steady_ns):
                continue
            if (name, subscription.type) not in self._said and not subscription.problem:
                self._said.add((name, subscription.type))
                self._node.get_logger().info(f'{name}: read as {subscription.type}: {", ".join(topic.quantities)}')

    # Messages

    def drain(self, *first: _Arrival) -> None:
        """Take in the given messages and all queued ones.

        The queues are emptied in turn, so a message that arrives meanwhile on a later queue could overtake one on
        an earlier queue. Each round therefore takes in only messages that arrived before the round began; the
        others wait for the next round. Repeated rounds without such messages mean that the wall clock was set
        back: then all are taken in as they are.
        """
        arrivals = list(first)
        idle_rounds = 0
        while True:
            begin_ns = time.time_ns()
            arrivals += self._queued()
            arrivals.sort(key=lambda arrival: arrival.received_ns)
            due = bisect_left(arrivals, begin_ns, key=lambda arrival: arrival.received_ns)
            idle_rounds = 0 if due else idle_rounds + 1
            if idle_rounds > 3:
                due = len(arrivals)
            for arrival in arrivals[:due]:
                self.subscriptions[arrival.topic].count(arrival.number)
                self.receive(arrival.topic, arrival.message, arrival.received_ns)
            arrivals = arrivals[due:]
            if not arrivals:
                return

    def _queued(self) -> list[_Arrival]:
        queued = []
        for topic, item in self.subscriptions.items():
            if (subscription := item.current) is None:
                continue
            with subscription.handle:
                for _ in range(subscription.qos_profile.depth):
                    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                    if taken is None:
                        break
                    queued.append(_arrival(topic, *taken))
        return queued

    def receive(self, topic: AnyTopic, message: Any, received_ns: int = 0) -> None:
        """Take in one message: all estimators step, then all estimates are published, then the rest is done.

        The clock of the machine says when it was received [ns].
        """
        try:
            records, stamp_ns = self._read(topic, message, received_ns)
        except InputError as error:
            if isinstance(topic, ForeignTopic):
                self.subscriptions[topic].arrived(str(error), self._node.steady_ns())
            return
        if isinstance(topic, ForeignTopic) and self.mapped is not None:
            self.subscriptions[topic].arrived(self.mapped.problem(topic.name), self._node.steady_ns())
        running = [(node, pipeline) for node in self.members if (pipeline := node.running_pipeline()) is not None]
        if any(pipeline.stream.is_new for _, pipeline in running):
            share_streams(pipeline for _, pipeline in running)
        made: list[tuple[Consumer, list[SerializedEstimate]]] = [(node, []) for node, _ in running]
        for record in records:
            shared = SharedRecord(row := record.row())
            if self.recorder is not None:
                self.recorder.take(row)
            for (node, pipeline), (_, estimates) in zip(running, made, strict=True):
                estimates.extend(node.step(pipeline, shared))
        # Sent at once, so that a subscriber of all of them wakes up once.
        for node, estimates in made:
            node.publisher.publish(estimates)
        for node in self.members:
            node.conclude(topic, stamp_ns)
        # One of them at a time: the next message may come soon.
        if due := [node.checkpoints for node, estimates in made if estimates and node.checkpoints.is_due]:
            min(due, key=lambda checkpoints: checkpoints.saved_at).save_if_due()

    def _read(self, topic: AnyTopic, message: Any, received_ns: int) -> tuple[list[Record], int]:
        """Return the records that a message gives, and its stamp [ns]."""
        mapped = self.mapped
        if isinstance(topic, InputTopic):
            record = record_from_message(topic, message)
            return [record] if mapped is None else mapped.take_record(record), record.stamp_ns
        assert mapped is not None
        # The clock of the machine says when it was received, and simulated time what time it was then.
        now_ns = self._node.now_ns() if self._node.get_clock().ros_time_is_active else received_ns
        return mapped.take(topic.name, message, now_ns), mapped.stamp_ns(topic.name, message, now_ns)


class SharedInputs:
    """The groups of nodes in a process; nodes with other topic names or quality of service form other groups."""

    def __init__(self) -> None:
        self._groups: dict[object, InputGroup] = {}

    def join(self, consumer: Consumer, node: ManagedNode, mapping: NodeMapping) -> InputGroup:
        """Return the group of a node, which takes in the inputs from now on."""
        key = _wiring(node, mapping)
        group = self._groups.get(key) or InputGroup(node, mapping)
        self._groups[key] = group
        group.members.append(consumer)
        return group

    def leave(self, node: Consumer) -> None:
        """Let a node leave its group, if it is in one."""
        for key, group in list(self._groups.items()):
            if node in group.members and group.remove(node):
                del self._groups[key]


def _wiring(node: ManagedNode, mapping: NodeMapping) -> object:
    """Return what subscriptions depend on: topic names, overrides of the quality of service, and the mapping."""
    mapped = mapping.inputs()
    names = tuple(node.resolve_topic_name(topic.name) for topic in subscribed_topics(mapping.mapping))
    overrides = node.overrides
    given = (name for name in overrides if name.startswith('qos_overrides.') and '.subscription.' in name)
    qos = tuple(sorted((name, str(overrides[name])) for name in given))
    return node.context, names, qos, None if mapped is None else mapped.key
