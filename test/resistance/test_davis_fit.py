# SPDX-License-Identifier: Apache-2.0
"""The batch fit in time: exact on exact motion, consistent in gusts, robust to slip; implausible fits are rejected."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.results import Reason
from trainid_ros.resistance.davis_fit import (
    DavisFit,
    DavisFitConfig,
    PieceCollector,
    Trajectory,
    check_plausible,
    fit_davis,
    half_variance,
    rounding_variance,
)
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile


def collect(train_file: TrainFile, samples: list[Sample]) -> tuple[PieceCollector, Counter[Reason]]:
    collector, rejected = PieceCollector(train_file, 1.0, 2.0), Counter[Reason]()
    for sample in samples:
        collector.add(sample, rejected)
    return collector, rejected


def test_pieces_begin_after_gaps_and_short_ones_are_removed(
    train_file: TrainFile, sample: Callable[..., Sample]
) -> None:
    given = [sample(i, dt=math.nan if i in (0, 30, 35) else 0.2) for i in range(80)]
    collector, rejected = collect(train_file, given)
    trajectory = collector.trajectory()
    assert rejected == {Reason.GAP: 3}
    assert trajectory.starts.tolist() == [0, 29]
    assert trajectory.speed.size == 29 + 44
    assert np.all(trajectory.known == 0.0)


def test_traction_and_gradient_are_stored_separately(train_file: TrainFile, sample: Callable[..., Sample]) -> None:
    weight = 200e3 * 9.80665 / 1000.0
    given = [sample(i, force_mean=8.0 * weight, force=8.0 * weight, gradient_mean=3.0) for i in range(40)]
    trajectory = collect(train_file, given)[0].trajectory()
    assert trajectory.traction == pytest.approx(8.0)
    assert trajectory.known == pytest.approx(5.0)


def test_monitored_braking_is_tracked_and_rejects_samples_until_released(
    train_file: TrainFile, sample: Callable[..., Sample]
) -> None:
    collector = PieceCollector(train_file, 1.0, 2.0)
    for i in range(1, 20):
        collector.monitor(sample(i, speed=16.0 - 0.1 * i, brake_command=-0.5))
    rejected: Counter[Reason] = Counter()
    for i in range(20, 60):
        collector.add(sample(i, speed=14.0 - 0.001 * i), rejected)
    # The brake needs 0.6 s and eight time constants of 0.4 s after its release.
    assert rejected[Reason.BRAKING] in (18, 19)
    assert collector.trajectory().speed.size == 40 - rejected[Reason.BRAKING]


def test_half_variance_of_noise_and_of_a_walk() -> None:
    rng, one = np.random.default_rng(31), np.zeros(20_000, dtype=np.intp)
    assert half_variance(0.2 * rng.standard_normal(one.size), one, 1) == pytest.approx(0.04, rel=0.1)
    walk = np.cumsum(0.1 * rng.standard_normal(one.size))
    assert half_variance(walk, one, 10) == pytest.approx(0.05, rel=0.2)


def test_increments_between_pieces_do_not_count() -> None:
    y = np.repeat(np.array([0.0, 5.0, -3.0]), 3)
    assert half_variance(y, np.repeat(np.arange(3), 3), 2) == 0.0


@pytest.mark.parametrize('quantum', [0.01, 0.28])
def test_rounding_variance_is_that_of_increments_of_rounded_motion(quantum: float) -> None:
    rng = np.random.default_rng(32)
    dt = np.full(20_000, 0.2)
    dt[0] = 0.0
    exact = 30.0 + np.cumsum(0.05 * rng.standard_normal(dt.size))
    spoiled = np.where(rng.random(dt.size) < 0.005, rng.uniform(0.0, 40.0, dt.size), exact)
    rounded = quantum * np.round(spoiled / quantum)
    given = Trajectory(rounded, dt, np.zeros(dt.size), np.zeros(dt.size), 110.0)
    errors = rounded - spoiled
    assert half_variance(errors, np.zeros(dt.size, dtype=np.intp), 100) == pytest.approx(
        rounding_variance(given), rel=0.15
    )


THETA = np.array([1.5, 0.03, 0.004])
INERTIA = 110.0
DT = 0.2
WHITE = DavisFitConfig(
    speed_std=0.02, disturbance_std=1e-5, learn_noise=False, force_skew=1e-9, force_error=1e-9, force_jitter=0.0
)

GOOD = DavisFit(
    theta=np.array([1.5, 0.02, 0.004]),
    covariance=np.diag([0.1, 0.01, 0.0005]) ** 2,
    force_delay=0.01,
    force_gain=0.002,
    iterations=9,
    converged=True,
    mse=1e-3,
    speed_std=0.02,
    disturbance=0.2,
    inflation=1.0,
    outliers=0.01,
    speed_range=(3.0, 21.0),
    pieces=6,
    nodes=3000,
)


def pieces(count: int = 6, nodes: int = 400, gust: float = 0.0, seed: int = 0) -> Trajectory:
    """Runs that accelerate, hold and coast, integrated in fine steps of (3)."""
    rng = np.random.default_rng(seed)
    a, b, c = THETA.tolist()
    speeds, known, traction, dts = [], [], [], []
    for k in range(count):
        v, g = 2.0, gust * rng.standard_normal()
        for i in range(nodes):
            pull = 60.0 if i < 60 + 5 * k else (4.0 if i < 200 else 0.0)
            hill = 3.0 * np.sin(0.02 * i + k)
            if i:
                for _ in range(2):
                    middle = v + 0.05 * (pull - hill - g - a - v * (b + c * v)) / INERTIA
                    v += 0.1 * (pull - hill - g - a - middle * (b + c * middle)) / INERTIA
                g += -0.04 * g + gust * np.sqrt(0.08) * rng.standard_normal()
            speeds.append(v)
            known.append(pull - hill)
            traction.append(pull)
            dts.append(DT if i else 0.0)
    return Trajectory(np.array(speeds), np.array(dts), np.array(known), np.array(traction), INERTIA)


def noisy(given: Trajectory, std: float, seed: int) -> Trajectory:
    return replace(given, speed=given.speed + std * np.random.default_rng(seed).standard_normal(given.speed.size))


def curve(theta: np.ndarray, v: float) -> float:
    return float((theta - THETA) @ [1.0, v, v * v])


def test_exact_motion_gives_exact_parameters() -> None:
    fit = fit_davis(pieces(), WHITE)
    assert fit.converged
    assert max(abs(curve(fit.theta, v)) for v in (5.0, 12.0, 20.0)) < 1e-3
    assert fit.mse < 1e-9


def test_the_covariance_is_consistent_with_white_noise() -> None:
    clean, nees = pieces(), []
    for seed in range(20):
        fit = fit_davis(noisy(clean, 0.02, seed), WHITE)
        e = fit.theta - THETA
        nees.append(e @ np.linalg.solve(fit.covariance / fit.inflation, e) / 3.0)
    # Mean of 60 squares of normal numbers, with smaller weights beyond two standard deviations.
    assert 0.5 < np.mean(nees) < 1.7


def test_gusts_are_estimated_and_increase_the_standard_deviations() -> None:
    calm = fit_davis(noisy(pieces(), 0.02, 1), DavisFitConfig())
    z = []
    for seed in range(4):
        fit = fit_davis(noisy(pieces(gust=0.5, seed=seed), 0.02, seed), DavisFitConfig())
        assert fit.resistance(20.0)[1] > 2.0 * calm.resistance(20.0)[1]
        z += [curve(fit.theta, v) / fit.resistance(v)[1] for v in (12.0, 20.0)]
    assert np.sqrt(np.mean(np.square(z))) < 2.5


def test_slip_does_not_affect_the_fit() -> None:
    clean = noisy(pieces(), 0.02, 3)
    speed, rng = clean.speed.copy(), np.random.default_rng(4)
    for at in rng.integers(20, speed.size - 20, 30):
        speed[at : at + int(rng.integers(2, 9))] += rng.uniform(0.3, 2.0)
    slipped = replace(clean, speed=speed)
    robust = fit_davis(slipped, DavisFitConfig())
    plain = fit_davis(slipped, DavisFitConfig(huber=1e6, cut=1e6))
    assert robust.outliers > 0.03
    assert abs(curve(robust.theta, 15.0)) < 0.1
    assert abs(curve(plain.theta, 15.0)) > 2.0 * abs(curve(robust.theta, 15.0))


def test_the_delay_of_the_force_is_estimated() -> None:
    clean = pieces()
    late = np.where(clean.dt > 0.0, np.concatenate((clean.traction[:1], clean.traction[:-1])), clean.traction)
    shifted = replace(clean, traction=late, known=clean.known - clean.traction + late)
    fit = fit_davis(noisy(shifted, 0.02, 5), replace(DavisFitConfig(), force_skew=0.5))
    assert fit.force_delay == pytest.approx(0.2, abs=0.05)


def test_a_constant_speed_does_not_determine_the_parameters() -> None:
    count = 500
    dt = np.full(count, DT)
    dt[0] = 0.0
    level = Trajectory(np.full(count, 15.0), dt, np.full(count, 2.85), np.zeros(count), INERTIA)
    with pytest.raises(NoAnswerError, match='do not determine a, b and c separately'):
        fit_davis(level, WHITE)


def test_missing_speeds_and_invalid_settings_raise_errors() -> None:
    empty = Trajectory(*(np.zeros(0) for _ in range(4)), INERTIA)  # type: ignore[call-arg, arg-type]
    with pytest.raises(NoAnswerError, match='0 speeds without braking in 0 pieces'):
        fit_davis(empty, DavisFitConfig())
    with pytest.raises(InputError, match='huber'):
        fit_davis(pieces(1), DavisFitConfig(huber=0.0))


def test_few_lags_leave_the_density_near_the_declared_one() -> None:
    """A calm piece shorter than two lags has little information; many calm pieces show small disturbances."""
    config = DavisFitConfig()
    declared = 2.0 * config.disturbance_time * config.disturbance_std**2
    short = fit_davis(noisy(pieces(1, nodes=260), 0.02, 6), config)
    long = fit_davis(noisy(pieces(12), 0.02, 6), config)
    assert 0.3 * declared < short.disturbance < 3.0 * declared
    assert long.disturbance < 0.15 * declared


def test_standard_deviations_of_one_short_piece_in_gusts_are_consistent() -> None:
    z = []
    for seed in range(12):
        fit = fit_davis(noisy(pieces(1, gust=0.15, seed=100 + seed), 0.02, seed), DavisFitConfig())
        z += [curve(fit.theta, v) / fit.resistance(v)[1] for v in (5.0, 8.0, 11.0)]
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.parametrize('quantum', [1.0 / 3.6, 0.447])
def test_a_coarse_speed_causes_no_outliers_and_no_gusts(quantum: float) -> None:
    z, clean = [], pieces()
    for seed in range(4):
        exact = noisy(clean, 0.02, seed)
        fit = fit_davis(replace(exact, speed=quantum * np.round(exact.speed / quantum)), DavisFitConfig())
        assert fit.outliers < 0.01
        assert fit.speed_std > 0.9 * quantum / 12.0**0.5
        assert fit.resistance(8.0)[1] < 0.25
        z += [curve(fit.theta, v) / fit.resistance(v)[1] for v in (5.0, 8.0, 11.0)]
    assert np.sqrt(np.mean(np.square(z))) < 2.0


def test_a_fit_of_a_train_is_plausible_as_is_a_resistance_below_zero_within_its_uncertainty() -> None:
    theta = np.array([-0.5, 0.0, 0.004])
    for fit in (GOOD, replace(GOOD, theta=theta, covariance=np.diag([0.3, 0.01, 0.0005]) ** 2)):
        check_plausible(fit, DavisFitConfig())


@pytest.mark.parametrize(
    ('odd', 'message'),
    [
        ({'theta': np.array([-1.5, 0.02, 0.004])}, r'-1.4 N/kN .* at 3.0 m/s would drive the train'),
        ({'theta': np.array([9.0, 0.02, -0.03])}, r'at 21.0 m/s would drive the train'),
        ({'outliers': 0.31}, '31% of the speeds are outliers'),
        ({'force_gain': -0.997}, r'a force error of -100%'),
        ({'speed_std': 60.0}, 'speed noise is 60 m/s'),
        ({'disturbance': 1e4}, '22 N/kN of the motion unexplained'),
    ],
)
def test_an_implausible_value_is_reported_in_one_line(odd: dict[str, Any], message: str) -> None:
    with pytest.raises(NoAnswerError, match=message) as caught:
        check_plausible(replace(GOOD, **odd), DavisFitConfig())
    assert 'units' in str(caught.value)
    assert '\n' not in str(caught.value)
