# SPDX-License-Identifier: Apache-2.0
"""Changes of the status of an estimate: which of them are latched, logged and repeated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.impl.rcutils_logger import RcutilsLogger

HEARTBEAT_NS: Final = NS_PER_S * 8 // 10
"""Time after which a status without new samples is published again [ns]: in time for the deadline of 1 s."""
REPEATED: Final = frozenset({Status.STALE, Status.FAULT})
_FIT: Final = frozenset({Status.VALID, Status.HOLDING})
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
    """Return the statuses between which changes do not matter: VALID and HOLDING take turns at every brake."""
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
        """Return that inputs have come; how long after STALE, if the clock has run on."""
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
