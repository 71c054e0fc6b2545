# SPDX-License-Identifier: Apache-2.0
"""Text for people: plurals, and characters that every terminal can show."""

from __future__ import annotations

import math
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


def in_step(value: float, std: float) -> tuple[str, str]:
    """Return a value and its standard deviation as text, both to two significant digits of the latter."""
    if not (math.isfinite(std) and std > 0.0 and math.isfinite(value)):
        known = [f'{item:.4g}' if math.isfinite(item) else '–' for item in (value, std)]
        return known[0], known[1]
    places = max(0, 1 - math.floor(math.log10(std)))
    return (f'{value:.{places}f}', f'{std:.{places}f}') if places < 7 else (f'{value:.4g}', f'{std:.2g}')


def plus_minus(value: float, std: float) -> str:
    """Return a value with its standard deviation, if that is known, with digits in step."""
    value_text, std_text = in_step(value, std)
    return f'{value_text} ± {std_text}' if std > 0.0 and math.isfinite(value + std) else value_text
