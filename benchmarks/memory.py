# SPDX-License-Identifier: Apache-2.0
"""Memory over 24 h of input at 5 Hz: all three pipelines in one fresh process.

The records of one simulated day are repeated with shifted stamps; no bag is involved.
"""

from __future__ import annotations

import gc
import resource
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from benchmarks.days import assumed_train, simulated_day
from benchmarks.tables import Table
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.interface.records import Record

_SEED: Final = 1
_HOURS: Final = (0.1, 1.0, 6.0, 24.0)
_SECONDS_PER_HOUR: Final = 3600
_ESTIMATORS: Final = ('filter bank', 'AM-VFF-RLS', 'GSMA')


@dataclass(frozen=True, slots=True)
class Reading:
    """Memory of the process [kB], its open files, and sizes of the saved states [bytes] after some hours of input."""

    hours: float
    samples: int
    resident_kb: int
    open_files: int
    state_bytes: tuple[int, ...]


def measure() -> tuple[Table, ...]:
    """Run 24 h of input in a separate process; return the table."""
    with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
        readings = pool.submit(read_memory).result()
    first = readings[0].resident_kb
    header = (
        'after',
        'samples',
        'resident MB',
        'grown kB',
        'open files',
        *(f'{name} state, bytes' for name in _ESTIMATORS),
    )
    rows = tuple(
        (
            f'{reading.hours:g} h',
            str(reading.samples),
            f'{reading.resident_kb / 1024:.1f}',
            str(reading.resident_kb - first),
            str(reading.open_files),
            *(str(size) for size in reading.state_bytes),
        )
        for reading in readings
    )
    note = 'The process holds the records of one day throughout; growth is relative to the first reading.'
    return (Table('Memory of three pipelines over 24 h at 5 Hz', header, rows, note),)


def read_memory() -> tuple[Reading, ...]:
    """Push 24 h of records and read the memory at intervals."""
    train, settings = assumed_train(), EstimatorSettings()
    pipelines: tuple[EstimatorPipeline[Any], ...] = (
        resistance_pipeline(train, settings),
        speed_model_pipeline(train, settings),
        brake_rate_pipeline(train, settings),
    )
    day = simulated_day(_SEED)
    start_ns, due, readings = day.records[0].stamp_ns, list(_HOURS), []
    for record in repeated(day.records, round(day.duration_s * NS_PER_S)):
        for pipeline in pipelines:
            pipeline.push(record)
        if record.stamp_ns - start_ns >= due[0] * _SECONDS_PER_HOUR * NS_PER_S:
            readings.append(_read(due.pop(0), pipelines))
            # Printed at once, because the last reading takes minutes and the run may be interrupted.
            print(readings[-1], flush=True)
            if not due:
                break
    return tuple(readings)


def repeated(records: tuple[Record, ...], period_ns: int) -> Iterator[Record]:
    """Yield records for ever, shifted by a period [ns] each time."""
    shift_ns = 0
    while True:
        for record in records:
            yield replace(record, stamp_ns=record.stamp_ns + shift_ns)
        shift_ns += period_ns


def _read(hours: float, pipelines: tuple[EstimatorPipeline[Any], ...]) -> Reading:
    gc.collect()
    sizes = tuple(len(pipeline.estimator.save().encode()) for pipeline in pipelines)
    return Reading(hours, pipelines[0].samples, resident_kb('self'), open_files('self'), sizes)


def resident_kb(process: int | str) -> int:
    """Return the memory of a process [kB]."""
    pages = int(Path(f'/proc/{process}/statm').read_text(encoding='ascii').split()[1])
    return pages * resource.getpagesize() // 1024


def open_files(process: int | str) -> int:
    """Return the number of open file descriptors of a process."""
    return sum(1 for _ in Path(f'/proc/{process}/fd').iterdir())
