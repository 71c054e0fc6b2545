# SPDX-License-Identifier: Apache-2.0
"""Everything that the nodes publish, with the time of day at which it arrived."""

from __future__ import annotations

import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from trainid_ros.interface.records import OUTPUT_TOPICS, RESISTANCE_TOPIC
from trainid_ros.ros.topics import LEASE_S, diagnostics_qos, estimate_qos, message_class

if TYPE_CHECKING:
    from types import TracebackType

_POLL_S: Final = 0.1


class Arrival(NamedTuple):
    """What arrived when [ns]: a message, or a sentence of the middleware."""

    time_ns: int
    what: Any


class Listener:
    """A controller and a display in a thread; use as a context manager.

    Attributes:
        estimates: Estimates by topic.
        diagnostics: Single statuses of ``/diagnostics``.
        events: When the publisher of the resistance was lost, or came back.

    """

    def __init__(self) -> None:
        self.estimates: dict[str, list[Arrival]] = {topic.name: [] for topic in OUTPUT_TOPICS}
        self.diagnostics: list[Arrival] = []
        self.events: list[Arrival] = []
        self._context = Context()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._receive, daemon=True)

    def __enter__(self) -> Self:
        """Subscribe."""
        rclpy.init(context=self._context, args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('controller', context=self._context)
        for topic in OUTPUT_TOPICS:
            profile, events = estimate_qos(), None
            if topic is RESISTANCE_TOPIC:
                profile.liveliness_lease_duration = Duration(seconds=LEASE_S)
                events = SubscriptionEventCallbacks(liveliness=self._note_liveliness)
            note = partial(self._note, self.estimates[topic.name])
            self._node.create_subscription(message_class(topic), topic.name, note, profile, event_callbacks=events)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._note_statuses, diagnostics_qos())
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the graph."""
        self._end.set()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _receive(self) -> None:
        while not self._end.is_set():
            self._executor.spin_once(timeout_sec=_POLL_S)

    @staticmethod
    def _note(arrivals: list[Arrival], message: Any) -> None:
        arrivals.append(Arrival(time.time_ns(), message))

    def _note_statuses(self, array: Any) -> None:
        now_ns = time.time_ns()
        self.diagnostics.extend(Arrival(now_ns, status) for status in array.status)

    def _note_liveliness(self, event: Any) -> None:
        text = 'alive' if event.alive_count else 'not alive'
        self.events.append(Arrival(time.time_ns(), f'liveliness: the publisher is {text}'))
