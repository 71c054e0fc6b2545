# SPDX-License-Identifier: Apache-2.0
"""KF, IMM and RBPF: kernels of the filters, the same posterior as GSMA in four forms, and jumps where modelled."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.brake_rate.kalman import ImmConfig, ImmPosterior, anchored, drift, mixed, predict, recentred, update
from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.motion_model import STATES, Start, Transition
from trainid_ros.interface.state import is_covariance, packed
from trainid_ros.setup.pipelines import BRAKE_RATE
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Array = NDArray[np.float64]
N, RATE = STATES + 1, STATES
GAINS = (0.1, -0.2, 0.03, 0.02, -0.01, 0.05, 0.04, -0.2)
KEEP = (0.999, 0.998, 0.99, 0.99, 0.98, 1.0, 0.97, 0.5)
Q_E = (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4, 8e-4, 7e-4)
STEP = Transition(0.2, 0.15, 0.6, -0.05, -0.3, 0.97, 0.01, 1e-3, 2e-3, GAINS, KEEP, Q_E)


def draw(rng: np.random.Generator) -> tuple[Array, Array]:
    A = rng.standard_normal((N, N))
    return rng.standard_normal(N), A @ A.T


def transition() -> Array:
    F = np.diag([1.0, 0.6, 0.97, *KEEP, 1.0])
    F[0] = (1.0, 0.15, 0.2, *GAINS, -0.05)
    F[1, RATE] = -0.3
    return F


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_prediction_and_drift(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    F, Q = transition(), np.diag([1e-3, 0.0, 2e-3, *Q_E, 0.0])
    mean, cov = predict(m, P, STEP)
    expected = F @ m
    expected[0] += 0.01
    assert np.allclose(mean, expected, rtol=1e-12)
    assert np.allclose(cov, F @ P @ F.T + Q, rtol=1e-12)
    # The drift acts from the start of the interval.
    q = np.zeros((N, N))
    q[RATE, RATE] = 0.04
    assert np.allclose(drift(cov, STEP.gain_v, STEP.gain_a, 0.04), F @ (P + q) @ F.T + Q, rtol=1e-12)


@pytest.mark.parametrize('learns', [True, False])
def test_update(rng: np.random.Generator, learns: bool) -> None:
    m, P = draw(rng)
    r, speed = 0.3, 1.7
    K = P[:, 0] / (P[0, 0] + r)
    if not learns:
        K[RATE] = 0.0
    A = np.eye(N)
    A[:, 0] -= K
    mean, cov = update(m, P, speed, r, learns=learns)
    assert np.allclose(mean, m + K * (speed - m[0]), rtol=1e-12)
    assert np.allclose(cov, A @ P @ A.T + r * np.outer(K, K), rtol=1e-9, atol=1e-9)


def test_a_mixture_has_the_moments_of_its_parts(rng: np.random.Generator) -> None:
    (m0, P0), (m1, P1) = draw(rng), draw(rng)
    mean, cov = mixed((0.3, 0.7), (m0, m1), (P0, P1))
    d = m1 - m0
    assert np.allclose(mean, 0.3 * m0 + 0.7 * m1)
    assert np.allclose(cov, 0.3 * P0 + 0.7 * P1 + 0.21 * np.outer(d, d))


def test_an_anchor_couples_the_brake_to_f_and_keeps_the_errors(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    mean, cov = anchored(m, P, Start(12.0, -0.5, (0.01, 0.0025, 0.0001), KEEP, Q_E))
    assert mean[:3] == pytest.approx([12.0, -0.5 * m[RATE], 0.0])
    assert mean[3:RATE] == pytest.approx(np.array(KEEP) * m[3:RATE])
    assert cov[RATE, RATE] == P[RATE, RATE]
    assert cov[1, 1] - cov[1, RATE] ** 2 / cov[RATE, RATE] == pytest.approx(0.0025)
    assert np.diag(cov)[3:RATE] == pytest.approx(np.square(KEEP) * np.diag(P)[3:RATE] + np.array(Q_E))
    assert np.min(np.linalg.eigvalsh(cov)) > 0.0


def test_a_new_origin_shifts_only_the_errors(rng: np.random.Generator) -> None:
    m, P = draw(rng)
    moved, _ = recentred(m, P, GAINS)
    assert moved[3:RATE] == pytest.approx(m[3:RATE] - np.array(GAINS))
    assert np.array_equal(moved[[0, 1, 2, RATE]], m[[0, 1, 2, RATE]])


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
