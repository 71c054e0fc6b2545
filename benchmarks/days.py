# SPDX-License-Identifier: Apache-2.0
"""The simulated day on the Yizhuang line as records, ticks and aligned samples."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.yizhuang_day import yizhuang_day
from trainid_ros.interface.records import Record
from trainid_ros.sim.scenario import Simulation, simulate
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile, load_train_file

REPOSITORY: Final = Path(__file__).resolve().parents[1]
TRAIN_FILE: Final = REPOSITORY / 'config' / 'trains' / 'yizhuang.yaml'


@dataclass(frozen=True, slots=True)
class TickOfRecords:
    """The records since the last sample; the last record completes ``sample``."""

    records: tuple[Record, ...]
    sample: Sample


def assumed_train() -> TrainFile:
    """Return the train file given to the estimators."""
    return load_train_file(TRAIN_FILE)


@cache
def simulated_day(seed: int) -> Simulation:
    return simulate(yizhuang_day(assumed_train()), np.random.default_rng(seed))


def write_bag(path: Path, records: Iterable[Record]) -> Path:
    """Write records as a bag; return its path."""
    from trainid_ros.bag.writer import BagWriter  # noqa: PLC0415 (not all that use this module have it)

    with BagWriter(path) as writer:
        for record in records:
            writer.write_record(record)
    return path


def ticks_of(records: Iterable[Record]) -> tuple[TickOfRecords, ...]:
    """Return the records grouped by the sample they complete."""
    aligner, ticks, waiting = Aligner(AlignmentConfig()), [], []
    for record in records:
        waiting.append(record)
        for event in aligner.push(record):
            if isinstance(event, Sample):
                ticks.append(TickOfRecords(tuple(waiting), event))
                waiting = []
    return tuple(ticks)


def samples_of(records: Iterable[Record]) -> tuple[Sample, ...]:
    return tuple(tick.sample for tick in ticks_of(records))
