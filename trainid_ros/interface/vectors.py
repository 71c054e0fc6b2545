# SPDX-License-Identifier: Apache-2.0
"""Types for loops over numbers: C arrays and integers in compiled modules, lists and integers of Python elsewhere.

``vec[float](items)`` makes an array, ``v = append(v, item)`` lengthens it; ``i64`` is the type of its indices.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.compiled import uses_sources

if TYPE_CHECKING or not uses_sources():
    from librt.vecs import append, vec
    from mypy_extensions import i64
else:
    from typing import TypeVar

    T = TypeVar('T')
    vec, i64 = list, int

    def append(v: list[T], item: T) -> list[T]:
        """Return the list with one more item."""
        v.append(item)
        return v


__all__ = ['append', 'i64', 'vec']
