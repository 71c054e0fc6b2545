# SPDX-License-Identifier: Apache-2.0
"""Work on several bags at once, each in a process of its own."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from concurrent.futures import Future
    from pathlib import Path

ItemT = TypeVar('ItemT')
ResultT = TypeVar('ResultT')

_POLL_EVERY_S: Final = 0.1
# Shared by the workers with their parent, set at their start: amount of work done on each item, and whether to stop.
# Without locks, which a process that is killed would keep: an item is worked on by one process at a time.
_shared: Final[list[Any]] = []


class _StoppedError(Exception):
    """The parent no longer needs the result."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def killed_message(bag: Path) -> str:
    """Return the error of a bag whose process was killed."""
    return f'{bag}: the process that worked on it was killed (out of memory?)'


def map_bags(
    work: Callable[[ItemT, Callable[[float], None]], ResultT],
    items: Sequence[ItemT],
    workers: int,
    advance: Callable[[float], None],
    killed: Callable[[ItemT], ResultT],
) -> list[ResultT]:
    """Return the result of work on each item, in their order.

    If a process is killed, the items without a result are worked on again, one by one.

    Args:
        work: Gets an item and a function to call with the amount done since its last call. For processes, both it and
            its result can be pickled.
        items: What to work on.
        workers: Number of processes; 1 works here.
        advance: Called with the sum of the amounts done since its last call.
        killed: Gets an item whose own process was killed; returns its result or raises.

    """
    if min(workers, len(items)) <= 1:
        return [work(item, advance) for item in items]
    progress = _Progress(len(items), advance)
    results = _finished(work, dict(enumerate(items)), workers, progress)
    for number, item in enumerate(items):
        if number not in results:
            progress.amounts[number] = 0.0
            results |= _finished(work, {number: item}, 1, progress)
    return [results[number] if number in results else killed(item) for number, item in enumerate(items)]


class _Progress:
    """Reports the sum of the amounts done on all items, which processes share."""

    def __init__(self, count: int, advance: Callable[[float], None]) -> None:
        # Imported here because one bag needs no processes.
        from multiprocessing.sharedctypes import RawArray  # noqa: PLC0415

        self.amounts: Any = RawArray('d', count)
        self._advance = advance
        self._reported = 0.0

    def report(self) -> None:
        """Report what was done since the last call; nothing while work is done again."""
        amount = sum(self.amounts)
        if amount > self._reported:
            self._advance(amount - self._reported)
            self._reported = amount


def _finished(
    work: Callable[[ItemT, Callable[[float], None]], ResultT],
    items: Mapping[int, ItemT],
    workers: int,
    progress: _Progress,
) -> dict[int, ResultT]:
    """Return the results by number, without those of which a process was killed; all others are then stopped too."""
    import multiprocessing  # noqa: PLC0415
    from concurrent.futures import ProcessPoolExecutor  # noqa: PLC0415
    from concurrent.futures.process import BrokenProcessPool  # noqa: PLC0415

    # A fork would copy the threads of a progress bar in whatever state they are.
    context = multiprocessing.get_context('spawn')
    stop = context.RawValue('b', 0)
    futures: dict[int, Future[ResultT]] = {}
    with ProcessPoolExecutor(min(workers, len(items)), context, _start_worker, (progress.amounts, stop)) as pool:
        try:
            for number, item in items.items():
                futures[number] = pool.submit(_work, work, number, item)
            _follow(futures.values(), progress)
        except BrokenProcessPool:
            pass
        finally:
            stop.value = 1
            pool.shutdown(wait=False, cancel_futures=True)
    return {number: future.result() for number, future in futures.items() if future.exception() is None}


def _follow(futures: Iterable[Future[ResultT]], progress: _Progress) -> None:
    """Report the progress of all workers until all are done or one has failed."""
    from concurrent.futures import FIRST_EXCEPTION, wait  # noqa: PLC0415

    pending = set(futures)
    while pending:
        ended, pending = wait(pending, _POLL_EVERY_S, FIRST_EXCEPTION)
        progress.report()
        for future in ended:
            if (error := future.exception()) is not None:
                raise error


def _start_worker(amounts: Any, stop: Any) -> None:
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared[:] = [amounts, stop]


def _work(work: Callable[[ItemT, Callable[[float], None]], ResultT], number: int, item: ItemT) -> ResultT:
    amounts, stop = _shared

    def advance(amount: float) -> None:
        if stop.value:
            raise _StoppedError
        amounts[number] += amount

    return work(item, advance)
