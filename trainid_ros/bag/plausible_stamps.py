# SPDX-License-Identifier: Apache-2.0
"""Which inputs of a replay belong on a time axis: a wrong stamp must not stretch it."""

from __future__ import annotations

from typing import Final

from trainid_ros.interface.records import NS_PER_S

_FARTHEST_NS: Final = 600 * NS_PER_S
"""Step of the stamps that needs a sample on its other side [ns]."""


class PlausibleStamps:
    """Stamps near the last plausible one, or near the newest sample.

    The stream that makes the samples follows a step of the time base, such as a pause, once several topics show it.
    """

    def __init__(self) -> None:
        self._newest_ns = self._sample_ns = 0

    def follow(self, sample_ns: int) -> None:
        """Follow the stamp of a sample, which the stream has accepted."""
        self._sample_ns = sample_ns

    def accept(self, stamp_ns: int) -> bool:
        """Return whether an input with a stamp is to be shown."""
        near = any(abs(stamp_ns - known) <= _FARTHEST_NS for known in (self._newest_ns, self._sample_ns) if known)
        if stamp_ns <= 0 or not (near or self._newest_ns == 0):
            return False
        self._newest_ns = stamp_ns
        return True
