# SPDX-License-Identifier: Apache-2.0
"""Pluralise nouns."""

from __future__ import annotations


def pluralise(count: int, word: str) -> str:
    """Return a count with its noun, such as '1 run' or '2 runs'."""
    return f'{count} {word}' if count == 1 else f'{count} {word}s'
