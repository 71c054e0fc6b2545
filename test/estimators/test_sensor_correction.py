# SPDX-License-Identifier: Apache-2.0
"""Correction of records for sensor errors in the train file."""

from __future__ import annotations

import math

from trainid_ros.core.alignment import AlignmentConfig
from trainid_ros.core.records import ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.estimators.sensor_correction import SensorCorrection
from trainid_ros.train.train_file import Effect

WHEEL = (Effect('wheel_diameter', (('ratio', 1.05),)),)
SKEW = (Effect('stamp_skew', (('delay', 0.4),)),)


def test_without_effects_records_are_unchanged() -> None:
    record = SpeedRecord(7, 10.0, 500.0)
    assert SensorCorrection(()).correct(record) is record
    assert SensorCorrection(()).widen(AlignmentConfig()) == AlignmentConfig()


def test_speed_and_distance_since_the_last_stop_are_divided_by_the_ratio() -> None:
    correction = SensorCorrection(WHEEL)
    assert correction.correct(SpeedRecord(1, 0.0, 500.0)) == SpeedRecord(1, 0.0, 500.0)
    assert correction.correct(SpeedRecord(2, 21.0, 605.0)) == SpeedRecord(2, 20.0, 600.0)
    # At the next platform the position is correct again.
    assert correction.correct(SpeedRecord(3, 0.0, 2500.0)) == SpeedRecord(3, 0.0, 2500.0)
    assert correction.correct(SpeedRecord(4, 21.0, 2290.0)) == SpeedRecord(4, 20.0, 2300.0)
    correction.reset()
    assert correction.correct(SpeedRecord(5, 21.0, 9000.0)).position == 9000.0  # type: ignore[union-attr]


def test_an_unknown_position_stays_unknown_and_is_not_kept() -> None:
    correction = SensorCorrection(WHEEL)
    record = correction.correct(SpeedRecord(1, 0.0, math.nan))
    assert isinstance(record, SpeedRecord)
    assert math.isnan(record.position)
    assert correction.correct(SpeedRecord(2, 21.0, 700.0)) == SpeedRecord(2, 20.0, 700.0)


def test_only_the_stamps_of_the_force_are_corrected() -> None:
    correction = SensorCorrection(SKEW)
    assert correction.correct(ForceRecord(10**9, 3.0)) == ForceRecord(6 * 10**8, 3.0)
    assert correction.correct(ForceRecord(0, 3.0)) == ForceRecord(0, 3.0)
    gradient = GradientRecord(10**9, 3.0, 0.0, False)
    assert correction.correct(gradient) is gradient
    assert correction.widen(AlignmentConfig(max_lag=0.3)).max_lag == 0.7
