# SPDX-License-Identifier: Apache-2.0
"""Detection of missing input by the node's clock, which may be simulated, and a steady one."""

from __future__ import annotations

from typing import Final

from trainid_ros.interface.records import NS_PER_S

# At high replay rates a short stall of the machine is long in simulated time, but is not a dropout.
_SHORTEST_NS: Final = NS_PER_S // 4
# Simulated time may run at any rate, so it has to be polled often.
_POLL_NS: Final = NS_PER_S // 10
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
        return (missing_for > self.limit_ns and missing_for_steady > min(self.limit_ns, _SHORTEST_NS)) or (
            stopped and missing_for_steady > self.limit_ns
        )

    def pause_ns(self, steady_ns: int, *, simulated: bool) -> int:
        """Return how long to wait with the next check, by the steady clock [ns]: until the limit can be exceeded."""
        if simulated:
            return _POLL_NS
        waited = 0 if self._seen is None else steady_ns - self._seen[1]
        return (self.limit_ns - waited if waited <= self.limit_ns else self.limit_ns) + _MARGIN_NS
