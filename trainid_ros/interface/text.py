# SPDX-License-Identifier: Apache-2.0
"""Text for people: plurals, and characters that every terminal can show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_PLAIN: Final = str.maketrans({'±': '+-', '²': '^2', '‰': 'permille', '–': '-', '…': '...', '≥': '>='})


def pluralise(count: int, word: str) -> str:
    """Return a count with its noun, such as '1 run' or '2 runs'."""
    return f'{count} {word}' if count == 1 else f'{count} {word}s'


def listed(names: Sequence[str], most: int) -> str:
    """Return names with commas, no more than some of them."""
    more = f' and {len(names) - most} more' if len(names) > most else ''
    return f'{", ".join(names[:most])}{more}'


def in_ascii(text: str) -> str:
    """Return text for terminals without Unicode."""
    return text.translate(_PLAIN).encode('ascii', 'replace').decode()


def printable(text: str) -> str:
    """Return text with all characters escaped that are neither printable nor line breaks."""
    return ''.join(
        char if char.isprintable() or char == '\n' else char.encode('unicode_escape').decode() for char in text
    )
