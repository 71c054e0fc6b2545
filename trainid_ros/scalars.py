# SPDX-License-Identifier: Apache-2.0
"""Functions of single numbers that are fast, and exact to the last bit, in compiled modules too."""

from __future__ import annotations

import math
from typing import Final

_NS_PER_S: Final = 1_000_000_000
# A float holds all integers up to here.
_EXACT: Final = 2**53


def is_finite(x: float) -> bool:
    """Return whether a number is neither NaN nor infinite; a call of ``math.isfinite`` is not compiled."""
    return not (math.isnan(x) or math.isinf(x))


def seconds(ns: int) -> float:
    """Return nanoseconds as seconds; compiled, a quotient of larger integers would be rounded twice."""
    if -_EXACT < ns < _EXACT:
        return ns / _NS_PER_S
    return float(ns // _NS_PER_S) + float(ns % _NS_PER_S) / _NS_PER_S
