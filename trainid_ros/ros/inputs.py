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
from dataclasses import dataclass, replace
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
from trainid_ros.setup.parameter_specs import MAPPING_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.node import Node

    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.inputs.mapped_inputs import MappedInputs
    from trainid_ros.inputs.mapping import Mapping
    from trainid_ros.interface.records import Record
    from trainid_ros.ros.node import ManagedNode
    from trainid_ros.ros.topics import SerializedEstimate
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
# Quantities that may be published once and then hold.
_HELD: Final = frozenset({'gradient', 'brake_command', 'mass'})
# Time without a message after which the next type of a topic is tried [ns].
_PATIENCE_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ForeignTopic:
    """A topic that a mapping names."""

    name: str  # Its name, as in the mapping
    quantities: tuple[str, ...]  # What is read from it

    @property
    def label(self) -> str:
        """Its name with what is read from it, for people."""
        return f'{self.name} ({", ".join(self.quantities)})'

    @property
    def may_be_held(self) -> bool:
        """True if its messages may be rare, so that none must be lost and a late subscriber wants the last one."""
        return _HELD.issuperset(self.quantities)


AnyTopic: TypeAlias = InputTopic | ForeignTopic


def label_of(topic: AnyTopic) -> str:
    """Return the name of a topic for people."""
    return topic.label if isinstance(topic, ForeignTopic) else topic.name


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
    """Return a profile compatible with all publishers.

    It is reliable, or transient local, only if all of them offer it and the topic may be held.

    Args:
        topic: The topic.
        offered: Profiles of its publishers.
    """
    profile = input_qos()
    if topic.may_be_held and all(item.reliability == ReliabilityPolicy.RELIABLE for item in offered):
        profile.reliability = ReliabilityPolicy.RELIABLE
        if all(item.durability == DurabilityPolicy.TRANSIENT_LOCAL for item in offered):
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


class ForeignSubscription:
    """The subscription to one foreign topic, made again when its publishers have another type.

    Attributes:
        topic: The topic.
        current: The subscription, None before there is a publisher whose messages can be read.
        type: Name of the type subscribed to, '' without one.
        problem: Why messages cannot be read, '' if they can.
    """

    def __init__(self, topic: ForeignTopic, open_: Callable[[Any, QoSProfile], Any], close: Callable[[Any], Any]):
        """Prepare.

        Args:
            topic: The topic.
            open_: Subscribes with a message class and a profile.
            close: Ends a subscription.
        """
        self.topic = topic
        self.current: Any = None
        self.type = ''
        self.problem = ''
        self._open, self._close = open_, close
        self._profile = input_qos()
        self._alive_ns = 0

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

    def follow(self, publishers: Sequence[Any], steady_ns: int) -> bool:
        """Subscribe as the publishers in the graph want it; return True if that is new.

        A publisher that was killed is in the graph for a while, so a type with which no messages come is left.

        Args:
            publishers: What ``get_publishers_info_by_topic`` returns.
            steady_ns: Time of a steady clock [ns].
        """
        types = list(dict.fromkeys(info.topic_type for info in publishers))
        if not types:
            return False
        kind = self.type if self.type in types else types[0]
        if len(types) > 1 and kind == self.type and steady_ns - self._alive_ns > _PATIENCE_NS:
            kind = types[(types.index(kind) + 1) % len(types)]
        profile = foreign_qos(self.topic, [info.qos_profile for info in publishers if info.topic_type == kind])
        if kind == self.type and profile == self._profile:
            return False
        return self._subscribe(kind, profile, steady_ns)

    def _subscribe(self, kind: str, profile: QoSProfile, steady_ns: int) -> bool:
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
    """

    def __init__(self, node: Node) -> None:
        """Read the file, if the node is given one."""
        self._node = node
        self._make: Callable[[], MappedInputs] | None = None
        self._mapping = OWN
        self.topics: tuple[str, ...] = ()
        given = node._parameter_overrides.get(MAPPING_FILE.name)  # rclpy gives no public access to them
        if given is not None and isinstance(given.value, str) and given.value:
            with suppress(InputError):
                self.topics = load_mapping(Path(given.value).expanduser()).topics

    def configure(self, train_file: TrainFile, settings: EstimatorSettings) -> EstimatorSettings:
        """Read the file again; return settings that fit it.

        Raises:
            InputError: The file cannot be used.
        """
        path = str(self._node.get_parameter(MAPPING_FILE.name).value)
        self._make = mapped_inputs(Path(path).expanduser() if path else None, train_file)
        self._mapping = OWN if (inputs := self.inputs()) is None else inputs.mapping
        if inputs is None:
            return settings
        return replace(settings, alignment=inputs.mapping.alignment(settings.alignment))

    def named(self, text: str) -> str:
        """Return a text for people with the topics that are read in place of our own ones."""
        return self._mapping.named(text)

    def inputs(self) -> MappedInputs | None:
        """Return what makes records of the messages of foreign topics, None without a mapping."""
        return None if self._make is None else self._make()


# Number of rounds without a message from before the round, after which the wall clock must have been set back.
_MAX_IDLE_ROUNDS: Final = 3
# Number of messages that show whether two publishers alternate.
_MAX_NUMBERS: Final = 20
# Time between looks at the graph for publishers of foreign topics [s].
_DISCOVERY_S: Final = 0.25


class _Arrival(NamedTuple):
    """A message taken from a queue."""

    received_ns: int  # When the middleware received it, or when it was sent if that is not known [ns]
    number: int | None  # The count of its publisher, None if the middleware does not state it
    topic: AnyTopic  # The topic
    message: Any  # The message


def _arrival(topic: AnyTopic, message: Any, info: Any) -> _Arrival:
    received_ns = int(info['received_timestamp'] or info['source_timestamp'])
    return _Arrival(received_ns, info['publication_sequence_number'], topic, message)


class _Numbers:
    """The counts of the publishers of a topic: one that was started again counts from one, two alternate."""

    def __init__(self) -> None:
        self._last = 0
        self._steps_back: deque[bool] = deque(maxlen=_MAX_NUMBERS)

    def add(self, number: int | None) -> None:
        if number is not None:
            self._steps_back.append(number <= self._last)
            self._last = number

    @property
    def alternate(self) -> bool:
        """False if the last messages certainly came from one publisher at a time."""
        return not self._steps_back or sum(self._steps_back) > 1


class InputSubscriptions:
    """All input subscriptions of a node.

    An executor takes one message of each subscription in turn. After a stall, the queue of a slow topic is therefore
    emptied before that of a fast one: its stamps run ahead by as many periods, which an estimator takes for a time
    jump. So whenever a message arrives, all queued messages are taken and sorted by arrival.

    Args:
        node: The node.
        topics: The topics; a foreign one is subscribed as soon as its type is known.
        deliver: Called with topic, message and the time of its reception [ns], in order of arrival.
    """

    def __init__(
        self, node: ManagedNode, topics: Sequence[AnyTopic], deliver: Callable[[AnyTopic, Any, int], None]
    ) -> None:
        self._node = node
        self._deliver = deliver
        self._numbers = {topic: _Numbers() for topic in topics}
        self._own = {
            topic: self._subscribe(topic, message_class(topic), input_qos())
            for topic in topics
            if isinstance(topic, InputTopic)
        }
        self._foreign = {topic: self._prepare(topic) for topic in topics if isinstance(topic, ForeignTopic)}
        self._said: set[tuple[str, str]] = set()
        self._discovery: Any = None
        if self._foreign:
            self._discovery = node.create_timer(_DISCOVERY_S, self._discover, clock=node.steady_clock)
            self._discover()

    def _subscribe(self, topic: AnyTopic, kind: Any, profile: QoSProfile) -> Any:
        def receive(message: Any, info: Any) -> None:
            self.drain(_arrival(topic, message, info))

        # Overrides of foreign topics are only declared where they are given: each type has its own default.
        wanted = isinstance(topic, InputTopic) or self._is_overridden(topic.name)
        return self._node.create_subscription(
            kind,
            topic.name,
            receive,
            profile,
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
            qos_overriding_options=overridable('subscription') if wanted else None,
        )

    def _is_overridden(self, topic: str) -> bool:
        start = f'qos_overrides.{self._node.resolve_topic_name(topic)}.subscription.'
        return any(name.startswith(start) for name in self._node._parameter_overrides)

    def _prepare(self, topic: ForeignTopic) -> ForeignSubscription:
        return ForeignSubscription(topic, partial(self._subscribe, topic), self._node.destroy_subscription)

    def _discover(self) -> None:
        """Subscribe to the foreign topics as their publishers want it."""
        steady_ns = self._node.steady_ns()
        for topic, foreign in self._foreign.items():
            name = self._node.resolve_topic_name(topic.name)
            if not foreign.follow(self._node.get_publishers_info_by_topic(name), steady_ns):
                continue
            if (name, foreign.type) not in self._said and not foreign.problem:
                self._said.add((name, foreign.type))
                self._node.get_logger().info(f'{name}: read as {foreign.type}: {", ".join(topic.quantities)}')

    def _open(self) -> list[tuple[AnyTopic, Any]]:
        """Return the topics that are subscribed, each with its subscription."""
        foreign = ((topic, item.current) for topic, item in self._foreign.items() if item.current is not None)
        return [*self._own.items(), *foreign]

    def drain(self, *first: _Arrival) -> None:
        """Deliver the given messages and all queued ones.

        The queues are emptied in turn, so a message that arrives meanwhile on a later queue could overtake one on
        an earlier queue. Each round therefore delivers only messages that arrived before the round began; the
        others wait for the next round. Repeated rounds without such messages mean that the wall clock was set
        back: then all are delivered as they are.
        """
        arrivals = list(first)
        idle_rounds = 0
        while True:
            begin_ns = time.time_ns()
            arrivals += self._take()
            arrivals.sort(key=lambda arrival: arrival.received_ns)
            due = bisect_left(arrivals, begin_ns, key=lambda arrival: arrival.received_ns)
            idle_rounds = 0 if due else idle_rounds + 1
            if idle_rounds > _MAX_IDLE_ROUNDS:
                due = len(arrivals)
            for arrival in arrivals[:due]:
                self._numbers[arrival.topic].add(arrival.number)
                self._deliver(arrival.topic, arrival.message, arrival.received_ns)
            arrivals = arrivals[due:]
            if not arrivals:
                return

    def _take(self) -> list[_Arrival]:
        taken_now = []
        for topic, subscription in self._open():
            with subscription.handle:
                for _ in range(subscription.qos_profile.depth):
                    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                    if taken is None:
                        break
                    taken_now.append(_arrival(topic, *taken))
        return taken_now

    def profile(self, topic: AnyTopic) -> QoSProfile:
        """Return the quality of service of a topic, overrides of the user included."""
        profile: QoSProfile = (
            self._own[topic].qos_profile if isinstance(topic, InputTopic) else self._foreign[topic].profile
        )
        return profile

    def type(self, topic: AnyTopic) -> str:
        """Return the type with which a topic is subscribed, '' for a foreign one without publisher."""
        return type_name(message_class(topic)) if isinstance(topic, InputTopic) else self._foreign[topic].type

    def problem(self, topic: AnyTopic) -> Publishers | None:
        """Return why messages of a topic cannot be read and what to do, None if they can."""
        return None if isinstance(topic, InputTopic) else self._foreign[topic].unreadable()

    def note(self, topic: ForeignTopic, problem: str) -> None:
        """Note that a message came, and why it cannot be read, '' if it can."""
        self._foreign[topic].arrived(problem, self._node.steady_ns())

    def may_mix(self, topic: AnyTopic) -> bool:
        """Return False if the last messages of a topic certainly came from one publisher at a time."""
        return self._numbers[topic].alternate

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._own.values():
            self._node.destroy_subscription(subscription)
        for foreign in self._foreign.values():
            foreign.close()
        if self._discovery is not None:
            self._node.destroy_timer(self._discovery)
        self._own, self._foreign = {}, {}


class Saver(Protocol):
    """Saves the state of a node from time to time."""

    @property
    def is_due(self) -> bool:
        """Whether the period is over."""

    @property
    def saved_at(self) -> float:
        """When it last saved [s]."""

    def save_if_due(self) -> None:
        """Begin to save if the period is over."""


class Consumer(Protocol):
    """A node that takes in inputs."""

    @property
    def checkpoints(self) -> Saver:
        """Its checkpoints."""

    def running_pipeline(self) -> EstimatorPipeline[Any] | None:
        """Return the pipeline if it takes in records now."""

    def step(self, pipeline: EstimatorPipeline[Any], record: SharedRecord) -> list[SerializedEstimate]:
        """Pass a record to the pipeline; return the estimates of the samples it completes, ready to be sent."""

    def publish(self, estimates: Sequence[SerializedEstimate]) -> None:
        """Publish estimates."""

    def conclude(self, topic: AnyTopic, stamp_ns: int) -> None:
        """Do the rest, after a message with this stamp [ns] was taken in by all."""


class InputGroup:
    """Nodes that take in the same topics through one set of subscriptions.

    Args:
        node: The first node. It keeps the subscriptions until the last node has left.
        mapping: Where the inputs come from.

    Attributes:
        subscriber: Its name.
        topics: The topics, foreign ones of the mapping included.
        subscriptions: What is subscribed, and how.
        mapped: What makes records of the messages of foreign topics, None without a mapping.
    """

    def __init__(self, node: ManagedNode, mapping: NodeMapping) -> None:
        self._members: list[Consumer] = []
        self._node = node
        self.subscriber = str(node.get_name())
        self.mapped = mapping.inputs()
        self.topics = subscribed_topics(OWN if self.mapped is None else self.mapped.mapping)
        self.subscriptions = InputSubscriptions(self._node, self.topics, self.receive)

    def __contains__(self, node: Consumer) -> bool:
        return node in self._members

    @property
    def lacking(self) -> str:
        """Why an input that no topic carries is not there, '' if all are."""
        if self.mapped is None or not self.mapped.lacks_position:
            return ''
        return 'no gradient of the line, as the position is not known yet'

    def add(self, node: Consumer) -> None:
        """Let a node take in the inputs."""
        self._members.append(node)

    def remove(self, node: Consumer) -> bool:
        """Let a node leave; return True, and close the subscriptions, if it was the last one."""
        self._members.remove(node)
        if not self._members:
            self.subscriptions.close()
        return not self._members

    def drain(self) -> None:
        """Take in all queued messages."""
        self.subscriptions.drain()

    def receive(self, topic: AnyTopic, message: Any, received_ns: int = 0) -> None:
        """Take in one message: all estimators step, then all estimates are published, then the rest is done.

        Args:
            topic: Its topic.
            message: The message.
            received_ns: When it was received, by the clock of the machine [ns].
        """
        try:
            records, stamp_ns = self._read(topic, message, received_ns)
        except InputError as error:
            if isinstance(topic, ForeignTopic):
                self.subscriptions.note(topic, str(error))
            return
        if isinstance(topic, ForeignTopic) and self.mapped is not None:
            self.subscriptions.note(topic, self.mapped.problem(topic.name))
        running = [(node, pipeline) for node in self._members if (pipeline := node.running_pipeline()) is not None]
        if any(pipeline.stream.is_new for _, pipeline in running):
            share_streams(pipeline for _, pipeline in running)
        made: list[tuple[Consumer, list[SerializedEstimate]]] = [(node, []) for node, _ in running]
        for record in records:
            shared = SharedRecord(record.row())
            for (node, pipeline), (_, estimates) in zip(running, made, strict=True):
                estimates.extend(node.step(pipeline, shared))
        # Sent at once, so that a subscriber of all of them wakes up once.
        for node, estimates in made:
            node.publish(estimates)
        for node in self._members:
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
        group.add(consumer)
        return group

    def leave(self, node: Consumer) -> None:
        """Let a node leave its group, if it is in one."""
        for key, group in list(self._groups.items()):
            if node in group and group.remove(node):
                del self._groups[key]


def _wiring(node: ManagedNode, mapping: NodeMapping) -> object:
    """Return what subscriptions depend on: topic names, overrides of the quality of service, and the mapping."""
    mapped = mapping.inputs()
    topics = subscribed_topics(OWN if mapped is None else mapped.mapping)
    names = tuple(node.resolve_topic_name(topic.name) for topic in topics)
    overrides = node._parameter_overrides  # rclpy gives no public access to them
    given = (name for name in overrides if name.startswith('qos_overrides.') and '.subscription.' in name)
    qos = tuple(sorted((name, str(overrides[name].value)) for name in given))
    return node.context, names, qos, None if mapped is None else mapped.key
