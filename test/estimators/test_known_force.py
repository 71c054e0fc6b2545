# SPDX-License-Identifier: Apache-2.0
"""The known part of the balance by hand-computed values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.core.samples import Sample
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.physics.train_file import Effect, TrainFile

Make = Callable[..., Sample]


def test_inertia_by_hand(train_file: TrainFile) -> None:
    # 1000 * 1.08 / 9.80665
    assert KnownForce(train_file).inertia == pytest.approx(110.129351, abs=1e-6)


def test_traction_by_hand_with_believed_and_weighed_mass(train_file: TrainFile, sample: Make) -> None:
    known = KnownForce(train_file)
    # 1000 * 98 066.5 N / (200 t * 9.80665) = 50 N/kN
    assert known.traction(98_066.5, sample(1)) == pytest.approx(50.0, rel=1e-12)
    assert known.traction(98_066.5, sample(1, mass=250e3)) == pytest.approx(40.0, rel=1e-12)


def test_the_gradient_counts_with_its_sign_and_as_the_mean(train_file: TrainFile, sample: Make) -> None:
    assert KnownForce(train_file).track(sample(1, gradient=99.0, gradient_mean=-7.5)) == -7.5


def test_effects_of_the_train_file_are_known_resistance(train_file: TrainFile, sample: Make) -> None:
    effects = (
        Effect('curve_resistance', (('coefficient', 600.0),)),
        Effect('tunnel_drag', (('factor', 2.0),)),
        # Set in at some time, worn off with distance: both hold as at the end.
        Effect('resistance_step', (('time', 3600.0), ('a', 0.25))),
        Effect('bearing_warmup', (('value', 5.0), ('distance', 1e4))),
    )
    known = KnownForce(replace(train_file, effects=effects))
    # 600 / 400 + 0.004 * 15^2 + 0.25
    assert known.extra(sample(1, curve_radius=400.0, tunnel=True)) == pytest.approx(1.5 + 0.9 + 0.25, rel=1e-12)
    assert known.extra(sample(1)) == pytest.approx(0.25, rel=1e-12)
    assert known.track(sample(1, gradient_mean=2.0)) == pytest.approx(2.25, rel=1e-12)


def test_wind_and_place_follow_the_direction(train_file: TrainFile, sample: Make) -> None:
    wind = KnownForce(replace(train_file, effects=(Effect('headwind', (('speed', 5.0),)),)))
    # 0.004 * (20^2 - 15^2) and 0.004 * (10^2 - 15^2)
    assert wind.extra(sample(1)) == pytest.approx(0.7, rel=1e-12)
    assert wind.extra(sample(1, direction=-1)) == pytest.approx(-0.5, rel=1e-12)
    error = Effect('gradient_error', (('start', 900.0), ('end', 1003.0), ('permille', 2.0)))
    # The train of 100 m covers 903 to 1003 m upwards, 1003 to 1103 m downwards.
    place = KnownForce(replace(train_file, effects=(error,)))
    assert place.extra(sample(1)) == pytest.approx(2.0)
    assert place.extra(sample(1, direction=-1)) == 0.0
