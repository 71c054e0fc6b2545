# SPDX-License-Identifier: Apache-2.0
"""The time base that a step of the stamps forward has left: the stamps may soon come back to it.

A clock that was set wrong for some seconds is set right again. That step back is no other drive, however large it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from trainid_ros.interface.records import NS_PER_S

RETURN_NS: Final = 60 * NS_PER_S
"""Time, by the stamps, within which a step forward is taken back [ns]."""


@dataclass(slots=True)
class LeftTime:
    """The time base that was left."""

    newest_ns: int = 0  # Its newest stamp [ns]; 0 if none was left
    until_ns: int = 0  # Stamp of the present time base up to which the stamps may return [ns]

    def leave(self, newest_ns: int, stamp_ns: int) -> bool:
        """Follow a step forward; return whether a time base is left that was right until then."""
        is_first = not self._may_return(newest_ns)
        if is_first:
            self.newest_ns = newest_ns
        self.until_ns = stamp_ns + RETURN_NS
        return is_first

    def is_return(self, newest_ns: int, stamp_ns: int, slack_ns: int) -> bool:
        """Return whether a step from the newest stamp back to another leads to the time base that was left."""
        return self._may_return(newest_ns) and -slack_ns <= stamp_ns - self.newest_ns <= RETURN_NS

    def _may_return(self, newest_ns: int) -> bool:
        return self.newest_ns > 0 and newest_ns <= self.until_ns
