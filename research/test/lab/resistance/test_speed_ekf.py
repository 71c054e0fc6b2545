# SPDX-License-Identifier: Apache-2.0
"""The speed EKF: its kernel against independent matrix equations, accuracy, and robustness to faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.stepping import step_and_estimate
from trainid_lab.resistance.speed_ekf import SpeedEkf, SpeedEkfConfig, State, corrected, predicted
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Journey = Callable[..., list[Sample]]
CONFIG = SpeedEkfConfig()
TRUTH = Davis(1.8, 0.02, 0.005)


def saw_tooth(t: float) -> float:
    """Power for 40 s, coast for 100 s [N/kN]: uphill the speed stays between 7 and 18 m/s."""
    return 30.0 if t % 140.0 < 40.0 else 0.0


def w(davis: Davis, v: float) -> float:
    return davis.a + davis.b * v + davis.c * v * v


def random_state(seed: int) -> tuple[State, NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    x = np.array([14.0, 1.5, 0.03, 0.004])
    root = np.diag([0.02, 0.3, 0.02, 0.002]) @ rng.standard_normal((4, 4))
    P = root @ root.T
    return (*x.tolist(), *P[np.triu_indices(4)].tolist()), x, P


def unpacked(state: State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    P = np.zeros((4, 4))
    P[np.triu_indices(4)] = state[4:]
    return np.array(state[:4]), P + np.triu(P, 1).T


def test_the_prediction_follows_the_motion_and_its_derivatives() -> None:
    state, x, P = random_state(1)
    dt, u, k, q = 0.2, 12.0, 1.0 / 110.0, 1e-6

    def move(y: NDArray[np.float64]) -> float:
        v = float(y[0])
        for _ in range(200):
            v += dt / 200 * k * (u - y[1] - v * (y[2] + v * y[3]))
        return v

    found, Q = unpacked(predicted(state, dt, u, k, q))
    assert found[0] == pytest.approx(move(x), abs=1e-7)
    F = np.eye(4)
    for i in range(4):
        e = np.eye(4)[i] * 1e-4 * x[i]
        F[0, i] = (move(x + e) - move(x - e)) / (2.0 * e[i])
    expected = F @ P @ F.T
    expected[0, 0] += q
    std = np.sqrt(np.diag(expected))
    assert np.max(np.abs(Q - expected) / np.outer(std, std)) < 1e-4


def test_the_correction_is_that_of_a_kalman_filter() -> None:
    state, x, P = random_state(2)
    found, Q = unpacked(corrected(state, 14.1, 4e-4))
    K = P[:, 0] / (P[0, 0] + 4e-4)
    assert found == pytest.approx(x + K * 0.1, rel=1e-12)
    assert pytest.approx(P - np.outer(K, P[0]), rel=1e-9, abs=1e-15) == Q


@pytest.mark.parametrize('seed', range(2))
def test_it_estimates_the_resistance_over_the_observed_speeds(
    train_file: TrainFile, journey: Journey, seed: int
) -> None:
    estimator = SpeedEkf(train_file, CONFIG)
    for item in journey(600.0, traction=saw_tooth, speed=8.0, seed=40 + seed):
        estimator.step(item)
    found = estimator.estimate(12.0)
    assert estimator.converged
    assert found.speed_max - found.speed_min > 4.0
    for v in np.linspace(found.speed_min, found.speed_max, 5).tolist():
        here = estimator.estimate(v)
        assert here.resistance == pytest.approx(w(TRUTH, v), abs=4.0 * here.resistance_std)
        assert here.resistance_std < 0.15


def test_a_stuck_speed_does_not_affect_the_estimate(train_file: TrainFile, journey: Journey) -> None:
    """While coasting, a speed held for three seconds looks like zero resistance."""
    samples = journey(400.0, traction=saw_tooth, speed=12.0, seed=9)
    held = [
        replace(item, speed=samples[i - i % 75].speed) if i % 75 < 15 and i > 500 else item
        for i, item in enumerate(samples)
    ]
    plain, checked, unchecked = (SpeedEkf(train_file, CONFIG) for _ in range(3))
    unchecked = SpeedEkf(train_file, replace(CONFIG, stuck_sigmas=1e6))
    reasons = []
    for good, bad in zip(samples, held, strict=True):
        plain.step(good)
        unchecked.step(bad)
        answer = checked.step(bad)
        reasons.append(answer.reason if isinstance(answer, Rejection) else Reason.NONE)
    assert reasons.count(Reason.SPEED_STUCK) > 100
    expected = plain.estimate(12.0)
    assert checked.estimate(12.0).resistance == pytest.approx(expected.resistance, abs=2.0 * expected.resistance_std)
    assert abs(unchecked.estimate(12.0).resistance - w(TRUTH, 12.0)) > abs(
        checked.estimate(12.0).resistance - w(TRUTH, 12.0)
    )


def test_gross_errors_are_rejected_and_a_lasting_one_restarts_the_speed(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(300.0, traction=saw_tooth, speed=12.0, seed=3)
    estimator = SpeedEkf(train_file, CONFIG)
    for item in samples[:1000]:
        estimator.step(item)
    before = estimator.estimate(12.0)
    answers = [step_and_estimate(estimator, replace(item, speed=item.speed + 3.0)) for item in samples[1000:1040]]
    rejected = [answer for answer in answers if isinstance(answer, Rejection)]
    assert [item.reason for item in rejected] == [Reason.OUTLIER] * CONFIG.restart_after
    after = estimator.estimate(12.0)
    assert after.resistance == pytest.approx(before.resistance, abs=0.5)


def test_a_restored_estimator_continues_bit_identically(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(200.0, traction=saw_tooth, brake=lambda t: -0.5 if 120.0 < t < 130.0 else 0.0)
    for middle in (333, 777):
        original, copy = SpeedEkf(train_file, CONFIG), SpeedEkf(train_file, CONFIG)
        for item in samples[:middle]:
            original.step(item)
        copy.restore(original.save())
        for item in samples[middle:]:
            assert repr(step_and_estimate(copy, item)) == repr(step_and_estimate(original, item))
        assert copy.save() == original.save()
