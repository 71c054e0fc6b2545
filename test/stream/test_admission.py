# SPDX-License-Identifier: Apache-2.0
"""Admission: only complete samples of a moving train with the brake off."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from trainid_ros.interface.results import Reason
from trainid_ros.stream.known_force import Admission, KnownForce
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Effect, TrainFile

Make = Callable[..., Sample]
WEIGHT_KN = 200e3 * 9.80665 / 1000.0


@pytest.fixture
def admission(train_file: TrainFile) -> Admission:
    return Admission(KnownForce(train_file), min_speed=1.0)


def test_a_coasting_sample_is_admitted(admission: Admission, sample: Make) -> None:
    assert admission.reject(sample(1)) is None


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'dt': math.nan}, Reason.GAP),
        ({'force_mean': math.nan}, Reason.FORCE_MISSING),
        ({'force_mean': 1001.0 * WEIGHT_KN}, Reason.OUT_OF_RANGE),
        ({'force': 1001.0 * WEIGHT_KN}, Reason.OUT_OF_RANGE),
        ({'force_mean': -1001.0 * WEIGHT_KN}, Reason.OUT_OF_RANGE),
        ({'gradient_mean': math.nan}, Reason.GRADIENT_MISSING),
        ({'brake_command': math.nan}, Reason.BRAKE_COMMAND_MISSING),
        ({'speed': 0.999}, Reason.STANDSTILL),
        ({'speed': math.nan}, Reason.STANDSTILL),
        ({'brake_command': -0.01}, Reason.BRAKING),
        ({'emergency': True}, Reason.BRAKING),
        # A command was given and withdrawn between two samples.
        ({'brake_changes': (BrakeCommandChange(1, -0.5), BrakeCommandChange(2, 0.0))}, Reason.BRAKING),
        # A brake that was not commanded on this topic: -2 N/kN.
        ({'force_mean': -2.0 * WEIGHT_KN}, Reason.BRAKING),
        ({'force': -2.0 * WEIGHT_KN}, Reason.BRAKING),
    ],
)
def test_each_fault_is_rejected_with_its_reason(
    admission: Admission, sample: Make, fields: dict[str, Any], reason: Reason
) -> None:
    rejection = admission.reject(sample(1, **fields))
    assert rejection is not None
    assert rejection.reason is reason


def test_force_noise_while_coasting_is_not_braking(admission: Admission, sample: Make) -> None:
    # Four standard deviations of 0.3 N/kN.
    assert admission.reject(sample(1, force=-1.2 * WEIGHT_KN, force_mean=-1.2 * WEIGHT_KN)) is None


def test_samples_are_rejected_until_a_released_brake_has_settled(admission: Admission, sample: Make) -> None:
    # 0.6 s dead time and eight time constants of 0.4 s.
    assert admission.known.settling == pytest.approx(3.8)
    assert admission.reject(sample(1, brake_command=-0.5)) is not None
    admitted = {i: admission.reject(sample(i)) is None for i in range(2, 25)}
    # At exactly 3.8 s, in sample 20, rounding decides.
    assert not any(admitted[i] for i in range(2, 20))
    assert all(admitted[i] for i in range(21, 25))


def test_a_delayed_brake_takes_longer_to_settle(train_file: TrainFile) -> None:
    late = replace(train_file, effects=(Effect('brake_delay', (('extra', 0.5),)),))
    assert Admission(KnownForce(late), min_speed=1.0).known.settling == pytest.approx(4.3)


def test_a_gap_of_the_commands_counts_as_braking_until_settled(admission: Admission, sample: Make) -> None:
    admission.reject(sample(1, brake_gap=True))
    rejection = admission.reject(sample(2))
    assert rejection is not None
    assert rejection.reason is Reason.BRAKING
    assert admission.reject(sample(25)) is None


def test_an_unknown_command_counts_as_braking_until_settled(admission: Admission, sample: Make) -> None:
    admission.reject(sample(1, brake_command=math.nan))
    rejection = admission.reject(sample(2))
    assert rejection is not None
    assert rejection.reason is Reason.BRAKING
    assert rejection.value == pytest.approx(0.2)


def test_braking_in_another_time_base_is_forgotten(admission: Admission, sample: Make) -> None:
    admission.reject(sample(100_000, brake_command=-0.5))
    assert admission.reject(sample(1)) is None
