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

HEARTBEAT_NS: Final = NS_PER_S * 8 // 10
"""Time after which a status without new samples is published again [ns]: in time for the deadline of 1 s."""
REPEATED: Final = frozenset({Status.STALE, Status.FAULT})
_FIT: Final = frozenset({Status.VALID, Status.HOLDING})
# Shortest time between two log entries about one kind of change [s].
_LOG_PERIOD_S: Final = 1.0

# An estimate with one of these is not fit to use.
_WITHDRAWN: Final = frozenset({Status.CONVERGING, Status.STALE, Status.FAULT})


def is_latched(status: Status, latched: Status | None) -> bool:
    """Return whether an estimate goes to the ``last_valid`` topic.

    VALID estimates do. Once there was one, so does the first that withdraws it (CONVERGING: a change or contradiction
    is suspected) or does not keep it up any more (STALE, FAULT), and the first that holds again.

    Args:
        status: Status of the estimate.
        latched: Status of the last estimate on that topic, None before the first.
    """
    if status is Status.VALID:
        return True
    if latched is None:
        return False
    if status in _WITHDRAWN:
        return status is not latched
    return status is Status.HOLDING and latched in _WITHDRAWN


def _group(status: Status) -> frozenset[Status]:
    """Return the statuses that count as one: VALID and HOLDING take turns at every brake."""
    return _FIT if status in _FIT else frozenset({status})


class StatusChanges:
    """Follows the status of the published estimates: since when it holds, and one log line for each change.

    Args:
        logger: Logger of the node.
        missing: Describes the missing inputs, '' if all arrive.

    Attributes:
        since_ns: When the status changed last, by the node's clock [ns]; 0 if not known.
    """

    def __init__(self, logger: RcutilsLogger, missing: Callable[[], str]) -> None:
        self._logger = logger
        self._missing = missing
        self.restart(0)

    def restart(self, now_ns: int) -> None:
        """Begin anew, before the first estimate."""
        self._group = _group(Status.UNINITIALIZED)
        self._status = Status.UNINITIALIZED
        self._had_inputs = False
        self.since_ns = now_ns

    def forget_time(self) -> None:
        """Forget when the status changed, after a jump of the clock."""
        self.since_ns = 0

    def follow(self, status: Status, now_ns: int) -> None:
        """Take in the status of a published estimate, at a time of the node's clock [ns]."""
        if status is self._status:
            return
        before, self._status = self._group, status
        self._group = _group(status)
        if self._group != before:
            self._log(before, now_ns)
            self.since_ns = now_ns
        self._had_inputs |= status is not Status.STALE

    def _arrival(self, now_ns: int) -> str:
        """Describe input recovery and outage length."""
        if not self._had_inputs:
            return 'inputs have come'
        lasted = f', {(now_ns - self.since_ns) / NS_PER_S:.1f} s after STALE' if 0 < self.since_ns <= now_ns else ''
        return f'inputs are back{lasted}'

    def _log(self, before: frozenset[Status], now_ns: int) -> None:
        """Log a change; each kind at most once a second."""
        name, logger = self._status.name, self._logger
        if self._status is Status.STALE:
            why = self._missing() or 'stamps of an input are behind those of the others'
            logger.warning(f'STALE, the last estimate stands: {why}', throttle_duration_sec=_LOG_PERIOD_S)
        elif Status.STALE in before:
            logger.info(f'{name}: {self._arrival(now_ns)}', throttle_duration_sec=_LOG_PERIOD_S)
        elif self._group == _FIT:
            logger.info(f'{name}: the estimate is fit to use', throttle_duration_sec=_LOG_PERIOD_S)
        elif before == _FIT and self._status is not Status.FAULT:
            logger.warning(f'{name}: the estimate is not fit to use any more', throttle_duration_sec=_LOG_PERIOD_S)
        elif Status.FAULT in before:
            logger.info(f'{name}: the estimator works again', throttle_duration_sec=_LOG_PERIOD_S)


# At high replay rates a short stall of the machine is long in simulated time, but is not a dropout [ns].
_MIN_STALL_NS: Final = NS_PER_S // 4
# Simulated time may run at any rate, so it has to be polled often [ns].
_POLL_NS: Final = NS_PER_S // 10
# Largest time by which a timer may fire early [ns].
_MARGIN_NS: Final = NS_PER_S // 100


class Watchdog:
    """Finds whether no new input has arrived for too long.

    Attributes:
        limit_ns: How long inputs may be missing [ns].
    """

    def __init__(self, limit_ns: int) -> None:
        self.limit_ns = limit_ns
        self._newest_ns = 0
        self._clock = (0, 0)
        self._seen: tuple[int, int] | None = None

    def restart(self) -> None:
        """Begin to wait for input with the next check."""
        self._seen = None
        self._newest_ns = 0

    def saw(self, newest_ns: int, now_ns: int, steady_ns: int) -> None:
        """Record the newest stamp so far [ns]; only a changed stamp counts as new input."""
        if newest_ns not in (0, self._newest_ns):
            self._seen = (now_ns, steady_ns)
            self._newest_ns = newest_ns

    def is_missing(self, now_ns: int, steady_ns: int) -> bool:
        """Return whether inputs have been missing for too long.

        Args:
            now_ns: Time of the node's clock [ns], which may be simulated, stop or jump.
            steady_ns: Time of a clock that does none of this [ns].
        """
        if now_ns != self._clock[0]:
            self._clock = (now_ns, steady_ns)
        if self._seen is None:
            self._seen = (now_ns, steady_ns)
        missing_for, missing_for_steady = now_ns - self._seen[0], steady_ns - self._seen[1]
        stopped = steady_ns - self._clock[1] > self.limit_ns
        return (missing_for > self.limit_ns and missing_for_steady > min(self.limit_ns, _MIN_STALL_NS)) or (
            stopped and missing_for_steady > self.limit_ns
        )

    def pause_ns(self, steady_ns: int, *, simulated: bool) -> int:
        """Return how long to wait with the next check, by the steady clock [ns]: until the limit can be exceeded."""
        if simulated:
            return _POLL_NS
        waited = 0 if self._seen is None else steady_ns - self._seen[1]
        return (self.limit_ns - waited if waited <= self.limit_ns else self.limit_ns) + _MARGIN_NS


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
