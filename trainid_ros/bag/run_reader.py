# SPDX-License-Identifier: Apache-2.0
"""Read the runs of several bags on one time scale; long bags are read in parallel, each in its own process."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag.reader import BagReader, require_topics
from trainid_ros.errors import InputError
from trainid_ros.explain.run_data import RunCollector
from trainid_ros.records import NS_PER_S
from trainid_ros.stream.alignment import TimeJump
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from trainid_ros.explain.run_data import Run
    from trainid_ros.train.train_file import TrainFile

POOL_FROM: Final = 100_000
"""Number of inputs from which worker processes pay for the second that they take to start."""
_PROGRESS_EVERY: Final = 500
_POLL_EVERY_S: Final = 0.1
# Shared by the workers with their parent, set at their start: count of inputs read, and stop event.
_shared: Final[list[Any]] = []


@dataclass(frozen=True, slots=True)
class Survey:
    """Summary of the bags before they are read.

    Attributes:
        inputs: Number of input messages in each bag.
        warnings: Faults of the bags that do not prevent reading.

    """

    inputs: tuple[int, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Reading:
    """Runs of one bag, in seconds since its first sample at ``origin_ns``; 0 without samples."""

    runs: tuple[Run, ...]
    origin_ns: int


class _StoppedError(Exception):
    """The parent no longer needs the result."""


def survey(paths: Sequence[Path], namespace: str = '/') -> Survey:
    """Check that all bags can be used, and summarise them.

    Raises:
        InputError: One is given twice, cannot be read, or lacks a required topic.

    """
    places = [path.resolve() for path in paths]
    for i, place in enumerate(places):
        if place in places[:i]:
            msg = f'{paths[i]}: given twice; its data would count twice'
            raise InputError(msg)
    inputs, warnings = [], []
    for path in paths:
        with BagReader(path, namespace) as reader:
            require_topics(reader)
            inputs.append(reader.input_count)
            warnings += reader.warnings
    return Survey(tuple(inputs), tuple(warnings))


def read_runs(
    paths: Sequence[Path],
    train_file: TrainFile,
    namespace: str = '/',
    *,
    workers: int = 1,
    advance: Callable[[float], None] = lambda _: None,
) -> list[Run]:
    """Return the runs of all bags, in seconds since the earliest sample of all.

    Args:
        paths: The bags; their numbers are their places in this list.
        train_file: Train file, for its effects and parameters.
        namespace: Namespace of their topics.
        workers: Number of processes; 1 reads them here.
        advance: Called with the number of inputs read since its last call.

    Raises:
        InputError: A bag cannot be read.

    """
    if workers > 1:
        readings = _read_in_pool(paths, train_file, namespace, workers, advance)
    else:
        readings = [_read(path, k, train_file, namespace, advance) for k, path in enumerate(paths)]
    known = [reading for reading in readings if reading.origin_ns]
    first_ns = min((reading.origin_ns for reading in known), default=0)
    return [
        replace(run, time=run.time + (reading.origin_ns - first_ns) / NS_PER_S)
        for reading in known
        for run in reading.runs
    ]


def worker_count(inputs: Sequence[int]) -> int:
    """Return the number of processes for reading bags with these numbers of inputs."""
    if sum(inputs) < POOL_FROM:
        return 1
    return min(len(inputs), len(os.sched_getaffinity(0)))


def _read(path: Path, bag: int, train_file: TrainFile, namespace: str, advance: Callable[[float], None]) -> _Reading:
    # The train file may be what is wrong, so it must not decide which speeds are used.
    stream = SampleStream(StreamConfig(train_file, rejects_stuck_speed=False))
    collector = RunCollector(train_file, bag)
    reported = 0
    with BagReader(path, namespace) as reader:
        for i, (_, row) in enumerate(reader.rows(), 1):
            for event in stream.push_row(*row):
                if isinstance(event, Sample):
                    collector.add(event)
                elif isinstance(event, TimeJump):
                    collector.end_run()
            if i - reported == _PROGRESS_EVERY:
                reported = i
                advance(_PROGRESS_EVERY)
    collector.end_run()
    return _Reading(tuple(collector.runs), collector.origin_ns)


def _read_in_pool(
    paths: Sequence[Path], train_file: TrainFile, namespace: str, workers: int, advance: Callable[[float], None]
) -> list[_Reading]:
    # A fork would copy the threads of a progress bar in whatever state they are.
    context = multiprocessing.get_context('spawn')
    count, stop = context.Value('q', 0), context.Event()
    with ProcessPoolExecutor(workers, context, _start_worker, (count, stop)) as pool:
        try:
            futures = [pool.submit(_read_in_worker, path, k, train_file, namespace) for k, path in enumerate(paths)]
            _follow_progress(futures, count, advance)
            return [future.result() for future in futures]
        except BrokenProcessPool:
            msg = f'{paths[0]}: a process reading the bags was killed (out of memory?)'
            raise InputError(msg) from None
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)


def _follow_progress(futures: Sequence[Future[_Reading]], count: Any, advance: Callable[[float], None]) -> None:
    """Report the progress of all workers until all are done or one has failed."""
    reported = 0
    pending = set(futures)
    while pending:
        done, pending = wait(pending, _POLL_EVERY_S, FIRST_EXCEPTION)
        read = int(count.value)
        advance(read - reported)
        reported = read
        for future in done:
            if (error := future.exception()) is not None:
                raise error


def _start_worker(count: Any, stop: Any) -> None:
    # Ctrl-C reaches the whole process group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared[:] = [count, stop]


def _read_in_worker(path: Path, bag: int, train_file: TrainFile, namespace: str) -> _Reading:
    count, stop = _shared

    def advance(amount: float) -> None:
        if stop.is_set():
            raise _StoppedError
        with count.get_lock():
            count.value += int(amount)

    return _read(path, bag, train_file, namespace, advance)
