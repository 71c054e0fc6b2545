# SPDX-License-Identifier: Apache-2.0
"""Memory over 24 h of input at 5 Hz: all three pipelines in one fresh process.

The records of one simulated day are repeated with shifted stamps; no bag is involved.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

from benchmarks.days import assumed_train, simulated_day
from benchmarks.processes import open_files, resident_kb
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings

_SEED: Final = 1
_HOURS: Final = (0.1, 1.0, 6.0, 24.0)
_SECONDS_PER_HOUR: Final = 3600


class Reading(NamedTuple):
    """Memory of the process [kB], its open files, and sizes of the saved states [bytes] after some hours of input."""

    hours: float
    samples: int
    resident_kb: int
    open_files: int
    state_bytes: tuple[int, ...]


def measure() -> tuple[Table, ...]:
    """Run 24 h of input in a separate process; return the table."""
    (readings,) = over_seeds(read_memory, [_SEED])
    states = (f'{name} state, bytes' for name in ('filter bank', 'AM-VFF-RLS', 'GSMA'))
    header = ('after', 'samples', 'resident MB', 'grown kB', 'open files', *states)
    rows = tuple(
        (
            f'{hours:g} h',
            str(samples),
            f'{memory_kb / 1024:.1f}',
            str(memory_kb - readings[0].resident_kb),
            str(files),
            *map(str, sizes),
        )
        for hours, samples, memory_kb, files, sizes in readings
    )
    note = 'The process holds the records of one day throughout; growth is relative to the first reading.'
    return (Table('Memory of three pipelines over 24 h at 5 Hz', header, rows, note),)


def read_memory(seed: int) -> tuple[Reading, ...]:
    """Push 24 h of records of a day and read the memory at intervals."""
    train, settings = assumed_train(), EstimatorSettings()
    pipelines = [kind.pipeline(train, settings) for kind in KINDS]
    day = simulated_day(seed)
    start_ns, due, readings = day.records[0].stamp_ns, list(_HOURS), list[Reading]()
    for record in repeated(day.records, round(day.duration_s * NS_PER_S)):
        for pipeline in pipelines:
            pipeline.push(record)
        if record.stamp_ns - start_ns >= due[0] * _SECONDS_PER_HOUR * NS_PER_S:
            gc.collect()
            sizes = tuple(len(pipeline.estimator.save().encode()) for pipeline in pipelines)
            memory = resident_kb('self'), open_files('self')
            readings.append(Reading(due.pop(0), pipelines[0].samples, *memory, sizes))
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
