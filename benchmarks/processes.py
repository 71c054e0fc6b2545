# SPDX-License-Identifier: Apache-2.0
"""CPU time, memory and open files of processes, and of a command with its workers."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.days import REPOSITORY

TRAINID: Final = (sys.executable, '-m', 'trainid_ros.cli.main')
_EVERY_S: Final = 0.5
_START_S: Final = 30.0
# Workers start with loading modules; their memory counts from this share of the time on.
_EARLY: Final = 0.2
# As docs/fleet.md says: what the profiler of a worker samples all the time fills its memory.
_NO_PROFILER: Final = {'DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED': 'False'}


@dataclass(frozen=True, slots=True)
class Cost:
    """Time of a command with all its processes [s], and private memory of its largest worker [MB]."""

    cpu_s: float
    wall_s: float
    memory_early_mb: float
    memory_late_mb: float
    memory_most_mb: float


def measure_command(command: Sequence[str], others: Sequence[int] = ()) -> Cost:
    """Run a command, which must succeed; ``others`` work for it, workers last, else its children are its workers."""
    before = sum(cpu_s(other) for other in others)
    start, readings = time.perf_counter(), [(0.0, 0.0)]
    cpu = os.times()
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            workers = others[1:] or _children(process.pid)
            memory = max((_private_mb(worker) for worker in workers), default=0.0)
            readings.append((time.perf_counter() - start, memory))
            time.sleep(_EVERY_S)
    wall_s, after = time.perf_counter() - start, os.times()
    if process.returncode:
        raise RuntimeError(f'{" ".join(command)}: exit code {process.returncode}')
    spent_s = after.children_user + after.children_system - cpu.children_user - cpu.children_system
    spent_s += sum(cpu_s(other) for other in others) - before
    memories = [memory for at, memory in readings if at > _EARLY * wall_s and memory]
    return Cost(spent_s, wall_s, *((memories[0], memories[-2], max(memories)) if len(memories) > 1 else (0.0,) * 3))


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, list[int]]]:
    """Run a Dask scheduler and workers; yield its address and the processes, the scheduler first."""
    dask = [sys.executable, '-m', 'distributed.cli.dask_scheduler', '--host', '127.0.0.1', '--port', '0']
    started: list[subprocess.Popen[str]] = []
    try:
        scheduler = subprocess.Popen(
            [*dask, '--no-dashboard'], cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        started.append(scheduler)
        address = _address(scheduler)
        for _ in range(workers):
            worker = [sys.executable, '-m', 'distributed.cli.dask_worker', address, '--nthreads', '1', '--no-nanny']
            started.append(
                subprocess.Popen(
                    [*worker, '--no-dashboard'], cwd=REPOSITORY, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                    text=True, env=os.environ | _NO_PROFILER,
                )
            )  # fmt: skip
        time.sleep(5.0)
        yield address, [process.pid for process in started]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


def _address(scheduler: subprocess.Popen[str]) -> str:
    end = time.monotonic() + _START_S
    while time.monotonic() < end and scheduler.stdout is not None:
        if match := re.search(r'tcp://[\d.]+:\d+', scheduler.stdout.readline()):
            return match.group()
    raise RuntimeError('the scheduler does not start')


def _children(process: int) -> list[int]:
    try:
        text = Path(f'/proc/{process}/task/{process}/children').read_text(encoding='ascii')
        found = [int(child) for child in text.split()]
        return [c for c in found if 'spawn_main' in Path(f'/proc/{c}/cmdline').read_text(encoding='utf-8')]
    except OSError:
        return []


def _private_mb(process: int) -> float:
    try:
        text = Path(f'/proc/{process}/smaps_rollup').read_text(encoding='ascii')
    except OSError:
        return 0.0
    return sum(int(kb) for kb in re.findall(r'Private_\w+:\s+(\d+)', text)) / 1024.0


def cpu_s(process: int) -> float:
    """Return user and system time of a process, all threads [s]."""
    fields = Path(f'/proc/{process}/stat').read_text(encoding='utf-8').rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def command_cpu_s(command: Sequence[object]) -> float:
    """Return the CPU time of ``trainid COMMAND``, start-up included [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*TRAINID, *map(str, command)], cwd=REPOSITORY, stdout=subprocess.DEVNULL, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):  # 1: the command worked, and found nothing to say
        raise RuntimeError(f'trainid {" ".join(map(str, command))}: exit code {done.returncode}')
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def resident_kb(process: int | str) -> int:
    """Return the memory of a process [kB]."""
    pages = int(Path(f'/proc/{process}/statm').read_text(encoding='ascii').split()[1])
    return pages * os.sysconf('SC_PAGESIZE') // 1024


def open_files(process: int | str) -> int:
    """Return the number of open file descriptors of a process."""
    return sum(1 for _ in Path(f'/proc/{process}/fd').iterdir())
