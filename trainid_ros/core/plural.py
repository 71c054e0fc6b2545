# SPDX-License-Identifier: Apache-2.0
"""Numbers of things in words."""

from __future__ import annotations


def counted(count: int, word: str) -> str:
    """Return a number of things, as in '1 run' and '2 runs'."""
    return f'{count} {word}' if count == 1 else f'{count} {word}s'
