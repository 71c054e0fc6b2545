# SPDX-License-Identifier: Apache-2.0
"""Errors of a train file in dead time, resistance or brake rate over speed do not bias the estimators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from test.estimators.makers import stepped
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.setup.pipelines import BRAKE_RATE
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Brake, Davis, TrainFile

Journey = Callable[..., list[Sample]]
NAMES = ('GSMA', 'IMM', 'KF', 'RBPF')
# True values of the journeys.
DELAY, LAG = 0.6, 0.4
TRUE = Davis(1.5, 0.03, 0.004)


def make(train_file: TrainFile, name: str = 'GSMA', seed: int = 3, **settings: float) -> BrakeRateEstimator:
    made = BRAKE_RATE.make(BRAKE_RATE.choose(name, **settings), train_file, np.random.default_rng(seed))
    assert isinstance(made, BrakeRateEstimator)
    return made


def stops(t: float) -> float:
    """Return a braking in two levels every 50 s, from 20 s on."""
    since = t % 50.0
    return -0.5 if 20.0 < since < 26.0 else -0.8 if 26.0 <= since < 32.0 else 0.0


def power(t: float) -> float:
    return 75.0 if 36.0 < t % 50.0 < 48.0 else 0.0


@pytest.fixture(scope='module')
def stopping(journey: Journey) -> list[Sample]:
    """Five brakings with a rate of 0.9 and the resistance of the train file."""
    return journey(250.0, brake=stops, traction=power, rate=lambda _: 0.9, resistance=lambda _: TRUE, speed=24.0)


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize('late', [-0.3, 0.3])
def test_a_dead_time_error_of_three_tenths_is_estimated(
    train_file: TrainFile, stopping: list[Sample], name: str, late: float
) -> None:
    brake = Brake(1.0, LAG, DELAY + late)
    estimator = stepped(make(replace(train_file, brake=brake), name), stopping)
    timing, e = estimator.state.timing, estimator.estimate(0.0)
    # The train responds to the sum of dead time and lag.
    assert timing.delay + timing.lag == pytest.approx(DELAY + LAG, abs=0.14)
    assert e.brake_rate == pytest.approx(0.9, abs=0.04)
    assert abs(e.brake_rate - 0.9) < 3.0 * e.brake_rate_std


def test_a_dead_time_error_does_not_bias_the_first_braking(train_file: TrainFile, journey: Journey) -> None:
    """The brake acts 0.3 s early: a rate of 0.9 looks like 1.03 in the first two seconds."""
    errors = []
    for seed in range(4):
        estimator = make(replace(train_file, brake=Brake(1.0, LAG, DELAY + 0.3)), seed=seed)
        samples = journey(
            12.0,
            brake=lambda t: -0.7 if t > 4.0 else 0.0,
            speed=22.0,
            rate=lambda _: 0.9,
            resistance=lambda _: TRUE,
            seed=seed,
        )
        stepped(estimator, samples)
        e = estimator.estimate(0.0)
        errors.append(abs(e.brake_rate - 0.9))
        assert errors[-1] < 3.0 * e.brake_rate_std
    assert np.mean(errors) < 0.04


@pytest.mark.parametrize('factor', [0.7, 1.3])
def test_a_resistance_error_is_estimated_between_brakings(
    train_file: TrainFile, stopping: list[Sample], factor: float
) -> None:
    wrong = Davis(TRUE.a * factor, TRUE.b * factor, TRUE.c * factor)
    estimator, errors = make(replace(train_file, resistance=wrong)), []
    for item in stopping:
        estimator.step(item)
        if estimator.state.observable:
            errors.append(abs(estimator.estimate(0.0).brake_rate - 0.9))
    assert np.mean(errors[len(errors) // 2 :]) < 0.012
    e = estimator.posterior.errors
    w, learned = 20.0 * TRUE.b + TRUE.a + 400.0 * TRUE.c, (1.0 + e[2]) * (wrong.a + 20.0 * wrong.b)
    assert learned + (1.0 + e[3]) * 400.0 * wrong.c == pytest.approx(w, rel=0.2)


def test_with_a_table_over_speed_the_estimate_is_a_factor_on_it(train_file: TrainFile, stopping: list[Sample]) -> None:
    """With a table of 0.8 at all speeds, a rate of 0.9 is a factor of 1.125."""
    estimator = stepped(make(replace(train_file, brake=Brake(1.0, LAG, DELAY, ((0.0, 0.8), (30.0, 0.8))))), stopping)
    assert estimator.estimate(0.0).brake_rate == pytest.approx(1.125, abs=0.02)


def test_a_correct_table_leaves_no_slope_error(train_file: TrainFile, journey: Journey) -> None:
    table, samples = ((0.0, 1.1), (25.0, 0.85)), []
    brake = Brake(1.0, LAG, DELAY, table)
    for item in journey(200.0, brake=stops, traction=power, rate=lambda _: 1.0, resistance=lambda _: TRUE, speed=24.0):
        # The journey has no table, so the commands are divided by the table at the speed.
        changes = tuple(
            replace(c, target_acceleration=c.target_acceleration / brake.rate_at(item.speed))
            for c in item.brake_changes
        )
        samples.append(replace(item, brake_changes=changes))
    estimator = stepped(make(replace(train_file, brake=brake)), samples)
    assert estimator.estimate(0.0).brake_rate == pytest.approx(1.0, abs=0.06)


def test_uncertain_timing_widens_the_band_while_the_brake_is_applied(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(10.0, brake=lambda t: -0.7 if t > 4.0 else 0.0, speed=22.0, rate=lambda _: 0.9)
    known = replace(train_file, brake=replace(train_file.brake, timing_std=0.0))
    exact, uncertain = make(known), make(train_file)
    ratios = []
    for item in samples:
        exact.step(item)
        uncertain.step(item)
        if uncertain.state.observable:
            ratios.append(uncertain.estimate(0.0).brake_rate_std / exact.estimate(0.0).brake_rate_std)
    assert max(ratios[:6]) > 1.1
    assert ratios[-1] < 1.3


@pytest.mark.parametrize('name', ['GSMA', 'KF'])
def test_the_band_covers_the_truth_on_fresh_seeds(train_file: TrainFile, journey: Journey, name: str) -> None:
    """Dead time, resistance and rate are random; 12 drives give 95 % with a spread of about 6 %."""
    rng, inside = np.random.default_rng(), []
    for _ in range(12):
        f, late, factor = float(rng.uniform(0.75, 1.1)), float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.7, 1.3))
        w = Davis(TRUE.a * factor, TRUE.b * factor, TRUE.c * factor)
        file = replace(train_file, brake=Brake(1.0, LAG, DELAY + late), resistance=w)
        seed = int(rng.integers(2**31))
        estimator, rate = make(file, name, seed), (lambda _, f=f: f)
        for item in journey(
            150.0, brake=stops, traction=power, rate=rate, resistance=lambda _: TRUE, speed=24.0, seed=seed
        ):
            estimator.step(item)
            e = estimator.estimate(0.0)
            if estimator.state.observable and item.brake_command < 0.0:
                inside.append(abs(e.brake_rate - f) < 1.96 * e.brake_rate_std)
    assert np.mean(inside) > 0.8
