# SPDX-License-Identifier: Apache-2.0
"""Measure CPU time, memory and saving of the compared estimators."""

from __future__ import annotations

import gc
import pickle
import resource
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

REPOSITORY: Final = Path(__file__).resolve().parents[2]
PEERS: Final = REPOSITORY / '.venv-peers'
FIRST_SEED: Final = 5000
"""Lower seeds are for tuning."""


@dataclass(frozen=True, slots=True)
class Times:
    """CPU time of a call [us]."""

    p50: float
    p99: float


def installed(*packages: str) -> bool:
    """True if all packages can be imported."""
    return all(find_spec(name) is not None for name in packages)


def time_in_turns(calls: Sequence[tuple[Callable[..., object], Sequence[Any]]], block: int = 100) -> list[Times]:
    """Time functions on their arguments, taking turns block by block, so that machine load affects all equally.

    Args:
        calls: Each function with the argument tuples of its calls, in order.
        block: Calls in one turn.

    """
    spent: list[list[int]] = [[] for _ in calls]
    longest = max(len(items) for _, items in calls)
    clock = time.thread_time_ns
    overhead = float(np.median([-(clock() - clock()) for _ in range(20_000)]))
    gc.collect()
    gc.disable()
    for start in range(0, longest, block):
        for (call, items), times in zip(calls, spent, strict=True):
            for item in items[start : start + block]:
                before = clock()
                call(*item)
                times.append(clock() - before)
    gc.enable()
    return [_summary(np.array(times, dtype=np.float64), overhead) for times in spent]


def _summary(times: NDArray[np.float64], overhead: float) -> Times:
    # The first tenth is warm-up.
    us = np.maximum(times[len(times) // 10 :] - overhead, 0.0) / 1e3
    return Times(*map(float, np.percentile(us, (50.0, 99.0))))


def resident_bytes() -> int:
    """Return the resident memory of this process after garbage collection [bytes]."""
    gc.collect()
    return int(Path('/proc/self/statm').read_text(encoding='ascii').split()[1]) * resource.getpagesize()


def growth(step: Callable[..., object], items: Sequence[Any], first: int, last: int) -> float:
    """Return the memory growth per call between the calls ``first`` and ``last`` [bytes]; items are repeated."""
    before = 0
    for k in range(last):
        if k == first:
            before = resident_bytes()
        step(*items[k % len(items)])
    return (resident_bytes() - before) / (last - first)


def copied(item: Any) -> tuple[int, Any] | None:
    """Return the size of a pickle and the restored object; None if it cannot be pickled."""
    try:
        text = pickle.dumps(item)
        return len(text), pickle.loads(text)
    except (pickle.PicklingError, RecursionError, TypeError, AttributeError):
        return None
