# SPDX-License-Identifier: Apache-2.0
"""Work on several bags at once, each in a process of its own."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any, Final, TypeVar

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future

ItemT = TypeVar('ItemT')
ResultT = TypeVar('ResultT')

_POLL_EVERY_S: Final = 0.1
# Shared by the workers with their parent, set at their start: amount of work done, and stop event.
_shared: Final[list[Any]] = []


class _StoppedError(Exception):
    """The parent no longer needs the result."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def map_bags(
    work: Callable[[ItemT, Callable[[float], None]], ResultT],
    items: Sequence[ItemT],
    workers: int,
    advance: Callable[[float], None],
) -> list[ResultT]:
    """Return the result of work on each item, in their order.

    Args:
        work: Gets an item and a function to call with the amount done since its last call. For processes, both it and
            its result can be pickled.
        items: What to work on.
        workers: Number of processes; 1 works here.
        advance: Called with the sum of the amounts done since its last call.

    Raises:
        InputError: A process was killed.

    """
    if min(workers, len(items)) <= 1:
        return [work(item, advance) for item in items]
    # Imported here because one bag needs no processes.
    import multiprocessing  # noqa: PLC0415
    from concurrent.futures import ProcessPoolExecutor  # noqa: PLC0415
    from concurrent.futures.process import BrokenProcessPool  # noqa: PLC0415

    # A fork would copy the threads of a progress bar in whatever state they are.
    context = multiprocessing.get_context('spawn')
    done, stop = context.Value('d', 0.0), context.Event()
    with ProcessPoolExecutor(min(workers, len(items)), context, _start_worker, (done, stop)) as pool:
        try:
            futures = [pool.submit(_work, work, item) for item in items]
            _follow(futures, done, advance)
            return [future.result() for future in futures]
        except BrokenProcessPool:
            msg = f'{items[0]}: a process working on the bags was killed (out of memory?)'
            raise InputError(msg) from None
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _follow(futures: Sequence[Future[ResultT]], done: Any, advance: Callable[[float], None]) -> None:
    """Report the progress of all workers until all are done or one has failed."""
    from concurrent.futures import FIRST_EXCEPTION, wait  # noqa: PLC0415

    reported = 0.0
    pending = set(futures)
    while pending:
        ended, pending = wait(pending, _POLL_EVERY_S, FIRST_EXCEPTION)
        amount = float(done.value)
        advance(amount - reported)
        reported = amount
        for future in ended:
            if (error := future.exception()) is not None:
                raise error


def _start_worker(done: Any, stop: Any) -> None:
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared[:] = [done, stop]


def _work(work: Callable[[ItemT, Callable[[float], None]], ResultT], item: ItemT) -> ResultT:
    done, stop = _shared

    def advance(amount: float) -> None:
        if stop.is_set():
            raise _StoppedError
        with done.get_lock():
            done.value += amount

    return work(item, advance)
