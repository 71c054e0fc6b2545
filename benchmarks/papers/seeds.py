# SPDX-License-Identifier: Apache-2.0
"""Repeat an experiment over seeds on all cores."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

T = TypeVar('T')


def over_seeds(run: Callable[[int], T], seeds: Iterable[int]) -> list[T]:
    """Return what a function of module level gives for each seed, in order.

    Children start anew: a fork of a process with threads may hang.
    """
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context('spawn')) as pool:
        return list(pool.map(run, seeds))
