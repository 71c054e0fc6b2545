# SPDX-License-Identifier: Apache-2.0
"""Correction of records for sensor errors in the train file."""

from __future__ import annotations

import math

from trainid_ros.interface.records import FORCE, GRADIENT, SPEED
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import SensorCorrection
from trainid_ros.train.train_file import Effect

WHEEL = (Effect('wheel_diameter', (('ratio', 1.05),)),)
SKEW = (Effect('stamp_skew', (('delay', 0.4),)),)


def test_without_effects_no_correction_is_needed() -> None:
    assert not SensorCorrection(()).is_needed
    assert SensorCorrection(()).widen(AlignmentConfig()) == AlignmentConfig()


def test_speed_and_distance_since_the_last_stop_are_divided_by_the_ratio() -> None:
    correction = SensorCorrection(WHEEL)
    assert correction.is_needed
    assert correction.correct(SPEED, 1, 0.0, 500.0) == (1, 0.0, 500.0)
    assert correction.correct(SPEED, 2, 21.0, 605.0) == (2, 20.0, 600.0)
    # At the next platform the position is correct again.
    assert correction.correct(SPEED, 3, 0.0, 2500.0) == (3, 0.0, 2500.0)
    assert correction.correct(SPEED, 4, 21.0, 2290.0) == (4, 20.0, 2300.0)
    correction.reset()
    assert correction.correct(SPEED, 5, 21.0, 9000.0) == (5, 20.0, 9000.0)


def test_an_unknown_position_stays_unknown_and_is_not_kept() -> None:
    correction = SensorCorrection(WHEEL)
    assert math.isnan(correction.correct(SPEED, 1, 0.0, math.nan)[2])
    assert correction.correct(SPEED, 2, 21.0, 700.0) == (2, 20.0, 700.0)


def test_only_the_stamps_of_the_force_are_corrected() -> None:
    correction = SensorCorrection(SKEW)
    assert correction.is_needed
    assert correction.correct(FORCE, 10**9, 3.0, 0.0) == (6 * 10**8, 3.0, 0.0)
    assert correction.correct(FORCE, 0, 3.0, 0.0) == (0, 3.0, 0.0)
    assert correction.correct(GRADIENT, 10**9, 3.0, 400.0) == (10**9, 3.0, 400.0)
    assert correction.widen(AlignmentConfig(max_lag=0.3)).max_lag == 0.7
