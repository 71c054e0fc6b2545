# SPDX-License-Identifier: Apache-2.0
"""A time that never goes back, from a clock that may, as simulated time does when a bag starts again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.client.arguments import Argument
from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

_TIME: Final = Argument('clock()', 's', -1e12, 1e12)


class ForwardClock:
    """The time of a clock [s] plus all that it has gone back: it goes on from where the clock jumped.

    Args:
        clock: Present time [s].

    Raises:
        InputError: The clock is not callable, or does not return a number.

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        if not callable(clock):
            msg = f'clock = {clock!r} must be a function that returns the time in s'
            raise InputError(msg)
        self._clock, self._offset_s, self._last_s = clock, 0.0, _TIME.checked(clock())

    def now(self) -> float:
        """Return the time [s], which is not before that of the last call."""
        read_s = self._clock()
        if read_s < self._last_s:
            self._offset_s += self._last_s - read_s
        self._last_s = read_s
        return read_s + self._offset_s
