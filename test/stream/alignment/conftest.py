# SPDX-License-Identifier: Apache-2.0
"""Records of a short drive, and their alignment."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from test.stream.alignment.events import START, at, of
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.alignment import Aligner, AlignmentConfig, AlignmentEvent
from trainid_ros.stream.samples import Sample

CONFIG = AlignmentConfig()


def drive(seconds: float, *, start_s: float = 0.0, rate: float = 5.0) -> list[Record]:
    """Four topics, each with its own stamps; values are linear in time, so that interpolation is exact."""
    records: list[Record] = []
    for i in range(round(seconds * rate)):
        t = start_s + i / rate
        records += [
            ForceRecord(at(t - 0.02), 1000.0 * (t - 0.02)),
            GradientRecord(at(t - 0.03), 0.1 * (t - 0.03), 0.0, tunnel=False),
            BrakeRecord(at(t - 0.01), 0.0, emergency=False),
            SpeedRecord(at(t), 10.0 + 0.1 * t, 100.0 + 10.0 * t),
        ]
    return sorted(records, key=lambda record: record.stamp_ns)


def run(records: list[Record], config: AlignmentConfig = CONFIG, *, reject: bool = False) -> list[AlignmentEvent]:
    aligner = Aligner(config, reject_jump_back=reject)
    return [event for record in records for event in aligner.push(record)]


def reasons(events: list[AlignmentEvent]) -> Counter[Reason]:
    return Counter(rejection.reason for rejection in of(Rejection, events))


def arrivals(seed: int, lag_s: float) -> tuple[list[Record], list[Record]]:
    """Records with jittered stamps, in the order of stamps and in one of arrival.

    A topic keeps its order, and no record comes more than ``lag_s`` after the newest.
    """
    rng = np.random.default_rng(seed)
    records = [replace(r, stamp_ns=r.stamp_ns + int(rng.integers(-40_000_000, 40_000_000))) for r in drive(8.0)]
    records = [_other_command(r, rng) for r in records]
    records.sort(key=lambda record: record.stamp_ns)
    kinds: tuple[type[Record], ...] = (ForceRecord, GradientRecord, BrakeRecord, SpeedRecord)
    scale = {kind: rng.uniform(0.0, lag_s) for kind in kinds}
    came: dict[type[Record], float] = {}
    keyed: list[tuple[float, int, Record]] = []
    for i, record in enumerate(records):
        delay_ns = rng.uniform(0.0, scale[type(record)]) * NS_PER_S
        came[type(record)] = max(came.get(type(record), 0.0), record.stamp_ns + delay_ns)
        keyed.append((came[type(record)], i, record))
    return records, [record for _, _, record in sorted(keyed, key=lambda item: item[:2])]


def _other_command(record: Record, rng: np.random.Generator) -> Record:
    if isinstance(record, BrakeRecord):
        return replace(record, target_acceleration=-0.1 * int(rng.integers(3)))
    return record


def stopping(*, weighed_s: list[float]) -> list[Sample]:
    """At rest for 2 s, driving for 4 s, at rest for 4 s, driving again; the mass is weighed at some times."""
    records = [
        replace(record, speed=0.0 if t < 2.0 or 6.0 <= t < 10.0 else 8.0) if isinstance(record, SpeedRecord) else record
        for record in drive(14.0)
        for t in [(record.stamp_ns - START) / NS_PER_S]
    ]
    records += [MassRecord(at(t), 2e5) for t in weighed_s]
    return of(Sample, run(sorted(records, key=lambda record: record.stamp_ns)))


@pytest.fixture(scope='session', name='drive')
def _drive() -> Any:
    return drive


@pytest.fixture(scope='session', name='run')
def _run() -> Any:
    return run


@pytest.fixture(scope='session', name='reasons')
def _reasons() -> Any:
    return reasons


@pytest.fixture(scope='session', name='arrivals')
def _arrivals() -> Any:
    return arrivals


@pytest.fixture(scope='session', name='stopping')
def _stopping() -> Any:
    return stopping
