# SPDX-License-Identifier: Apache-2.0
"""Subscriber in the place of an ATO controller: receives the estimates and the diagnostics."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from trainid_msgs import msg as trainid_msgs

from trainid_ros.demo.compare import Fingerprint, fingerprint_of_message
from trainid_ros.estimators.protocol import Output
from trainid_ros.messages import OUTPUT_TOPICS
from trainid_ros.records import NS_PER_S
from trainid_ros.results import (
    Estimate,
    Reason,
    Status,
)

if TYPE_CHECKING:
    from types import TracebackType

    from trainid_ros.bag.bag_replay import AnyOutput

# Deep enough that no message is lost while the screen is drawn.
_DEPTH: Final = 40000
_REJECTED: Final = 'rejected.'


@dataclass(frozen=True, slots=True)
class Received:
    """A received message as an output, with its fingerprint."""

    output: AnyOutput
    fingerprint: Fingerprint


class Listener:
    """A node that is polled for what has arrived; use as a context manager."""

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
            message = getattr(trainid_msgs, topic.message)
            self._estimates[topic.estimate] = self._node.create_subscription(message, topic.name, _ignore, qos)
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
