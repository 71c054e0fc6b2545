# SPDX-License-Identifier: Apache-2.0
"""Publishes the estimates of a node, and latches those that say what a late subscriber must know."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from trainid_ros.interface.results import Status
from trainid_ros.ros.status_changes import StatusChanges, is_latched
from trainid_ros.ros.topics import latched_qos, message_class, offered_estimate_qos, overridable, publisher_events

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.interface.records import OutputTopic
    from trainid_ros.ros.node import ManagedNode
    from trainid_ros.ros.topics import SerializedEstimate

# Statuses with which the estimate of a loaded state is latched.
_WORTH_LATCHING: Final = (Status.VALID, Status.HOLDING, Status.STALE)


class EstimatePublisher:
    """The publishers of a configured node.

    Args:
        node: The node, of whose lifecycle they are part.
        topic: What it estimates.
        changes: Called with each status that was published.

    Attributes:
        live: Publishes every estimate.
        last_valid: Publishes latched ones, None where nothing is latched.
        latched: Status of the estimate that is latched, None before the first.
        published_ns: Steady time of the last estimate [ns], 0 before the first.
    """

    def __init__(self, node: ManagedNode, topic: OutputTopic, changes: StatusChanges) -> None:
        self._node = node
        self._changes = changes
        self._message = message_class(topic)
        self.live = self._offer(topic.name, offered_estimate_qos())
        self.last_valid = self._offer(topic.last_valid, latched_qos()) if topic.last_valid else None
        self.latched: Status | None = None
        self.published_ns = 0
        self._sent: list[SerializedEstimate] = []

    def _offer(self, topic: str, profile: Any) -> Any:
        return self._node.create_lifecycle_publisher(
            self._message,
            topic,
            profile,
            event_callbacks=publisher_events(self._node.get_logger(), topic),
            qos_overriding_options=overridable('publisher'),
        )

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in (self.live, self.last_valid):
            if publisher is not None:
                self._node.destroy_lifecycle_publisher(publisher)

    def publish(self, estimates: Sequence[SerializedEstimate]) -> None:
        """Publish estimates; what follows from them is done by :meth:`conclude`, after those of other nodes."""
        for estimate in estimates:
            self.live.publish(estimate.data)
        self._sent += estimates

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
        if estimate.status in _WORTH_LATCHING:
            self._latch(estimate)

    def _latch(self, estimate: SerializedEstimate) -> None:
        if self.last_valid is not None:
            self.last_valid.publish(estimate.data)
            self.latched = estimate.status
