# SPDX-License-Identifier: Apache-2.0
"""Publishes the estimates of a node, and decides which of them are latched, logged and repeated without new input."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status
from trainid_ros.ros.topics import latched_qos, message_class, offered_estimate_qos, overridable, publisher_events

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.impl.rcutils_logger import RcutilsLogger

    from trainid_ros.interface.records import OutputTopic
    from trainid_ros.ros.node import ManagedNode
    from trainid_ros.ros.topics import SerializedEstimate

# Statuses that are published again without new samples, after this time [ns]: in time for the deadline of 1 s.
REPEATED: Final = frozenset({Status.STALE, Status.FAULT})
HEARTBEAT_NS: Final = NS_PER_S * 8 // 10
_FIT: Final = frozenset({Status.VALID, Status.HOLDING})
_NOT_FIT: Final = frozenset({Status.CONVERGING, *REPEATED})


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
    """Follows the status of the published estimates: since when it holds, and one log line for each change.

    Args:
        logger: Logger of the node.
        missing: Describes the missing inputs, '' if all arrive.

    Attributes:
        since_ns: When the status changed last, by the node's clock [ns]; 0 if not known, as after a jump of the clock.
    """

    def __init__(self, logger: RcutilsLogger, missing: Callable[[], str]) -> None:
        self._logger, self._missing = logger, missing
        self.restart(0)

    def restart(self, now_ns: int) -> None:
        """Begin anew, before the first estimate."""
        self._status = Status.UNINITIALIZED
        self._had_inputs = False
        self.since_ns = now_ns

    def follow(self, status: Status, now_ns: int) -> None:
        """Take in the status of a published estimate, at a time of the node's clock [ns]."""
        if status is self._status:
            return
        before, self._status = self._status, status
        if not {before, status} <= _FIT:  # VALID and HOLDING count as one: they take turns at every brake
            self._log(before, now_ns)
            self.since_ns = now_ns
        self._had_inputs |= status is not Status.STALE

    def _log(self, before: Status, now_ns: int) -> None:
        # Each line at most once a second.
        name, logger = self._status.name, self._logger
        if self._status is Status.STALE:
            why = self._missing() or 'stamps of an input are behind those of the others'
            logger.warning(f'STALE, the last estimate stands: {why}', throttle_duration_sec=1.0)
        elif before is Status.STALE:
            text = 'inputs are back' if self._had_inputs else 'inputs have come'
            if self._had_inputs and 0 < self.since_ns <= now_ns:
                text += f', {(now_ns - self.since_ns) / NS_PER_S:.1f} s after STALE'
            logger.info(f'{name}: {text}', throttle_duration_sec=1.0)
        elif self._status in _FIT:
            logger.info(f'{name}: the estimate is fit to use', throttle_duration_sec=1.0)
        elif before in _FIT and self._status is not Status.FAULT:
            logger.warning(f'{name}: the estimate is not fit to use any more', throttle_duration_sec=1.0)
        elif before is Status.FAULT:
            logger.info(f'{name}: the estimator works again', throttle_duration_sec=1.0)


class Watchdog:
    """Finds whether no new input has arrived for too long.

    Attributes:
        limit_ns: How long inputs may be missing [ns].
    """

    def __init__(self, limit_ns: int) -> None:
        self.limit_ns = limit_ns
        self._clock = (0, 0)
        self.restart()

    def restart(self) -> None:
        """Begin to wait for input with the next check."""
        self._seen: tuple[int, int] | None = None
        self._newest_ns = 0

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
        last_valid: Publishes latched ones, None where nothing is latched.
        latched: Status of the estimate that is latched, None before the first.
        published_ns: Steady time of the last estimate [ns], 0 before the first.
    """

    def __init__(self, node: ManagedNode, topic: OutputTopic, changes: StatusChanges) -> None:
        self._node, self._changes = node, changes
        kind = message_class(topic)
        self.live = self._offer(kind, topic.name, offered_estimate_qos())
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
        if estimate.status in _FIT or estimate.status is Status.STALE:
            self._latch(estimate)

    def _latch(self, estimate: SerializedEstimate) -> None:
        if self.last_valid is not None:
            self.last_valid.publish(estimate.data)
            self.latched = estimate.status
