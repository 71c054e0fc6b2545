# SPDX-License-Identifier: Apache-2.0
"""The converted freight run agrees with its ground truth: an independent check of signs, units and stamps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import Output, ResistanceEstimate, Status
from trainid_ros.setup.pipelines import EstimatorSettings, resistance_pipeline
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import load_train_file

BAG = Path(__file__).parents[2] / 'bags' / 'altrios_manifest'
WINDOW = 50  # samples, 10 s


@pytest.fixture(scope='module')
def by_type() -> dict[type[Record], list[Record]]:
    found: dict[type[Record], list[Record]] = {}
    with BagReader(BAG) as reader:
        assert reader.warnings == []
        for record in reader.records():
            found.setdefault(type(record), []).append(record)
    return found


def column(records: list[Record], name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([getattr(record, name) for record in records], dtype=np.float64)


def test_forces_balance_with_the_true_resistance(by_type: dict[type[Record], list[Record]]) -> None:
    train = load_train_file(BAG / 'train.yaml')
    davis = load_truth(BAG / 'truth.yaml').truth_at(0.0).resistance
    ((_, coefficient),) = train.effects[0].parameters
    speed, brake = column(by_type[SpeedRecord], 'speed'), column(by_type[BrakeRecord], 'target_acceleration')
    gradient, radius = column(by_type[GradientRecord], 'gradient'), column(by_type[GradientRecord], 'curve_radius')
    known = {record.stamp_ns: record.force for record in by_type[ForceRecord] if isinstance(record, ForceRecord)}
    force = np.array([known.get(record.stamp_ns, np.nan) for record in by_type[GradientRecord]])
    curve = np.divide(coefficient, radius, out=np.zeros_like(radius), where=radius > 0.0)
    dt = WINDOW * (by_type[SpeedRecord][1].stamp_ns - by_type[SpeedRecord][0].stamp_ns) / NS_PER_S
    errors = []
    for i in range(0, len(speed) - WINDOW - 1, WINDOW):
        steps = slice(i + 1, i + WINDOW + 1)  # those between speed i and speed i + WINDOW
        if (brake[steps] < 0.0).any():
            continue
        pull = 1000.0 * force[steps].mean() / (train.train.mass * G) - gradient[steps].mean() - curve[steps].mean()
        inertia = 1000.0 * (1.0 + train.train.rotary_mass) * (speed[i + WINDOW] - speed[i]) / dt / G
        v = speed[i : i + WINDOW + 1]
        errors.append(pull - inertia - (davis.a + davis.b * v.mean() + davis.c * np.square(v).mean()))
    assert len(errors) > 200
    # Speed noise of 0.05 m/s at both ends of 10 s makes 0.74 N/kN; the mean over the windows has a tenth of that.
    assert np.nanstd(errors) < 1.0
    assert abs(np.nanmean(errors)) < 0.15


def test_while_valid_the_std_was_below_three_times_the_limit_within_the_last_second() -> None:
    pipeline = resistance_pipeline(load_train_file(BAG / 'train.yaml'), EstimatorSettings())
    outputs: list[Output[ResistanceEstimate]] = []
    with BagReader(BAG) as reader:
        for _, row in reader.rows():
            pipeline.take(pipeline.stream.push_row(*row), outputs.append)
    held_ns, valid = 0, 0
    for output in outputs:
        estimate = output.estimate
        if estimate.resistance_std < 3.0 * math.hypot(0.15, 0.05 * estimate.resistance):
            held_ns = output.stamp_ns
        if output.status is Status.VALID:
            valid += 1
            assert output.stamp_ns - held_ns <= NS_PER_S
    assert valid > 1000


def test_the_train_file_deviates_as_documented() -> None:
    truth = load_truth(BAG / 'truth.yaml').truth_at(0.0).resistance
    nominal = load_train_file(BAG / 'train.yaml').resistance
    ratios = (nominal.a / truth.a, nominal.b / truth.b, nominal.c / truth.c)
    assert ratios == pytest.approx((1.2, 0.8, 1.2), rel=1e-3)


def test_bag_stays_small() -> None:
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 3_500_000
