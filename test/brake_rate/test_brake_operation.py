# SPDX-License-Identifier: Apache-2.0
"""Brakes as trains have them: a holding brake at standstill, and electric brakes blended with pneumatic ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.interface.records import ForceRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Status
from trainid_ros.setup.pipelines import BRAKE_RATE, EstimatorSettings, brake_rate_pipeline
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import TrainFile

USABLE = frozenset({Status.VALID, Status.HOLDING})


def test_nothing_is_learned_from_commands_to_a_standing_train(
    train_file: TrainFile, sample: Callable[..., Sample]
) -> None:
    estimator = BRAKE_RATE.make(BRAKE_RATE.choose(), train_file, np.random.default_rng(1))
    before = estimator.estimate(0.0)
    std = before.brake_rate_std
    for k in range(500):
        command = (-0.6, -1.0, 0.0, -0.3)[k // 25 % 4]
        item = sample(k, speed=0.0, brake_command=command)
        item.brake_changes = (BrakeCommandChange(item.stamp_ns, command),) if k % 25 == 0 else ()
        rejection = estimator.step(item)
        assert rejection is not None
        assert rejection.reason is (Reason.GAP if k == 0 else Reason.STANDSTILL)
        now = estimator.estimate(0.0)
        assert now.brake_rate == before.brake_rate
        assert now.brake_rate_std >= std
        std = now.brake_rate_std


def electric(day: tuple[Record, ...], share: float, below: float) -> list[Record]:
    """Return the day with a share of the brake effort reported, which fades out below a speed [m/s]."""
    records: list[Record] = []
    speed = 0.0
    for record in day:
        if isinstance(record, SpeedRecord):
            speed = record.speed
        if isinstance(record, ForceRecord) and record.force < 0.0:
            left = min(1.0, max(0.0, 2.0 * speed / below - 1.0))
            records.append(replace(record, force=share * left * record.force))
        else:
            records.append(record)
    return records


# Where only a part is reported, its share must be learned before a change of it can be told from a fault.
@pytest.mark.parametrize(
    ('share', 'kept'),
    [
        (1.0, 0.95),
        pytest.param(0.6, 0.85, marks=pytest.mark.xfail(reason='the one check takes it for a force that is too small')),
    ],
)
def test_a_train_may_report_its_electric_brake_alone(
    metro: TrainFile, day: tuple[Record, ...], share: float, kept: float
) -> None:
    results = []
    for records in (day, electric(day, share, 3.5)):
        pipeline = brake_rate_pipeline(metro, EstimatorSettings())
        outputs = [output for record in records for output in pipeline.push(record)]
        assert pipeline.stream.last_finding == ''
        usable = sum(output.status in USABLE for output in outputs)
        results.append((usable, outputs[-1].estimate.brake_rate, outputs[-1].estimate.brake_rate_std))
    (whole, rate, std), (part, rate_by_part, _) = results
    assert rate_by_part == pytest.approx(rate, abs=std)
    assert part > kept * whole
