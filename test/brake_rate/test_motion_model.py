# SPDX-License-Identifier: Apache-2.0
"""The motion model over one sample compared with the equations of the module, and the variances of an estimate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.brake_rate.motion_model import BLEND_SHAPE, BrakeStep, MotionModel, TimingStep, Transition
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = GsmaConfig()
DT, LAG = 0.2, 0.4
DECAY = math.exp(-DT / LAG)
REACH = LAG * (1.0 - DECAY)


def response(start: float, command: float) -> BrakeStep:
    """Return the response of a lag from a target to a command [m/s^2]."""
    return BrakeStep(DECAY, REACH, command * (1.0 - DECAY), command * (DT - REACH), start)


def interval(
    train_file: TrainFile,
    sample: Sample,
    motion: BrakeStep,
    gains: tuple[float, float] = (1.0, 1.0),
    config: GsmaConfig = CONFIG,
) -> Transition:
    return MotionModel(train_file, config).interval(
        sample,
        motion,
        TimingStep(0.0, 0.0, 0.0),
        rate=1.0,
        before=gains[0],
        gain=gains[1],
        variance=0.0,
        released=False,
    )


def test_steadiness_is_one_for_a_steady_response_and_small_for_others(train_file: TrainFile, sample: Make) -> None:
    item = sample(1, brake_command=-0.5)
    assert interval(train_file, item, response(-0.5, -0.5)).steadiness == pytest.approx(1.0)
    assert interval(train_file, item, response(0.0, -0.5)).steadiness < 1e-6
    # A relative change of a tenth per second.
    change = BrakeStep(1.0, DT, -0.01, 0.0, -0.49)
    assert interval(train_file, item, change).steadiness == pytest.approx(math.exp(-1.0))


def test_the_response_scales_with_a_change_of_the_table(train_file: TrainFile, sample: Make) -> None:
    """The brake acts with f r y, so the acceleration computed with the previous gain is scaled to the present one."""
    before, gain, f, start, command = 1.0, 0.6, 0.9, -0.5, -0.7
    motion = response(start, command)
    moved = interval(train_file, sample(1, brake_command=command), motion, (before, gain))
    a = f * before * start
    integral = REACH * start + command * (DT - REACH)
    assert moved.reach * a + moved.gain_v * f == pytest.approx(f * gain * integral, rel=1e-12)
    assert moved.decay * a + moved.gain_a * f == pytest.approx(f * gain * motion.end_target, rel=1e-12)


@pytest.mark.parametrize('speed', [CONFIG.blend_speed, 0.5 * CONFIG.blend_speed, 15.0])
def test_slope_changeover_and_level_errors_act_on_the_speed(train_file: TrainFile, sample: Make, speed: float) -> None:
    braked, gain = -0.5 * DT, 0.8
    item = sample(1, speed=speed, brake_command=-0.5)
    gains = interval(train_file, item, response(-0.5, -0.5), (gain, gain)).gain_e
    blend = {CONFIG.blend_speed: 1.0, 0.5 * CONFIG.blend_speed: 0.5}.get(speed, 0.0)
    slope = speed / train_file.train.max_speed - 0.5
    assert list(gains)[5:] == pytest.approx((gain * braked * slope, gain * braked * blend, -DT), rel=1e-12)
    # A weak brake has no level error.
    assert interval(train_file, item, response(-0.05, -0.05)).gain_e[7] == 0.0


def test_the_brake_rate_includes_the_level_error(train_file: TrainFile, sample: Make) -> None:
    """An error of 0.01 m/s^2 is an error of 0.02 in the brake rate at a level of 0.5 m/s^2."""
    model, item = MotionModel(train_file, CONFIG), sample(1, brake_command=-0.5)
    assert model.share(item, 0.5)[7] == pytest.approx(2.0)
    assert model.share(item, 0.05)[7] == 0.0
    assert not any(model.share(replace(item, brake_command=0.0), 0.5))


def braked(train_file: TrainFile, samples: list[Sample]) -> BrakeRateEstimator:
    estimator = Gsma(train_file, CONFIG, np.random.default_rng(1))
    for item in samples:
        estimator.step(item)
    assert estimator.state.observable
    return estimator


def test_a_changeover_adds_its_shape_error_to_the_std(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(12.0, brake=lambda t: -0.4 if t > 2.0 else 0.0, speed=6.0)
    slow = next(k for k, item in enumerate(samples) if item.speed < 1.1 * CONFIG.blend_speed)
    fast = next(k for k, item in enumerate(samples) if item.speed < 2.1 * CONFIG.blend_speed)
    during, before = braked(train_file, samples[: slow + 1]), braked(train_file, samples[:fast])
    shape = BLEND_SHAPE * CONFIG.blend_std
    for estimator, blending in ((during, shape), (before, 0.0)):
        state, e = estimator.state, estimator.estimate(0.0)
        modelled = state.rate_variance + (CONFIG.scale_std * state.rate) ** 2
        assert e.brake_rate_std**2 - modelled == pytest.approx(blending**2, abs=1e-12)


def test_excess_innovations_increase_the_noise(train_file: TrainFile, journey: Journey) -> None:
    """With three times the noise variance the gate widens accordingly and the brake rate is less certain."""
    samples = journey(10.0, brake=lambda t: -0.4 if t > 2.0 else 0.0, speed=15.0)
    plain = braked(train_file, samples[:30])
    other = braked(train_file, samples[:30])
    plain.state.excess, other.state.excess = 1.0, 3.0
    for estimator in (plain, other):
        estimator.step(samples[30])
    noise = plain.state.noise.variance
    assert other.state.innovation == plain.state.innovation
    assert other.state.innovation_variance - plain.state.innovation_variance == pytest.approx(2.0 * noise, rel=1e-9)
    assert other.state.rate_variance > 1.001 * plain.state.rate_variance


@pytest.mark.parametrize(('before', 'decay', 'expected'), [(0.0, 1.0, 1.0), (-0.5, 0.0, 0.0)])
def test_steadiness_is_defined_where_any_braking_counts(
    train_file: TrainFile, sample: Make, before: float, decay: float, expected: float
) -> None:
    """With min_braking = 0 nothing bounds a relative change of a released brake, which may follow at once."""
    motion = BrakeStep(decay, 0.0, 0.0, 0.0, before)
    config = replace(CONFIG, min_braking=0.0)
    assert interval(train_file, sample(1), motion, config=config).steadiness == expected
