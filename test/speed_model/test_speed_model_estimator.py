# SPDX-License-Identifier: Apache-2.0
"""The estimator apart from the algorithm: stops with and without weighing, changes, and the delay of the force."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.speed_model.am_vff_rls import AmVffRls, AmVffRlsConfig
from trainid_ros.speed_model.force_delay import ForceDelay
from trainid_ros.speed_model.method import Learned
from trainid_ros.speed_model.recent_values import RecentValues
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = AmVffRlsConfig()
# Indices of var(a2), var(b1) and var(d0) in the numbers.
A2, B1, D0 = 14, 17, 19


@pytest.fixture(scope='module')
def powered(journey: Journey) -> list[Sample]:
    return journey(60.0, traction=lambda t: 30.0 if t % 40.0 < 20.0 else 0.0, speed=8.0)


def learned(train_file: TrainFile, samples: list[Sample]) -> AmVffRls:
    estimator = AmVffRls(train_file, CONFIG)
    for item in samples:
        estimator.step(item)
    return estimator


@pytest.mark.parametrize(('weighed', 'std'), [(True, CONFIG.weighing_std), (False, CONFIG.load_std)])
def test_a_stop_adds_the_error_of_weighing_or_of_the_load(
    train_file: TrainFile, sample: Make, powered: list[Sample], weighed: bool, std: float
) -> None:
    file = replace(train_file, train=replace(train_file.train, mass_std=0.08, force_std=0.0))
    estimator = learned(file, powered)
    start = AmVffRls(file, CONFIG).state.numbers
    prior, b1 = start[B1], start[3]
    estimator.state = replace(estimator.state, weighed=weighed)
    before = estimator.state.numbers[B1]
    for k in range(3):
        estimator.step(sample(len(powered) + k, speed=0.0))
    added = (1.0 - before / prior) * (std * b1) ** 2
    assert estimator.state.numbers[B1] - before == pytest.approx(added, rel=1e-6, abs=0.0)


def test_window_errors_of_one_sign_cause_forgetting_of_the_resistance_only(
    train_file: TrainFile, powered: list[Sample]
) -> None:
    estimator = learned(train_file, powered)
    numbers, disturbance = estimator.state.numbers, replace(estimator.state.disturbance, elapsed=0.0, density=2e-3)
    share = 1.1 * math.sqrt(CONFIG.change_threshold) / math.sqrt(disturbance.chi2 / disturbance.agreed**2)
    below, kept = estimator._detect_change(numbers, replace(disturbance, agreed=0.8 * share))
    assert (below, kept.agreed) == (numbers, 0.8 * share)
    after, restarted = estimator._detect_change(numbers, replace(disturbance, agreed=share))
    assert min(after[A2] / numbers[A2], after[D0] / numbers[D0]) > 1.01
    assert after[B1] == pytest.approx(numbers[B1], rel=1e-9)
    assert after[:5] == numbers[:5]
    # The effect of the change on the windows does not count as gusts.
    assert (restarted.agreed, restarted.density) == (0.0, estimator.state.disturbance.density)


def test_x_moves_with_a_change_of_the_delay(train_file: TrainFile, powered: list[Sample]) -> None:
    """At 0.8 m/s^2 a delay longer by d lowers x by 0.8 d, minus d times the remaining sensitivity to the delay."""
    estimator = learned(train_file, powered)
    speeds = RecentValues()
    for k in range(6):
        speeds = speeds.add(10.0 + 0.8 * 0.2 * k, math.nan if k == 0 else 0.2)
    estimator.state = replace(estimator.state, speeds=speeds)
    noise, variance, gain, error = estimator.state.noise.variance, 4e-3, 0.5, -0.05
    late = ForceDelay(0.3, 0.02, gain)
    numbers = estimator.state.numbers
    after, moved = estimator._learn_delay(Learned(numbers, 11.0, error, 1.0, 1.0, variance), late)
    longer = 0.02 * gain / variance * error
    assert moved.delay - late.delay == pytest.approx(longer)
    assert abs(longer) > 0.05
    assert after[0] - numbers[0] == pytest.approx((gain * noise / variance - 0.8) * longer)
    assert after[1:] == numbers[1:]
