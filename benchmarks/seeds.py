# SPDX-License-Identifier: Apache-2.0
"""Repeat an experiment over seeds on all cores."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Final, TypeVar

S = TypeVar('S')
T = TypeVar('T')
# Results between two progress messages.
_SHOWN_EVERY: Final = 20


def over_seeds(run: Callable[[S], T], seeds: Iterable[S], progress: str = '', jobs: int | None = None) -> list[T]:
    """Return the results of a module-level function for each seed (or trial), in order, run on all cores.

    Child processes are spawned, because a fork of a process with threads may hang. Progress is printed if named.
    """
    trials, results = list(seeds), list[T]()
    with ProcessPoolExecutor(jobs or os.cpu_count(), mp_context=get_context('spawn')) as pool:
        for result in pool.map(run, trials):
            results.append(result)
            if progress and not len(results) % _SHOWN_EVERY:
                print(f'{progress}: {len(results)} of {len(trials)}', file=sys.stderr, flush=True)
    return results
