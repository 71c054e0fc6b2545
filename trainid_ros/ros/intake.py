# SPDX-License-Identifier: Apache-2.0
"""Input subscriptions that deliver messages in order of arrival across all topics.

An executor takes one message of each subscription in turn. After a stall, the queue of a slow topic is
therefore emptied before that of a fast one: its stamps run ahead by as many periods, which an estimator takes
for a time jump. So whenever a message arrives, all queued messages are taken and sorted by arrival.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.records import INPUT_TOPICS, InputTopic
from trainid_ros.ros import qos
from trainid_ros.ros.conversion import message_class

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node


_MAX_IDLE_ROUNDS: Final = 3


class _Arrival(NamedTuple):
    """A message taken from a queue, with the time at which the middleware received it [ns]."""

    received_ns: int
    topic: InputTopic
    message: Any


class Intake:
    """All input subscriptions of a node.

    Args:
        node: The node.
        deliver: Called with topic and message, in order of arrival.

    """

    def __init__(self, node: Node, deliver: Callable[[InputTopic, Any], None]) -> None:
        self._node = node
        self._deliver = deliver
        self._subscriptions = {topic: self._subscribe(topic) for topic in INPUT_TOPICS}

    def _subscribe(self, topic: InputTopic) -> Any:
        def receive(message: Any, info: Any) -> None:
            self.drain(_Arrival(_received_ns(info), topic, message))

        return self._node.create_subscription(
            message_class(topic),
            topic.name,
            receive,
            qos.input_qos(),
            event_callbacks=qos.subscription_events(self._node.get_logger(), topic.name),
            qos_overriding_options=qos.overridable(),
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
                    taken_now.append(_Arrival(_received_ns(taken[1]), topic, taken[0]))
        return taken_now

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions = {}


def _received_ns(info: Any) -> int:
    """Return the arrival time [ns], or the send time if the middleware does not report arrivals."""
    return int(info['received_timestamp'] or info['source_timestamp'])
