# SPDX-License-Identifier: Apache-2.0
"""Inputs of the estimator nodes: subscriptions in order of arrival, shared by the nodes of a process.

Nodes whose topics have the same names and quality of service share one set of subscriptions, and their pipelines one
stream where it would give the same samples. One message then takes this way: all streams take it in, all estimators
step, all estimates are published, and only then is anything counted.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.estimators.pipeline import SharedRecord, share_streams
from trainid_ros.messages import record_from_message
from trainid_ros.records import INPUT_TOPICS, InputTopic
from trainid_ros.ros.topics import NO_SUBSCRIPTION_EVENTS, input_qos, message_class, overridable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node
    from rclpy.qos import QoSProfile

    from trainid_ros.ros.estimator_node import EstimatorNode

_MAX_IDLE_ROUNDS: Final = 3
_NUMBERS_KEPT: Final = 20


class _Arrival(NamedTuple):
    """A message taken from a queue.

    Attributes:
        received_ns: When the middleware received it, or when it was sent if that is not known [ns].
        number: The count of its publisher, None if the middleware does not state it.
        topic: The topic.
        message: The message.

    """

    received_ns: int
    number: int | None
    topic: InputTopic
    message: Any


def _arrival(topic: InputTopic, message: Any, info: Any) -> _Arrival:
    received_ns = int(info['received_timestamp'] or info['source_timestamp'])
    return _Arrival(received_ns, info['publication_sequence_number'], topic, message)


class _Numbers:
    """The counts of the publishers of a topic: one that was started again counts from one, two alternate."""

    def __init__(self) -> None:
        self._last = 0
        self._steps_back: deque[bool] = deque(maxlen=_NUMBERS_KEPT)

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
        deliver: Called with topic and message, in order of arrival.

    """

    def __init__(self, node: Node, deliver: Callable[[InputTopic, Any], None]) -> None:
        self._node = node
        self._deliver = deliver
        self._numbers = {topic: _Numbers() for topic in INPUT_TOPICS}
        self._subscriptions = {topic: self._subscribe(topic) for topic in INPUT_TOPICS}

    def _subscribe(self, topic: InputTopic) -> Any:
        def receive(message: Any, info: Any) -> None:
            self.drain(_arrival(topic, message, info))

        return self._node.create_subscription(
            message_class(topic),
            topic.name,
            receive,
            input_qos(),
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
            qos_overriding_options=overridable('subscription'),
        )

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
                self._deliver(arrival.topic, arrival.message)
            arrivals = arrivals[due:]
            if not arrivals:
                return

    def _take(self) -> list[_Arrival]:
        taken_now = []
        for topic, subscription in self._subscriptions.items():
            with subscription.handle:
                for _ in range(subscription.qos_profile.depth):
                    taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                    if taken is None:
                        break
                    taken_now.append(_arrival(topic, *taken))
        return taken_now

    def profile(self, topic: InputTopic) -> QoSProfile:
        """Return the quality of service of a topic, overrides of the user included."""
        profile: QoSProfile = self._subscriptions[topic].qos_profile
        return profile

    def may_mix(self, topic: InputTopic) -> bool:
        """Return False if the last messages of a topic certainly came from one publisher at a time."""
        return self._numbers[topic].alternate

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions = {}


class InputGroup:
    """Nodes that take in the same topics through one set of subscriptions.

    Args:
        node: The first node. It keeps the subscriptions until the last node has left.

    Attributes:
        subscriber: Its name.

    """

    def __init__(self, node: EstimatorNode) -> None:
        self._members: list[EstimatorNode] = []
        self.subscriber = str(node.get_name())
        self._subscriptions = InputSubscriptions(node, self.receive)

    def __contains__(self, node: EstimatorNode) -> bool:
        return node in self._members

    def add(self, node: EstimatorNode) -> None:
        """Let a node take in the inputs."""
        self._members.append(node)

    def remove(self, node: EstimatorNode) -> bool:
        """Let a node leave; return True, and close the subscriptions, if it was the last one."""
        self._members.remove(node)
        if not self._members:
            self._subscriptions.close()
        return not self._members

    def drain(self) -> None:
        """Take in all queued messages."""
        self._subscriptions.drain()

    def profile(self, topic: InputTopic) -> QoSProfile:
        """Return the quality of service with which a topic is subscribed."""
        return self._subscriptions.profile(topic)

    def may_mix(self, topic: InputTopic) -> bool:
        """Return False if the last messages of a topic certainly came from one publisher at a time."""
        return self._subscriptions.may_mix(topic)

    def receive(self, topic: InputTopic, message: Any) -> None:
        """Take in one message: all estimators step, then all estimates are published, then the rest is done."""
        record = record_from_message(topic, message)
        running = [(node, pipeline) for node in self._members if (pipeline := node.running_pipeline()) is not None]
        if any(pipeline.stream.is_new for _, pipeline in running):
            share_streams(pipeline for _, pipeline in running)
        shared = SharedRecord(record.row())
        outputs = [(node, node.step(pipeline, shared)) for node, pipeline in running]
        # Sent at once, so that a subscriber of all of them wakes up once.
        ready = [(node, [node.serialize(output) for output in made]) for node, made in outputs if made]
        for node, estimates in ready:
            node.publish(estimates)
        for node in self._members:
            node.conclude(topic, record.stamp_ns)
        # One of them at a time: the next message may come soon.
        if due := [node.checkpoints for node, _ in ready if node.checkpoints.is_due]:
            min(due, key=lambda checkpoints: checkpoints.saved_at).save_if_due()


class SharedInputs:
    """The groups of nodes in a process; nodes with other topic names or quality of service form other groups."""

    def __init__(self) -> None:
        self._groups: dict[object, InputGroup] = {}

    def join(self, node: EstimatorNode) -> InputGroup:
        """Return the group of a node, which takes in the inputs from now on."""
        key = _wiring(node)
        if key not in self._groups:
            self._groups[key] = InputGroup(node)
        self._groups[key].add(node)
        return self._groups[key]

    def leave(self, node: EstimatorNode) -> None:
        """Let a node leave its group, if it is in one."""
        for key, group in list(self._groups.items()):
            if node in group and group.remove(node):
                del self._groups[key]


def _wiring(node: EstimatorNode) -> object:
    """Return what subscriptions depend on: resolved topic names, and overrides of the quality of service."""
    topics = tuple(node.resolve_topic_name(topic.name) for topic in INPUT_TOPICS)
    overrides = node._parameter_overrides  # rclpy gives no public access to them
    qos = tuple(sorted((name, str(overrides[name].value)) for name in overrides if _is_qos(name)))
    return node.context, topics, qos


def _is_qos(parameter: str) -> bool:
    return parameter.startswith('qos_overrides.') and '.subscription.' in parameter
