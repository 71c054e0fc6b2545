# SPDX-License-Identifier: Apache-2.0
"""Progress of opening a bag and of reading it as one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

OPENING: Final = 0.3
"""Share of the work on a bag without an index that opening it is [1]: all of it is read and unpacked then."""


def in_two(
    advance: Callable[[float], None], opening_share: float = OPENING
) -> tuple[Callable[[float], None], Callable[[float], None]]:
    """Return what reports the progress of opening a bag and of reading it, as shares of each, as that of the whole.

    Opening counts only as far as the bag is scanned then, which one with an index is not.
    """
    opened = 0.0

    def opening(share: float) -> None:
        nonlocal opened
        opened += opening_share * share
        advance(opening_share * share)

    return opening, lambda share: advance((1.0 - opened) * share)
