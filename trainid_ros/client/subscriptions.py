# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the estimates for ``trainid_ros.client``, in the namespace of a node that somebody else spins.

Those of live estimates ask for no deadline and no lease: a subscriber that asks for more than a publisher offers gets
nothing from it, and those of slow inputs offer less. Silence is measured by the client, in less time than the deadline
of the nodes. The latched ones ask for the lease of the nodes and say when a node is gone; without them, silence does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import qos_policy_name_from_kind

from trainid_ros.interface.records import BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, stamp_of, status_of
from trainid_ros.ros.topics import estimate_qos, latched_qos, message_class

if TYPE_CHECKING:
    from trainid_ros.interface.records import OutputTopic
    from trainid_ros.interface.results import Status

_GONE: Final = 'its node is gone'


class Receiver(Protocol):
    """Takes the messages of estimates."""

    def take_message(
        self, topic: OutputTopic, status: Status, estimate: Any, stamp_ns: int, *, latched: bool = False
    ) -> None:
        """Take in an estimate."""

    def mark_lost(self, topic: OutputTopic, reason: str) -> None:
        """Take in why a topic sends nothing any more."""


def subscribe_estimates(node: Any, receiver: Receiver) -> tuple[Any, ...]:
    """Subscribe to resistance and brake rate, live and latched; return the subscriptions."""
    topics = (RESISTANCE_TOPIC, BRAKE_RATE_TOPIC)
    return tuple(make(node, receiver, topic) for topic in topics for make in (_subscribe_live, _subscribe_latched))


def _subscribe_live(node: Any, receiver: Receiver, topic: OutputTopic) -> Any:
    def take(message: Any) -> None:
        receiver.take_message(topic, status_of(message), message, stamp_of(message))

    def refuse(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        receiver.mark_lost(topic, f'its publisher has an incompatible quality of service ({policy})')

    events = SubscriptionEventCallbacks(incompatible_qos=refuse, use_default_callbacks=False)
    return node.create_subscription(message_class(topic), topic.name, take, estimate_qos(), event_callbacks=events)


def _subscribe_latched(node: Any, receiver: Receiver, topic: OutputTopic) -> Any:
    def take(message: Any) -> None:
        receiver.take_message(topic, status_of(message), message, stamp_of(message), latched=True)

    def follow(event: Any) -> None:
        if event.alive_count == 0:
            receiver.mark_lost(topic, _GONE)

    events = SubscriptionEventCallbacks(liveliness=follow, use_default_callbacks=False)
    return node.create_subscription(message_class(topic), topic.last_valid, take, latched_qos(), event_callbacks=events)
