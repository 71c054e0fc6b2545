# SPDX-License-Identifier: Apache-2.0
"""KF, IMM and RBPF compared with GSMA: the same posterior in four forms, and jumps for those that model them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from trainid_lab.brake_rate.kalman import ImmConfig, ImmPosterior
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.motion_model import Start, Transition
from trainid_ros.interface.state import is_covariance, packed
from trainid_ros.setup.pipelines import BRAKE_RATE
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Journey = Callable[..., list[Sample]]


def make(train_file: TrainFile, name: str, **settings: float) -> BrakeRateEstimator:
    made = BRAKE_RATE.make(BRAKE_RATE.choose(name, **settings), train_file, np.random.default_rng(3))
    assert isinstance(made, BrakeRateEstimator)
    return made


@pytest.mark.parametrize('name', ['GSMA', 'IMM', 'KF', 'RBPF'])
def test_a_state_saved_long_after_the_brake_was_released_can_be_restored(
    train_file: TrainFile, journey: Journey, name: str
) -> None:
    """With a lag of 0.3 s the variance of the brake acceleration underflows."""
    file = replace(train_file, brake=replace(train_file.brake, time_constant=0.3))
    original = make(file, name)
    coast = journey(200.0, brake=lambda t: -0.4 if t < 8.0 else 0.0, speed=35.0)
    for i, item in enumerate(coast):
        original.step(item)
        if i % 100 == 99:
            copy = make(file, name)
            copy.restore(original.save())
            assert copy.save() == original.save()


@pytest.fixture(scope='module')
def braked(journey: Journey) -> list[Sample]:
    """A long braking in which the rate jumps from 0.95 to 0.7 after 24 s."""

    def brake(t: float) -> float:
        return 0.0 if t < 4.0 else -0.4

    return journey(44.0, brake=brake, rate=lambda t: 0.95 if t < 24.0 else 0.7, speed=25.0, resistance=expected)


def expected(_t: float) -> Davis:
    return Davis(1.5, 0.03, 0.004)


@pytest.mark.parametrize(('name', 'most'), [('RBPF', 0.25), ('GSMA', 0.1), ('IMM', 1e-9)])
def test_without_jumps_all_equal_the_kalman_filter(
    train_file: TrainFile, braked: list[Sample], name: str, most: float
) -> None:
    """Differences in standard deviations of the Kalman filter, before the jump."""
    plain = {} if name == 'RBPF' else {'jump_rate': 0.0}
    kalman, other = make(train_file, 'KF'), make(train_file, name, **plain)
    differences = []
    for item in braked[:120]:
        kalman.step(item)
        other.step(item)
        exact, e = kalman.estimate(0.0), other.estimate(0.0)
        differences.append((e.brake_rate - exact.brake_rate) / exact.brake_rate_std)
        assert e.brake_rate_std == pytest.approx(exact.brake_rate_std, rel=0.3 if name == 'RBPF' else 0.1)
    assert float(np.sqrt(np.mean(np.square(differences)))) < most


@pytest.mark.parametrize('name', ['GSMA', 'IMM'])
def test_a_jump_during_braking_is_detected(train_file: TrainFile, braked: list[Sample], name: str) -> None:
    estimator, kalman = make(train_file, name), make(train_file, 'KF')
    wrong_s = kalman_s = 0.0
    for item in braked:
        estimator.step(item)
        kalman.step(item)
        t = (item.stamp_ns - braked[0].stamp_ns) / 1e9
        if t > 24.0:
            wrong_s += 0.2 * (abs(estimator.estimate(0.0).brake_rate - 0.7) > 0.07)
            kalman_s += 0.2 * (abs(kalman.estimate(0.0).brake_rate - 0.7) > 0.07)
    assert wrong_s < 4.0 < kalman_s


def test_the_effective_number_of_models_exceeds_one_only_at_a_jump(train_file: TrainFile, braked: list[Sample]) -> None:
    estimator, counts = make(train_file, 'IMM'), []
    for item in braked:
        estimator.step(item)
        counts.append(estimator.estimate(0.0).effective_particles)
    assert min(counts) >= 1.0
    assert max(counts) <= 2.0
    assert np.median(counts[:110]) < 1.05
    assert max(counts[120:145]) > 1.5


def ambiguous(jumping: float, config: ImmConfig) -> ImmPosterior:
    """Return two models of one train, the quiet one overconfident that its speed is 10 m/s."""
    posterior, errors = ImmPosterior(config), (0.0,) * 8
    posterior.reset(1.0, 0.2, errors)
    posterior.reinit_motion(Start(10.0, -0.5, (1e-4, 0.0, 0.0)))
    (m, P), (_, wide) = posterior.models
    state = json.loads(posterior.save())
    wide = wide.copy()
    wide[0, 0] = 100.0
    means, covariances = packed(np.array([m, m])), packed(np.array([P, wide]))
    state['state'] = {'jumping': jumping, 'means': means, 'covariances': covariances}
    posterior.restore(json.dumps(state))
    return posterior


@pytest.mark.parametrize(
    ('speed', 'steadiness', 'elapsed', 'jump_rate'),
    [
        (25.0, 0.0, 0.2, 1e-4),  # a posterior probability of exactly one, and no time for the jump to end
        (10.0, 0.0, 1e3, 1.0),  # a pause after which a jump is certain
    ],
)
def test_a_certain_jump_keeps_a_valid_quiet_model(
    speed: float, steadiness: float, elapsed: float, jump_rate: float
) -> None:
    posterior = ambiguous(0.5, ImmConfig(jump_rate=jump_rate))
    interval = Transition(0.2, 0.15, 0.6, -0.02, -0.2, 0.99, -0.01, 1e-6, 0.0, steadiness=steadiness)
    for _ in range(3):
        posterior.predict(interval)
        assert posterior.update(interval, elapsed, speed, 1e-4)
        assert 0.99 < posterior.jumping < 1.0
        assert all(is_covariance(P) for _, P in posterior.models)
    posterior.restore(posterior.save())


@pytest.mark.slow
@pytest.mark.parametrize('name', ['RBPF', 'SMA', 'GSMA-printed'])
def test_the_estimate_right_after_a_restore_is_bit_identical(
    train_file: TrainFile, braked: list[Sample], name: str
) -> None:
    original, copy = make(train_file, name), make(train_file, name)
    for item in braked:
        original.step(item)
        copy.restore(original.save())
        assert repr(copy.estimate(10.0)) == repr(original.estimate(10.0))
