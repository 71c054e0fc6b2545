# SPDX-License-Identifier: Apache-2.0
"""Work on several bags at once, each in a process of its own."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Mapping, Sequence
    from pathlib import Path

ItemT = TypeVar('ItemT')
ResultT = TypeVar('ResultT')
Report: TypeAlias = Callable[[float], None]
"""Called with the amount of work done since its last call."""
Work: TypeAlias = Callable[[ItemT, Report], ResultT]
"""Work on an item that reports progress; for processes it can be pickled."""

# Shared by the workers with their parent, set at their start: amount of work done on each item, whether it has begun,
# and whether to stop. Without locks, which a killed process would keep: one process at a time works on an item.
_shared: Final[list[Any]] = []


class _StoppedError(Exception):
    """The parent no longer needs the result."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def killed_message(bag: Path) -> str:
    """Return the error of a bag whose process was killed."""
    return f'{bag}: the process that worked on it was killed (out of memory?)'


def each_bag(
    work: Work[ItemT, ResultT],
    items: Sequence[ItemT],
    workers: int,
    advance: Report,
    killed: Callable[[ItemT], ResultT],
) -> Generator[tuple[int, ResultT], None, None]:
    """Yield number and result of each item as they come; one worker works in this process.

    If a process is killed, the items that were being worked on are worked on again, one by one, then the others.
    ``killed`` gives the result of an item whose own process was killed, or raises. ``advance`` reports the sum.
    """
    if min(workers, len(items)) <= 1:
        yield from ((number, work(item, advance)) for number, item in enumerate(items))
        return
    progress = _Progress(len(items), advance)
    left = dict(enumerate(items))
    while left:
        for number, result in _finished(work, dict(left), workers, progress):
            del left[number]
            yield number, result
        for number in [number for number in left if progress.begun[number]]:
            progress.amounts[number] = 0.0
            item = {number: left.pop(number)}
            yield from list(_finished(work, item, 1, progress)) or [(number, killed(item[number]))]


class _Progress:
    """Reports the sum of the amounts done on all items, which processes share, and which of them have begun."""

    def __init__(self, count: int, advance: Report) -> None:
        from multiprocessing.sharedctypes import RawArray  # noqa: PLC0415 - one bag needs no processes

        self.amounts: Any = RawArray('d', count)
        self.begun: Any = RawArray('b', count)
        self._advance = advance
        self._reported = 0.0

    def report(self) -> None:
        """Report progress since the last call; none while work is repeated."""
        amount = sum(self.amounts)
        if amount > self._reported:
            self._advance(amount - self._reported)
            self._reported = amount


def _finished(
    work: Work[ItemT, ResultT], items: Mapping[int, ItemT], workers: int, progress: _Progress
) -> Iterator[tuple[int, ResultT]]:
    """Yield the results by number until all are done or a process was killed; all others are then stopped too."""
    import multiprocessing  # noqa: PLC0415
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait  # noqa: PLC0415
    from concurrent.futures.process import BrokenProcessPool  # noqa: PLC0415

    # A fork would copy the threads of a progress bar in whatever state they are.
    context = multiprocessing.get_context('spawn')
    stop = context.RawValue('b', 0)
    shared = (os.getpid(), progress.amounts, progress.begun, stop)
    with ProcessPoolExecutor(min(workers, len(items)), context, _start_worker, shared) as pool:
        try:
            submitted = ((pool.submit(_work, work, number, item), number) for number, item in items.items())
            most = 4 * workers  # for each worker one item that it works on, and three that wait for it
            pending = dict(islice(submitted, most))
            while pending:
                ended = wait(pending, 0.1, FIRST_COMPLETED).done  # at least ten reports of progress a second
                progress.report()
                for future in sorted(ended, key=lambda future: future.exception() is not None):
                    yield pending.pop(future), future.result()
                pending.update(islice(submitted, most - len(pending)))
        except BrokenProcessPool:
            pass
        finally:
            stop.value = 1
            pool.shutdown(wait=False, cancel_futures=True)


def _start_worker(parent: int, amounts: Any, begun: Any, stop: Any) -> None:
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(parent,), daemon=True).start()
    _shared[:] = [amounts, begun, stop]


def _end_with_parent(parent: int) -> None:
    """End this process within a second after its parent was killed."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _work(work: Work[ItemT, ResultT], number: int, item: ItemT) -> ResultT:
    amounts, begun, stop = _shared
    begun[number] = 1

    def advance(amount: float) -> None:
        if stop.value:
            raise _StoppedError
        amounts[number] += amount

    return work(item, advance)
