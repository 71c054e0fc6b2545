# SPDX-License-Identifier: Apache-2.0
"""Response of the brake, gains by its timing, and the motion over one sample: as the equations of the module say."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from test.estimators.makers import stepped
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.brake_rate.motion_model import BLEND_SHAPE, BrakeStep, MotionModel, Timing, Transition, brake_step
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange, CommandHistory, lag_integral, lag_response
from trainid_ros.train.train_file import Brake, TrainFile

START = 1_700_000_000 * NS_PER_S


def history(rng: np.random.Generator) -> CommandHistory:
    stamps = np.cumsum(rng.integers(20_000_000, 400_000_000, 30))
    changes = [BrakeCommandChange(START + int(s), -float(rng.uniform(0.0, 1.0))) for s in stamps]
    commands = CommandHistory()
    for change in changes:
        commands.push(change)
    return commands


def integrate(
    commands: CommandHistory, brake: Brake, start_ns: int, end_ns: int, *, initial: float, rate: float
) -> tuple[float, float]:
    """Return (a at the end, gain of v) by the midpoint rule in steps of 0.1 ms."""
    step = 100_000
    a, v = initial, 0.0
    h = step / NS_PER_S
    for t in range(start_ns, end_ns, step):
        u = rate * commands.value(t + step // 2 - round(brake.delay * NS_PER_S))
        middle = a + 0.5 * h * (u - a) / brake.time_constant
        v += h * middle
        a += h * (u - middle) / brake.time_constant
    return a, v


@pytest.mark.parametrize('seed', range(3))
def test_the_response_equals_fine_integration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    commands, brake = history(rng), Brake(1.0, 0.4, 0.63)
    start = START + 1_000_000_000 + int(rng.integers(0, 10**6)) * 1000
    initial, rate = -0.35, 0.8
    step = brake_step(commands, brake.delay, brake.time_constant, start, start + 700_000_000, initial)
    a, v = integrate(commands, brake, start, start + 700_000_000, initial=initial, rate=rate)
    # A change of command within a step of 0.1 ms changes a by about 1e-4 / 0.4 of its size at most.
    assert step.decay * initial + rate * step.gain_a == pytest.approx(a, abs=5e-4)
    assert step.reach * initial + rate * step.gain_v == pytest.approx(v, abs=5e-4)


def test_the_dead_time_is_exact() -> None:
    commands = CommandHistory((BrakeCommandChange(START, -1.0),))
    brake = Brake(1.0, 0.4, 0.6)
    before = brake_step(commands, brake.delay, brake.time_constant, START, START + 600_000_000, 0.0)
    assert (before.gain_a, before.gain_v) == (0.0, 0.0)
    after = brake_step(commands, brake.delay, brake.time_constant, START, START + 1_000_000_000, -0.5)
    assert after.gain_a == pytest.approx(np.exp(-1.0) - 1.0, rel=1e-12)
    assert after.end_target == pytest.approx(-0.5 * np.exp(-2.5) + after.gain_a, rel=1e-12)
    assert after.gain_v == pytest.approx(-(0.4 - 0.4 * (1.0 - np.exp(-1.0))), rel=1e-12)


def test_a_brake_without_lag_follows_at_once() -> None:
    commands = CommandHistory((BrakeCommandChange(START, -1.0),))
    step = brake_step(commands, 0.0, 0.0, START, START + NS_PER_S // 2, -0.7)
    assert (step.decay, step.reach, step.gain_a, step.gain_v) == (0.0, 0.0, -1.0, -0.5)


COMMANDS = CommandHistory((BrakeCommandChange(NS_PER_S, -0.8),))
STEP_NS = NS_PER_S // 5


def integral(delay: float, lag: float, until_s: float) -> float:
    """Return the integral of the lagged target [m/s]."""
    return lag_integral(0.0, -0.8, lag, until_s - 1.0 - delay)


def followed(timing: Timing, seconds: float) -> list[BrakeStep]:
    steps, target = [], 0.0
    for k in range(round(5.0 * seconds)):
        step = brake_step(COMMANDS, timing.delay, timing.lag, k * STEP_NS, (k + 1) * STEP_NS, target)
        timing.follow(COMMANDS, k * STEP_NS, (k + 1) * STEP_NS, step)
        steps.append(step)
        target = step.end_target
    return steps


def targets(timing: Timing) -> tuple[float, float, float, float]:
    return timing.later, timing.sooner, timing.slower, timing.faster


def test_the_gains_are_the_derivatives_of_the_response() -> None:
    timing = Timing(0.6, 0.4, 0.02, 0.02)
    steps = followed(timing, 3.0)
    h = 1e-3
    delay = (integral(0.6 + h, 0.4, 3.0) - integral(0.6 - h, 0.4, 3.0)) / (2.0 * h)
    lag = (integral(0.6, 0.4 + h, 3.0) - integral(0.6, 0.4 - h, 3.0)) / (2.0 * h)
    assert sum(step.delay_gain for step in steps) == pytest.approx(delay, rel=0.01)
    assert sum(step.lag_gain for step in steps) == pytest.approx(lag, rel=0.01)
    # The gain is the full brake acceleration, for dead time and lag.
    assert delay == pytest.approx(0.8, rel=0.04)
    assert targets(timing) == pytest.approx((-0.8,) * 4, abs=0.03)


def test_a_large_timing_error_adds_variance_while_the_response_changes() -> None:
    stds = ((0.3, 0.2), (0.3, 0.0), (0.0, 0.2))
    variances, of_delay, of_lag = (
        np.array([step.variance for step in followed(Timing(0.6, 0.4, *pair), 5.0)]) for pair in stds
    )
    assert variances == pytest.approx(of_delay + of_lag, rel=1e-9, abs=1e-15)
    assert min(of_delay.max(), of_lag.max()) > 1e-5
    assert variances[:4].max() < 1e-12
    assert variances[4:12].max() > 1e-4
    assert variances[-3:].max() < 1e-5


def test_without_commands_the_gains_are_zero() -> None:
    timing = Timing(0.6, 0.4, 0.1, 0.1)
    step = BrakeStep(1.0, 0.2, 0.0, 0.0, 0.0)
    timing.follow(CommandHistory(), 0, STEP_NS, step)
    assert (step.delay_gain, step.lag_gain, step.variance) == (0.0, 0.0, 0.0)
    assert not timing.has_acted
    assert timing.is_idle(CommandHistory(), STEP_NS)
    assert not timing.is_idle(COMMANDS, 2 * NS_PER_S)


def test_the_timing_moves_to_its_estimate_and_stays_valid() -> None:
    moved, low, known = (
        Timing(0.6, 0.4, 0.3, 0.2, has_acted=True),
        Timing(0.6, 0.4, 0.3, 0.2),
        Timing(0.6, 0.4, 0.0, 0.0),
    )
    moved.move((0.15, -0.1), (0.05, 0.5), Brake())
    assert (moved.delay, moved.lag) == pytest.approx((0.75, 0.3))
    assert not moved.has_acted
    assert (moved.delay_std, moved.lag_std) == pytest.approx((0.05, 0.2))
    low.move((-9.0, -9.0), (0.0, 0.0), Brake())
    assert (low.delay, low.lag) == pytest.approx((0.0, 0.1))
    assert min(low.delay_std, low.lag_std) > 0.0
    # A known timing is not estimated.
    known.move((0.0, 0.0), (1.0, 1.0), Brake())
    assert (known.delay_std, known.lag_std) == (0.0, 0.0)


def test_the_four_targets_equal_those_of_four_brakes() -> None:
    timing = Timing(0.6, 0.4, 0.2, 0.1)
    followed(timing, 2.2)
    brakes = ((0.8, 0.4), (0.4, 0.4), (0.6, 0.5), (0.6, 0.3))
    expected = [lag_response(0.0, -0.8, lag, 1.2 - delay) for delay, lag in brakes]
    assert targets(timing) == pytest.approx(expected, rel=1e-6)


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
        sample, motion, rate=1.0, before=gains[0], gain=gains[1], variance=0.0
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


def test_the_brake_rate_includes_the_level_error(train_file: TrainFile) -> None:
    """An error of 0.01 m/s^2 is an error of 0.02 in the brake rate at a level of 0.5 m/s^2."""
    model = MotionModel(train_file, CONFIG)
    assert model.share(15.0, 0.5)[7] == pytest.approx(2.0)
    assert model.share(15.0, 0.05)[7] == 0.0


@pytest.mark.parametrize('released_s', [6.0, math.inf])
def test_the_rate_is_that_at_the_present_speed_until_the_brake_is_released_or_the_train_stands(
    train_file: TrainFile, journey: Journey, released_s: float
) -> None:
    samples = journey(14.0, brake=lambda t: -0.6 if 2.0 < t < released_s else 0.0, speed=6.0)
    estimator = Gsma(train_file, CONFIG, np.random.default_rng(1))
    differed = False
    for item in samples:
        before, start_target = estimator.state.rate, estimator.state.filtered_target
        estimator.step(item)
        state, medium = estimator.state, estimator.posterior.rate
        if state.observable:
            differed = state.rate != medium
        elif item.speed >= CONFIG.min_speed and min(state.filtered_target, start_target) <= -CONFIG.min_braking:
            assert state.rate == before
        else:
            assert state.rate == medium
    assert differed


def braked(train_file: TrainFile, samples: list[Sample]) -> BrakeRateEstimator:
    estimator = stepped(Gsma(train_file, CONFIG, np.random.default_rng(1)), samples)
    assert estimator.state.observable
    return estimator


def test_a_changeover_adds_its_shape_error_to_the_std(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(12.0, brake=lambda t: -0.4 if t > 2.0 else 0.0, speed=6.0)
    slow = next(k for k, item in enumerate(samples) if item.speed < 1.1 * CONFIG.blend_speed)
    fast = next(k for k, item in enumerate(samples) if item.speed < 2.1 * CONFIG.blend_speed)
    during, before = braked(train_file, samples[: slow + 1]), braked(train_file, samples[:fast])
    shape = BLEND_SHAPE * CONFIG.blend_std
    for estimator, item, blending in ((during, samples[slow], shape), (before, samples[fast - 1], 0.0)):
        share = MotionModel(train_file, CONFIG).share(item.speed, abs(estimator.state.filtered_target))
        _, modelled = estimator.posterior.total_rate(share)
        assert estimator.state.rate_variance - modelled == pytest.approx(blending**2, abs=1e-12)


def test_a_weak_braking_widens_the_band_and_keeps_the_rate_valid(train_file: TrainFile, journey: Journey) -> None:
    brake = {True: -0.7, False: -0.085}
    samples = journey(32.0, brake=lambda t: brake[t < 14.0] if 2.0 < t < 14.0 or t > 24.0 else 0.0, speed=25.0)
    estimator = Gsma(train_file, CONFIG, np.random.default_rng(1))
    weak = [item.stamp_ns for item in samples if item.brake_command == brake[False]]
    for item in samples:
        estimator.step(item)
        if item.stamp_ns == weak[10]:
            assert estimator.state.observable
            assert estimator.estimate(item.speed).brake_rate_std > 2.0 * CONFIG.valid_std
        assert estimator.converged or item.stamp_ns < weak[0]
    assert estimator.converged


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
