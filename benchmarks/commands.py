# SPDX-License-Identifier: Apache-2.0
"""CPU time of whole commands, start-up included, beside the targets of the project."""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Final

from benchmarks.days import REPOSITORY, TRAIN_FILE, simulated_day, write_bag
from benchmarks.processes import command_cpu_s
from benchmarks.tables import Table

_ROUNDS: Final = 5
_HOURS: Final = 10
_TINY: Final = REPOSITORY / 'bags' / 'tiny'
_DAY: Final = REPOSITORY / 'bags' / 'yizhuang_day'


def measure() -> tuple[Table, ...]:
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
    rows = []
    for name, command, target in small:
        median_s = statistics.median(command_cpu_s(command) for _ in range(_ROUNDS))
        rows.append((name, f'{median_s:.2f}', target))
    with tempfile.TemporaryDirectory() as folder:
        bags, hours = _hours_of_bags(Path(folder))
        size = f'{len(bags)} bags of {hours:.1f} h together'
        fitted_s = sum(command_cpu_s(('fit', bag, '--train', TRAIN_FILE)) for bag in bags)
        rows.append((f'fit, one by one, {size}', f'{fitted_s:.1f}', '10'))
        rows.append((f'explain, {size}', f'{command_cpu_s(("explain", *bags, "--train", TRAIN_FILE)):.1f}', '10'))
    note = f'User and system time; medians of {_ROUNDS}, {_HOURS} hours once. Simulated days of seeds 1 to {len(bags)}.'
    return (Table('CPU time of commands, s', ('trainid', 'CPU s', 'target'), tuple(rows), note),)


def _hours_of_bags(folder: Path) -> tuple[list[Path], float]:
    """Write simulated days of ten hours together; return the bags and their duration [h]."""
    bags: list[Path] = []
    hours = 0.0
    while hours < _HOURS:
        records = simulated_day(len(bags) + 1).records
        bags.append(write_bag(folder / f'day{len(bags) + 1}', records))
        hours += (records[-1].stamp_ns - records[0].stamp_ns) / 3.6e12
    return bags, hours
