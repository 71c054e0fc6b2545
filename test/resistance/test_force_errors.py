# SPDX-License-Identifier: Apache-2.0
"""Prior standard deviations of the force errors from a train file."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from trainid_ros.resistance.davis_posterior import ForceErrors, force_errors, scale_step
from trainid_ros.train.train_file import Davis, Effect, Train, TrainFile

FILE = TrainFile(Train(200e3, mass_std=0.03, force_std=0.02), Davis(1.5, 0.03, 0.004))


def test_the_scale_follows_mass_and_force_and_the_delay_its_setting() -> None:
    usual = force_errors(FILE, 0.15)
    assert usual.scale == pytest.approx(math.hypot(0.03, 0.02))
    assert usual.delay == 0.15
    known = force_errors(replace(FILE, train=replace(FILE.train, mass_std=0.002, force_std=0.003)), 0.15)
    assert known.scale == pytest.approx(math.hypot(0.002, 0.003))
    assert known.delay == 0.15  # the uncertainty of the force is independent of that of its stamps


def test_the_curve_has_its_stated_uncertainty_or_a_fifth() -> None:
    def curve(*effects: Effect) -> float:
        return force_errors(replace(FILE, effects=effects), 0.15).curve

    assert curve() == 0.5
    assert curve(Effect('curve_resistance', (('coefficient', 600.0),), (('coefficient', 60.0),))) == pytest.approx(0.1)
    assert curve(Effect('curve_resistance', (('coefficient', 600.0),))) == pytest.approx(0.2)
    assert curve(Effect('tunnel_drag', (('factor', 1.3),))) == 0.5


def test_no_prior_variance_is_zero() -> None:
    assert min(ForceErrors(0.0, 0.0, 0.0).variances) > 0.0


def test_a_stop_changes_the_scale_by_at_most_half_of_the_mass_std() -> None:
    assert scale_step(FILE.train, weighed=True) == 0.004
    assert scale_step(FILE.train, weighed=False) == 0.015
    assert scale_step(replace(FILE.train, mass_std=0.2), weighed=False) == 0.03
    assert scale_step(replace(FILE.train, mass_std=0.002), weighed=True) == 0.001
