# SPDX-License-Identifier: Apache-2.0
"""When inputs have gone silent: judged by the node's clock, and by a steady one while that stands still."""

from __future__ import annotations

from typing import Final

from trainid_ros.core.records import NS_PER_S

# At high replay rates a short stall of the machine is long in simulated time; it is no dropout.
_SHORTEST_NS: Final = NS_PER_S // 4
# Simulated time may run at any rate, so it has to be looked at often.
_POLL_NS: Final = NS_PER_S // 10
_MARGIN_NS: Final = NS_PER_S // 100


class Watchdog:
    """Tells once that nothing new has come for too long.

    Attributes:
        limit_ns: How long inputs may be silent.

    """

    def __init__(self, limit_ns: int) -> None:
        self.limit_ns = limit_ns
        self._newest_ns = 0
        self._seen = (0, 0)
        self._clock = (0, 0)
        self._published = True

    def restart(self) -> None:
        """Wait for the next record before judging again."""
        self._published = True
        self._newest_ns = 0

    def saw(self, newest_ns: int, now_ns: int, steady_ns: int) -> None:
        """Note the newest stamp taken in so far; only a change of it is news."""
        if newest_ns not in (0, self._newest_ns):
            self._published = False
            self._seen = (now_ns, steady_ns)
            self._newest_ns = newest_ns

    def is_missing(self, now_ns: int, steady_ns: int) -> bool:
        """Return True once when inputs have been silent for too long.

        Args:
            now_ns: The node's clock, which may be simulated, stand still or jump.
            steady_ns: A clock that does none of this.

        """
        if now_ns != self._clock[0]:
            self._clock = (now_ns, steady_ns)
        if self._published:
            return False
        missing_for, missing_for_steady = now_ns - self._seen[0], steady_ns - self._seen[1]
        stopped = steady_ns - self._clock[1] > self.limit_ns
        if (missing_for > self.limit_ns and missing_for_steady > min(self.limit_ns, _SHORTEST_NS)) or (
            stopped and missing_for_steady > self.limit_ns
        ):
            self._published = True
        return self._published

    def pause_ns(self, steady_ns: int, *, simulated: bool) -> int:
        """Return how long nothing can be silent for too long, by the steady clock."""
        if simulated:
            return _POLL_NS
        waited = 0 if self._published else steady_ns - self._seen[1]
        return max(self.limit_ns - waited, 0) + _MARGIN_NS
