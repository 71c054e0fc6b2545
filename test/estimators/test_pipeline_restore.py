# SPDX-License-Identifier: Apache-2.0
"""A pipeline restored from its saved state continues to the bit, whatever was going on when it was saved."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from test.estimators.makers import NAMES, make, run
from trainid_ros.estimators.pipeline import EstimatorPipeline, share_streams
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Status
from trainid_ros.train.train_file import Effect, TrainFile

ALL = pytest.mark.parametrize('name', NAMES)
Records = tuple[Record, ...]
EFFECTS = (
    Effect('wheel_diameter', (('ratio', 1.01),)),
    Effect('stamp_skew', (('delay', 0.1),)),
    Effect('brake_fade', (('loss', 0.1), ('energy', 300.0))),
)


def push(pipeline: EstimatorPipeline[Any], records: Iterable[Record]) -> list[str]:
    return [repr(output) for output in run(pipeline, records)]


@pytest.fixture(scope='module')
def faulty(day: Records) -> list[Record]:
    """Return four minutes of the day with a mass, and a fault in every quarter of a minute."""
    rng = np.random.default_rng(11)
    start_ns = day[0].stamp_ns
    records: list[Record] = [MassRecord(start_ns + 1, 201e3)]
    for at in day:
        record, t = at, (at.stamp_ns - start_ns) / NS_PER_S
        if t > 240.0:
            break
        phase = int(t // 15.0) % 8
        if isinstance(record, ForceRecord) and phase == 1 and t % 15.0 < 6.0:
            continue  # a dropout of one topic
        if phase == 2 and t % 15.0 < 4.0:
            continue  # of all
        if isinstance(record, SpeedRecord) and phase == 3 and t % 15.0 > 5.0:
            record = replace(record, speed=11.0)  # a stuck speed
        if isinstance(record, GradientRecord) and phase == 4 and rng.random() < 0.2:
            record = replace(record, gradient=math.nan)
        if phase == 5 and rng.random() < 0.05:
            records.append(record)  # a duplicate
        if phase == 6 and rng.random() < 0.1:
            record = replace(record, stamp_ns=record.stamp_ns + 50 * NS_PER_S)  # stray stamps, also two in a row
        records.append(record)
    return records


@pytest.mark.parametrize('name', [*NAMES, 'V-MILS'])
@pytest.mark.parametrize('effects', [(), EFFECTS], ids=['plain', 'effects'])
def test_restored_at_any_record_all_further_outputs_are_equal_to_the_bit(
    name: str, effects: tuple[Effect, ...], metro: TrainFile, faulty: list[Record]
) -> None:
    train_file = replace(metro, effects=effects)
    cuts = sorted(np.random.default_rng(7).choice(len(faulty), 12, replace=False).tolist())
    whole, saved, outputs = make(name, train_file), {}, [0]
    expected: list[str] = []
    for index, record in enumerate(faulty):
        if index in cuts:
            saved[index] = whole.save()
        expected += push(whole, [record])
        outputs.append(len(expected))
    assert {Reason.GAP, Reason.SPEED_STUCK, Reason.NOT_FINITE, Reason.DUPLICATE, Reason.STAMP_JUMP} <= {
        *whole.rejections
    } | ({Reason.GAP} if name != 'brake_rate' else set())
    for index in cuts:
        copy, end = make(name, train_file), min(index + 400, len(faulty))
        copy.restore(saved[index])
        assert copy.save() == saved[index]
        assert push(copy, faulty[index:end]) == expected[outputs[index] : outputs[end]]
    copy = make(name, train_file)
    copy.restore(saved[cuts[0]])
    push(copy, faulty[cuts[0] :])
    assert copy.save() == whole.save()
    assert repr(copy.consistency) == repr(whole.consistency)


@ALL
def test_an_interruption_without_loss_changes_nothing(name: str, metro: TrainFile, faulty: list[Record]) -> None:
    whole, interrupted = make(name, metro), make(name, metro)
    for index, record in enumerate(faulty[:2000]):
        if index % 97 == 0:
            interrupted.interrupt()
        assert push(interrupted, [record]) == push(whole, [record])


@ALL
@pytest.mark.parametrize('shift_s', [-1e5, -20.0, 1e5])
def test_on_another_drive_the_estimate_is_kept(name: str, shift_s: float, metro: TrainFile, day: Records) -> None:
    first = make(name, metro)
    push(first, day[:3000])
    later = [replace(r, stamp_ns=r.stamp_ns + round(shift_s * NS_PER_S)) for r in day[3000:4000]]
    second = make(name, metro)
    second.restore(first.save())
    outputs = push(second, later)
    assert len(outputs) > 150
    assert (second.resets, second.rejections[Reason.STAMP_JUMP]) == (0, 0)
    assert second.used > first.used
    assert second.samples >= first.samples + 200


def test_a_stray_first_stamp_does_not_cost_the_records_of_the_saved_state(metro: TrainFile, day: Records) -> None:
    first, second = make('resistance', metro), make('resistance', metro)
    push(first, day[:2000])
    second.restore(first.save())
    for pipeline in (first, second):
        pipeline.push(SpeedRecord(0, 3.0, 0.0))
        pipeline.push(SpeedRecord(-5, math.nan, 0.0))
    assert push(second, day[2000:2300]) == push(first, day[2000:2300])


@ALL
def test_the_age_widens_only_what_is_published_before_the_next_sample(
    name: str, metro: TrainFile, day: Records
) -> None:
    first = make(name, metro)
    push(first, day[:6000])
    text, now = first.save(), first.current()
    assert now.status in (Status.VALID, Status.HOLDING)
    variances = []
    for age_s in (0.0, 1.0, 60.0, 3600.0, 1e6):
        aged = make(name, metro)
        aged.restore(text, age_s)
        current = aged.current()
        assert (current.stamp_ns, current.used, current.rejected) == (now.stamp_ns, now.used, now.rejected)
        variances.append(variance(current.estimate))
        assert aged.save() == text.replace(f'"_status": {int(now.status)}', f'"_status": {int(current.status)}')
        push(aged, day[6000:6100])
        assert repr(aged.current()) == repr(run_on(name, metro, text, day[6000:6100]))
    assert variances == sorted(variances)
    assert variances[0] == variance(now.estimate) < variances[2] < variances[3]
    assert current.status is Status.CONVERGING


def run_on(name: str, train_file: TrainFile, text: str, records: Iterable[Record]) -> Any:
    pipeline = make(name, train_file)
    pipeline.restore(text)
    push(pipeline, records)
    return pipeline.current()


def variance(estimate: Any) -> float:
    if hasattr(estimate, 'brake_rate_std'):
        return float(estimate.brake_rate_std**2)
    size = math.isqrt(len(estimate.covariance))
    return float(sum(estimate.covariance[:: size + 1]))


def test_pipelines_restored_at_the_same_record_share_their_stream_again(metro: TrainFile, day: Records) -> None:
    pipelines = [make(name, metro) for name in NAMES]
    for pipeline in pipelines:
        push(pipeline, day[:1000])
    copies = [make(name, metro) for name in NAMES]
    for copy, pipeline in zip(copies, pipelines, strict=True):
        copy.restore(pipeline.save())
    assert len(share_streams(copies)) == 1
    push(pipelines[0], day[1000:1010])
    copies[0].restore(pipelines[0].save())
    assert len(share_streams(copies[:2])) == 2


def test_a_part_that_does_not_fit_is_named_and_changes_nothing(metro: TrainFile, day: Records) -> None:
    pipeline = make('speed_model', metro)
    push(pipeline, day[:1000])
    before = pipeline.save()
    state = json.loads(before)['state']
    for name in state:
        wrong = {'type': 'EstimatorPipeline', 'state': {**state, name: [{}]}}
        with pytest.raises(InputError, match=rf'saved EstimatorPipeline\.{name}\W'):
            pipeline.restore(json.dumps(wrong))
        assert pipeline.save() == before
    with pytest.raises(InputError, match='saved SpeedModelEstimator is a Gsma'):
        pipeline.restore(before.replace('SpeedModelEstimator', 'Gsma'))
    assert pipeline.save() == before
