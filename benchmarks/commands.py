# SPDX-License-Identifier: Apache-2.0
"""CPU time of whole commands, start-up included, beside the targets of the project."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from benchmarks.days import REPOSITORY, TRAIN_FILE, simulated_day
from benchmarks.tables import Table
from trainid_ros.bag.writer import BagWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

_ROUNDS: Final = 5
_HOURS: Final = 10
_TINY: Final = REPOSITORY / 'bags' / 'tiny'
_DAY: Final = REPOSITORY / 'bags' / 'yizhuang_day'


def measure() -> tuple[Table, ...]:
    """Time all commands; return the table."""
    small: tuple[tuple[str, tuple[object, ...], str], ...] = (
        ('--help', ('--help',), '0.15'),
        ('replay --help', ('replay', '--help'), ''),
        ('fit --help', ('fit', '--help'), ''),
        ('explain --help', ('explain', '--help'), ''),
        ('info, tiny', ('info', _TINY), '0.6'),
        ('replay, tiny', ('replay', _TINY, '--train', _TINY / 'train.yaml'), '0.6'),
        ('info, yizhuang_day', ('info', _DAY), ''),
        ('replay, yizhuang_day', ('replay', _DAY, '--train', _DAY / 'train.yaml'), ''),
    )
    rows = [(name, f'{_median_s(command):.2f}', target) for name, command, target in small]
    with tempfile.TemporaryDirectory() as folder:
        bags, hours = _hours_of_bags(Path(folder))
        size = f'{len(bags)} bags of {hours:.1f} h together'
        fitted_s = sum(_cpu_s(('fit', bag, '--train', TRAIN_FILE)) for bag in bags)
        rows.append((f'fit, one by one, {size}', f'{fitted_s:.1f}', '10'))
        rows.append((f'explain, {size}', f'{_cpu_s(("explain", *bags, "--train", TRAIN_FILE)):.1f}', '10'))
    note = f'User and system time; medians of {_ROUNDS}, {_HOURS} hours once. Simulated days of seeds 1 to {len(bags)}.'
    return (Table('CPU time of commands, s', ('trainid', 'CPU s', 'target'), tuple(rows), note),)


def _hours_of_bags(folder: Path) -> tuple[list[Path], float]:
    """Write simulated days of ten hours together; return the bags and their duration [h]."""
    bags: list[Path] = []
    hours = 0.0
    while hours < _HOURS:
        day = simulated_day(len(bags) + 1)
        bags.append(folder / f'day{len(bags) + 1}')
        with BagWriter(bags[-1]) as writer:
            for record in day.records:
                writer.write_record(record)
        hours += (day.records[-1].stamp_ns - day.records[0].stamp_ns) / 3.6e12
    return bags, hours


def _median_s(command: Sequence[object]) -> float:
    return statistics.median(_cpu_s(command) for _ in range(_ROUNDS))


def _cpu_s(command: Sequence[object]) -> float:
    """Return the CPU time of a command in a process of its own [s]."""
    program = [sys.executable, '-m', 'trainid_ros.cli.main', *map(str, command)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(program, cwd=REPOSITORY, env=dict(os.environ), stdout=subprocess.DEVNULL, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):  # 1: the command worked, and found nothing to say
        raise RuntimeError(f'trainid {" ".join(map(str, command))}: exit code {done.returncode}')
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
