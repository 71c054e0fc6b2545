# SPDX-License-Identifier: Apache-2.0
"""The known part of the force balance against values computed by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Motion, Sample
from trainid_ros.train.train_file import Effect, Line, TrainFile

Make = Callable[..., Sample]


def test_inertia_by_hand(train_file: TrainFile) -> None:
    # 1000 * 1.08 / 9.80665
    assert KnownForce(train_file).inertia == pytest.approx(110.129351, abs=1e-6)


def test_traction_by_hand_with_the_train_files_and_a_weighed_mass(train_file: TrainFile, sample: Make) -> None:
    known = KnownForce(train_file)
    # 1000 * 98 066.5 N / (200 t * 9.80665) = 50 N/kN
    assert known.traction(98_066.5, sample(1)) == pytest.approx(50.0, rel=1e-12)
    assert known.traction(98_066.5, sample(1, mass=250e3)) == pytest.approx(40.0, rel=1e-12)


def test_the_gradient_counts_with_its_sign_and_as_the_mean(train_file: TrainFile, sample: Make) -> None:
    assert KnownForce(train_file).track(sample(1, gradient=99.0, gradient_mean=-7.5)) == -7.5


def with_effect(file: TrainFile, name: str, **parameters: float) -> KnownForce:
    return KnownForce(replace(file, effects=(Effect(name, tuple(parameters.items())),)))


def test_scales_of_force_and_mass_are_a_resistance_in_traction(train_file: TrainFile, sample: Make) -> None:
    pulling, coasting = sample(1, force_mean=98_066.5), sample(1)
    mass = with_effect(train_file, 'mass_error', ratio=1.25)
    gain = with_effect(train_file, 'traction_scale', ratio=0.9)
    # 50 N/kN for the train file's mass are 40 N/kN for the true one; 45 N/kN of 50 N/kN arrive.
    assert mass.extra(pulling) == pytest.approx(10.0, rel=1e-12)
    assert gain.extra(pulling) == pytest.approx(5.0, rel=1e-12)
    assert mass.extra(coasting) == gain.extra(coasting) == 0.0
    # The reported force itself is unchanged.
    assert mass.traction(98_066.5, pulling) == pytest.approx(50.0, rel=1e-12)


@pytest.mark.parametrize('name', ['mass_error', 'traction_scale'])
def test_a_missing_force_is_no_traction(name: str, train_file: TrainFile, sample: Make) -> None:
    """Such a sample is rejected; it must not end the run."""
    assert with_effect(train_file, name, ratio=1.1).extra(sample(1, force_mean=math.nan)) == 0.0


def test_a_reported_brake_force_is_not_traction(train_file: TrainFile, sample: Make) -> None:
    gain = with_effect(train_file, 'traction_scale', ratio=0.9)
    braking = sample(1, force_mean=-98_066.5, motion=Motion(brake=-0.5))
    assert gain.extra(braking) == 0.0


@pytest.mark.parametrize(
    ('name', 'parameters', 'share'),
    [
        ('brake_scale', {'ratio': 0.8}, 0.8),
        ('brake_fade', {'loss': 0.4, 'energy': 200.0}, 0.8),
        ('mass_error', {'ratio': 1.25}, 0.8),
        # A delay does not reduce the brake force, and drag is not brake force.
        ('brake_delay', {'extra': 0.5}, 1.0),
        ('dragging_brake', {'permille': 3.0, 'time': 5.0}, 1.0),
        ('headwind', {'speed': 5.0}, 1.0),
    ],
)
@pytest.mark.parametrize('brake', [0.0, -0.7])
def test_the_brake_share_left_by_effects(
    name: str, parameters: dict[str, float], share: float, brake: float, train_file: TrainFile, sample: Make
) -> None:
    known = with_effect(train_file, name, **parameters)
    at = sample(1, motion=Motion(heat=100.0, since_release=2.0, brake=brake))
    assert known.brake_share(at) == pytest.approx(share, rel=1e-12)
    assert KnownForce(train_file).brake_share(at) == 1.0
    # The share is also known without a force.
    assert known.brake_share(replace(at, force_mean=math.nan)) == pytest.approx(share, rel=1e-12)


def test_a_shifted_map_is_read_at_the_correct_place(train_file: TrainFile, sample: Make) -> None:
    line = Line(gradient=((0.0, 0.0), (980.0, 10.0)))
    shift = with_effect(replace(train_file, line=line), 'map_shift', distance=20.0)
    # Of the 100 m train at 1003 m a share of 0.23 is on the slope; 20 m before 0.03 was.
    assert shift.extra(sample(1, gradient_mean=2.3)) == pytest.approx(-2.0, rel=1e-9)
    # Without a line or a position there is no correction.
    assert shift.extra(sample(1, gradient_mean=2.3, position=math.nan)) == 0.0
    assert with_effect(train_file, 'map_shift', distance=20.0).extra(sample(1, gradient_mean=2.3)) == 0.0


def test_effects_depend_on_the_drive_so_far(train_file: TrainFile, sample: Make) -> None:
    step = with_effect(train_file, 'resistance_step', time=3600.0, a=0.25)
    warm = with_effect(train_file, 'bearing_warmup', value=5.0, distance=1e4)
    drag = with_effect(train_file, 'dragging_brake', permille=3.0, time=5.0)
    early = sample(1, motion=Motion(time_s=3599.0, distance_run=0.0, since_release=4.0))
    late = sample(1, motion=Motion(time_s=3601.0, distance_run=1e4, since_release=6.0))
    assert (step.extra(early), step.extra(late)) == (0.0, 0.25)
    assert (warm.extra(early), warm.extra(late)) == pytest.approx((5.0, 5.0 / math.e))
    assert (drag.extra(early), drag.extra(late)) == (3.0, 0.0)


def test_effects_of_the_train_file_are_known_resistance(train_file: TrainFile, sample: Make) -> None:
    effects = (
        Effect('curve_resistance', (('coefficient', 600.0),)),
        Effect('tunnel_drag', (('factor', 2.0),)),
        # For samples without drive history: the step has set in, the warm-up is over.
        Effect('resistance_step', (('time', 3600.0), ('a', 0.25))),
        Effect('bearing_warmup', (('value', 5.0), ('distance', 1e4))),
    )
    known = KnownForce(replace(train_file, effects=effects))
    # 600 / 400 + 0.004 * 15^2 + 0.25
    assert known.extra(sample(1, curve_radius=400.0, tunnel=True)) == pytest.approx(1.5 + 0.9 + 0.25, rel=1e-12)
    assert known.extra(sample(1)) == pytest.approx(0.25, rel=1e-12)
    assert known.track(sample(1, gradient_mean=2.0)) == pytest.approx(2.25, rel=1e-12)


def test_curve_resistance_follows_the_mean_curvature(train_file: TrainFile, sample: Make) -> None:
    known = with_effect(train_file, 'curve_resistance', coefficient=600.0)
    # 600 / 400 at the stamp; 600 / 800 where half of the interval was straight; nothing where all of it was.
    assert known.extra(sample(1, curve_radius=400.0)) == pytest.approx(1.5, rel=1e-12)
    assert known.extra(sample(1, curve_radius=400.0, curvature_mean=1.0 / 800.0)) == pytest.approx(0.75, rel=1e-12)
    assert known.extra(sample(1, curve_radius=400.0, curvature_mean=0.0)) == 0.0
    assert known.extra(sample(1, curve_radius=0.0, curvature_mean=1.0 / 800.0)) == pytest.approx(0.75, rel=1e-12)
    # Practically straight.
    assert known.extra(sample(1, curvature_mean=1e-300)) == pytest.approx(0.0, abs=1e-12)


def test_wind_and_gradient_errors_follow_the_direction(train_file: TrainFile, sample: Make) -> None:
    wind = KnownForce(replace(train_file, effects=(Effect('headwind', (('speed', 5.0),)),)))
    # 0.004 * (20^2 - 15^2) and 0.004 * (10^2 - 15^2)
    assert wind.extra(sample(1)) == pytest.approx(0.7, rel=1e-12)
    assert wind.extra(sample(1, direction=-1)) == pytest.approx(-0.5, rel=1e-12)
    error = Effect('gradient_error', (('start', 900.0), ('end', 1003.0), ('permille', 2.0)))
    # The train of 100 m covers 903 to 1003 m upwards, 1003 to 1103 m downwards.
    place = KnownForce(replace(train_file, effects=(error,)))
    assert place.extra(sample(1)) == pytest.approx(2.0)
    assert place.extra(sample(1, direction=-1)) == 0.0


def test_air_drag_per_weight_falls_with_the_load(train_file: TrainFile, sample: Make) -> None:
    known = KnownForce(replace(train_file, train=replace(train_file.train, c_by_weight=0.5)))
    # Half of c v^2 = 0.004 * 225 N/kN is by 1/weight: 0.45 * (200 / 250 - 1).
    loaded = sample(1, mass=250e3, gradient_mean=3.0)
    assert known.extra(loaded) == pytest.approx(-0.09, rel=1e-9)
    assert known.track(loaded) == pytest.approx(2.91, rel=1e-9)
    assert known.extra(sample(1)) == 0.0  # not weighed
    assert KnownForce(train_file).extra(loaded) == 0.0
