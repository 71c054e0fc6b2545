# SPDX-License-Identifier: Apache-2.0
"""Pipelines fed at 1 to 5 Hz, each topic at its own rate: timeouts follow the rate, and the estimators learn."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

import pytest

from test.estimators.makers import NAMES, make, run
from trainid_ros.interface.records import (
    FORCE,
    NS_PER_S,
    SPEED,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.interface.results import Status
from trainid_ros.train.train_file import TrainFile

Records = tuple[Record, ...]
Rates = dict[type[Record], float]
KINDS = (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)
ALL_SLOW: Rates = dict.fromkeys(KINDS, 1.0)
LEARNED_S = 20.0


def seconds_of(record: Record, records: Records) -> float:
    return (record.stamp_ns - records[0].stamp_ns) / NS_PER_S


def at_rates(records: Records, rates: Rates, low: float = 0.0, high: float = math.inf) -> Iterator[Record]:
    """Yield records at 5 Hz, some topics thinned to a lower rate, each with its own phase."""
    count: Counter[type[Record]] = Counter()
    for record in records:
        kind, t = type(record), seconds_of(record, records)
        count[kind] += 1
        keep = round(5.0 / rates.get(kind, 5.0))
        phase = KINDS.index(kind) if kind in KINDS else 0
        if low <= t < high and (count[kind] + phase) % keep == 0:
            yield record


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize(
    'rates',
    [
        ALL_SLOW,
        dict.fromkeys(KINDS, 2.5),
        {SpeedRecord: 1.0},
        {BrakeRecord: 1.0},
        {ForceRecord: 1.0, GradientRecord: 1.0},
        {ForceRecord: 2.5, GradientRecord: 1.0},
    ],
    ids=['all 1', 'all 2.5', 'speed 1', 'brake 1', 'force gradient 1', 'force 2.5 gradient 1'],
)
def test_inputs_of_any_rate_are_not_missing(name: str, rates: Rates, metro: TrainFile, day: Records) -> None:
    pipeline = make(name, metro)
    run(pipeline, at_rates(day, rates, 0.0, LEARNED_S))
    used = pipeline.used
    outputs = run(pipeline, at_rates(day, rates, LEARNED_S, 120.0))
    assert len(outputs) > 95
    assert Status.STALE not in {output.status for output in outputs}
    # The train hardly brakes in these two minutes.
    assert name == 'brake_rate' or pipeline.used > used + 20


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('rate', [1.0, 2.5])
def test_the_timeout_of_a_slow_topic_follows_its_rate(
    kind: type[Record], rate: float, metro: TrainFile, day: Records
) -> None:
    pipeline, rates = make('resistance', metro), {kind: rate}
    run(pipeline, at_rates(day, rates, 0.0, 40.0))
    last_ns = max(r.stamp_ns for r in at_rates(day, rates, 0.0, 40.0) if isinstance(r, kind))
    became: int | None = None
    for record in at_rates(day, rates, 40.0, 50.0):
        if not isinstance(record, kind) and pipeline.push(record) and pipeline.status is Status.STALE:
            became = became or pipeline.newest_ns
    assert became is not None
    # 2.5 intervals and the lag allowed for a topic.
    assert (became - last_ns) / NS_PER_S == pytest.approx(2.5 / rate + 0.3, abs=0.25)
    outputs = run(pipeline, at_rates(day, rates, 50.0, 60.0))
    assert outputs[-1].status is not Status.STALE


def test_timeout_ns_follows_the_rate_of_the_topic(metro: TrainFile, day: Records) -> None:
    pipeline = make('resistance', metro)
    run(pipeline, at_rates(day, {ForceRecord: 1.0}, 0.0, LEARNED_S))
    assert pipeline.timeout_ns(FORCE) == pytest.approx(2.5 * NS_PER_S, rel=0.02)
    assert pipeline.timeout_ns(SPEED) == 0.8 * NS_PER_S
    pipeline.reset()
    assert pipeline.timeout_ns(FORCE) == 0.8 * NS_PER_S


@pytest.mark.parametrize('rates', [ALL_SLOW, {BrakeRecord: 1.0}], ids=['all 1', 'brake 1'])
def test_the_brake_rate_is_learned_at_one_record_per_second(rates: Rates, metro: TrainFile, day: Records) -> None:
    pipeline = make('brake_rate', metro)
    outputs = run(pipeline, at_rates(day, rates))
    valid = [o.estimate for o in outputs if o.status is Status.VALID]
    assert len(valid) > 30
    worst = max(abs(e.brake_rate - 1.0) / e.brake_rate_std for e in valid)
    assert worst < 3.5
    assert abs(valid[-1].brake_rate - 1.0) < 0.08
