# SPDX-License-Identifier: Apache-2.0
"""Normal distributions as in textbooks; the tracker follows steps, ignores bursts and recovers from lock-out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from test.resistance.reference_vmils import VMils
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.change_points import (
    OUTLIER_WIDTH,
    Array,
    ChangePointConfig,
    Normal,
    Tracker,
    gate,
    independent,
    inflated,
    mixed,
    normal,
    robust_fit,
    soft_update,
    weigh,
)

STD = np.array([0.9, 0.02, 5e-3, 0.03, 0.15, 0.2])


def some(n: int, seed: int = 1) -> Normal:
    """Correlated parameters whose standard deviations differ by orders of magnitude."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, 2 * n))
    S = root @ root.T
    r = STD[:n] / np.sqrt(np.diag(S))
    return normal(STD[:n] * rng.standard_normal(n), r[:, None] * S * r)


def regressor(n: int) -> Array:
    return np.array([1.0, 12.0, 150.0, -40.0, -3.0, 0.8])[:n]


def numbers(x: Array) -> vec[float]:
    return vec[float](x.tolist())


def assert_equal(found: Normal, theta: Array, P: Array, tolerance: float) -> None:
    """Compare two distributions in standard deviations."""
    std = np.sqrt(np.diag(P))
    assert np.max(np.abs(found.theta - theta) / std) < tolerance
    assert np.max(np.abs(found.P - P) / np.outer(std, std)) < tolerance


@pytest.mark.parametrize('n', [3, 6])
def test_without_outliers_an_update_is_that_of_recursive_least_squares(n: int) -> None:
    before, phi, y, R, slow = some(n), regressor(n), 5.0, 0.3, 2.0
    predicted = float(phi @ before.theta), float(phi @ before.P @ phi)
    assert before.predict(numbers(phi)) == pytest.approx(predicted)
    found, weight, score = soft_update(before, numbers(phi), y, R, slow, 0.0)
    nu, S = y - phi @ before.theta, phi @ before.P @ phi + R
    K = before.P @ phi / (phi @ before.P @ phi + slow * R)
    assert weight == 1.0
    assert score == pytest.approx(-0.5 * (nu * nu / S + math.log(2.0 * math.pi * S)), rel=1e-12)
    assert found.theta == pytest.approx(before.theta + K * nu, rel=1e-9)
    assert pytest.approx(before.P - np.outer(K, phi @ before.P), rel=1e-9, abs=1e-15) == found.P


@pytest.mark.parametrize('y', [1e3, -1e9, 1e150])
def test_an_outlier_changes_nothing_and_its_likelihood_is_bounded_below(y: float) -> None:
    before = some(6)
    found, weight, score = soft_update(before, numbers(regressor(6)), y, 0.3, 1.0, 0.05)
    assert found is before
    assert weight == 0.0
    assert score == pytest.approx(math.log(0.05 / (OUTLIER_WIDTH * math.sqrt(0.3))))


def test_a_mixture_has_the_moments_of_samples_drawn_from_it() -> None:
    one, other = some(3, 1), some(3, 2)
    rng, n = np.random.default_rng(5), 200_000
    draws = [rng.multivariate_normal(item.theta, item.P, k) for item, k in ((one, n // 4), (other, 3 * n // 4))]
    together = np.concatenate(draws)
    found = mixed([one, other], [2.0, 6.0])
    assert np.abs(found.theta - together.mean(axis=0)) == pytest.approx(np.zeros(3), abs=0.01 * STD[:3].max())
    assert np.diag(found.P) == pytest.approx(together.var(axis=0), rel=0.02)
    assert pytest.approx(one.P, rel=1e-12) == mixed([one], [0.3]).P
    # Other weights for the covariance leave the mean.
    stated, off = mixed([one, other], [2.0, 6.0], [1.0, 1.0]), np.array([one.theta, other.theta]) - found.theta
    assert stated.theta.tolist() == found.theta.tolist()
    assert pytest.approx(0.5 * (one.P + other.P + np.outer(off[0], off[0]) + np.outer(off[1], off[1]))) == stated.P


def test_steps_increase_variances_up_to_the_limit_and_keep_correlations() -> None:
    item = some(3)
    steps = np.array([1e-2, 1e-5, 1e-6])
    assert pytest.approx(np.diag(steps), abs=1e-15) == inflated(item, steps).P - item.P
    most = np.array([1.0, 1e-3, 1e-4])
    limited = inflated(item, 1e9 * steps, most)
    assert np.diag(limited.P) == pytest.approx(most)
    assert np.linalg.eigvalsh(limited.P)[0] > 0.0
    assert (limited.theta == item.theta).all()


def test_the_weight_is_the_probability_that_an_observation_is_good() -> None:
    nu, S, R, eps = 1.3, 0.4, 0.25, 0.1
    good = 0.9 * math.exp(-0.5 * nu * nu / S) / math.sqrt(2.0 * math.pi * S)
    anything = 0.1 / (OUTLIER_WIDTH * 0.5)
    assert weigh(nu, S, R, eps)[0] == pytest.approx(good / (good + anything), rel=1e-12)
    assert weigh(nu, S, R, eps)[1] == pytest.approx(math.log(good + anything), rel=1e-12)
    # At the gate good and bad are equally likely.
    assert weigh(gate(eps) * 0.5, R, R, eps)[0] == pytest.approx(0.5, abs=1e-9)
    assert gate(0.0) == math.inf


NOISE = 0.5
PRIOR = independent((1.0, 0.0, 0.0), (4.0, 0.01, 1e-4))
PLAN = ChangePointConfig(
    p=4, outliers=0.1, step_variances=(1.0, 1e-4, 1e-6), hazard=1e-3, spacing=8, hypotheses=5, min_age=32, lockout=60
)
Spoil = Callable[[int, np.random.Generator], float]


def phi(v: float) -> vec[float]:
    return vec[float]([1.0, v, v * v])


def w(v: float | NDArray[np.float64], a: float = 1.5) -> float | NDArray[np.float64]:
    return a + 0.03 * v + 0.004 * v * v


def track(
    seed: int,
    count: int,
    *,
    a: Callable[[int], float] = lambda _: 1.5,
    spoil: Spoil | None = None,
    plan: ChangePointConfig = PLAN,
) -> Tracker:
    rng, tracker = np.random.default_rng(seed), Tracker(PRIOR, plan)
    for i, v in enumerate(rng.uniform(3.0, 20.0, count).tolist()):
        y = float(w(v, a(i))) + NOISE * float(rng.standard_normal())
        tracker.update(phi(v), y + (spoil(i, rng) if spoil else 0.0), NOISE * NOISE)
    return tracker


def error(tracker: Tracker, a: float = 1.5) -> float:
    v = np.linspace(3.0, 20.0, 30)
    x, y, z = tracker.estimate.theta
    return float(np.sqrt(np.mean((x + y * v + z * v * v - w(v, a)) ** 2)))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.01, 0.3), st.floats(0.5, 5.0), st.floats(0.0, 30.0))
def test_the_long_memory_is_multi_innovation_least_squares(
    seed: int, p: int, outliers: float, slow: float, spoiled: float
) -> None:
    """Equal to the plain numpy reference in the form of the paper, with outliers of any size and at any share."""
    rng = np.random.default_rng(seed)
    tracker = Tracker(PRIOR, replace(PLAN, p=p, outliers=outliers, hypotheses=0, lockout=10_000))
    reference = VMils(PRIOR.theta, PRIOR.P, p, outliers)
    for v in rng.uniform(3.0, 20.0, 50).tolist():
        R = float(rng.uniform(0.1, 1.0))
        y = float(w(v)) + NOISE * float(rng.standard_normal()) + (spoiled if rng.random() < outliers else 0.0)
        weight = tracker.update(phi(v), y, R, slow)
        assert weight == pytest.approx(reference.update(np.array(phi(v)), y, R, slow), rel=1e-6, abs=1e-12)
        assert_equal(tracker.estimate, reference.theta, reference.P, 1e-6)


@pytest.mark.parametrize('seed', range(3))
def test_without_changes_it_is_as_accurate_as_least_squares(seed: int) -> None:
    tracker = track(seed, 2000)
    std = np.mean([tracker.estimate.predict(phi(v))[1] for v in np.linspace(3.0, 20.0, 30).tolist()]) ** 0.5
    assert tracker.steps_found == 0
    # Three parameters from 2000 observations, and some variance for a possible recent step.
    assert 0.9 < std / (NOISE * (3.0 / 2000.0) ** 0.5) < 1.7
    assert error(tracker) < 3.0 * std


@pytest.mark.parametrize('step', [0.5, -0.8, 6.0, -9.0])
def test_a_step_is_followed(step: float) -> None:
    tracker = track(11, 1120, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    assert error(tracker, 1.5 + step) < 0.2
    tracker = track(11, 1400, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    # One that took over is not followed by a younger one of the same step, except for a short time.
    assert 1 <= tracker.steps_found <= 2
    assert error(tracker, 1.5 + step) < 0.12


def test_the_stated_covariance_is_that_of_the_error_where_parameters_step_all_the_time() -> None:
    """The mean of 40 squares of unit normals is 0.55 to 1.6 in 49 of 50 cases; the long memory knows of no steps."""
    plan, steps, none = replace(PLAN, hypotheses=0, outliers=0.001), 0.002, np.zeros(3)
    stated, remembered = list[float](), list[float]()
    for seed in range(40):
        rng, truth, tracker = np.random.default_rng(seed), np.array([1.5, 0.03, 0.004]), Tracker(PRIOR, plan)
        for v in rng.uniform(3.0, 20.0, 400).tolist():
            truth = truth + np.sqrt(steps * np.array(plan.step_variances)) * rng.standard_normal(3)
            y = float(truth @ np.array(phi(v))) + NOISE * float(rng.standard_normal())
            tracker.update(phi(v), y, NOISE * NOISE)
            tracker.inflate_variance(none, np.full(3, np.inf), steps)
        for found, squares in ((tracker.stated, stated), (tracker.estimate, remembered)):
            mean, variance = found.predict(phi(10.0))
            squares.append((mean - float(truth @ np.array(phi(10.0)))) ** 2 / variance)
    assert 0.55 < np.mean(stated) < 1.6
    assert np.mean(remembered) > 5.0


def test_the_stated_covariance_covers_a_step_before_the_estimate_follows_it() -> None:
    plain, cautious = (
        track(3, 1010, a=lambda i: 1.5 if i < 1000 else 2.0, plan=replace(PLAN, step_weight=weight))
        for weight in (1.0, 100.0)
    )
    assert cautious.estimate.theta == pytest.approx(plain.estimate.theta, abs=0.01)
    assert cautious.stated.P[0, 0] > 1.5 * plain.stated.P[0, 0]


def test_the_stated_covariance_is_about_the_estimate() -> None:
    tracker = track(3, 400, plan=replace(PLAN, hypotheses=0))
    tracker.inflate_variance(np.zeros(3), np.full(3, np.inf), 0.5)
    tracker.update(phi(10.0), 3.0, NOISE * NOISE)
    apart = tracker.estimate.theta - tracker.walk.theta
    assert np.abs(apart).max() > 0.0
    assert tracker.stated.theta.tolist() == tracker.estimate.theta.tolist()
    assert_equal(tracker.stated, tracker.estimate.theta, tracker.walk.P + np.outer(apart, apart), 1e-12)


@pytest.mark.parametrize('seed', range(3))
def test_noise_that_lasts_for_eight_observations_is_not_detected_as_a_step(seed: int) -> None:
    rng, tracker = np.random.default_rng(seed), Tracker(PRIOR, PLAN)
    for v in rng.uniform(3.0, 20.0, (190, 8)).tolist():
        noise = NOISE * float(rng.standard_normal())
        for x in v:
            tracker.update(phi(x), float(w(x)) + noise, NOISE * NOISE, 8.0)
    assert tracker.steps_found == 0


@pytest.mark.parametrize('seed', range(3))
def test_bursts_are_not_detected_as_steps(seed: int) -> None:
    """A tenth of the observations lies in bursts of ten that have the same error."""
    tracker = track(seed, 1500, spoil=lambda i, _: 5.0 if i % 100 >= 90 else 0.0)
    assert tracker.steps_found == 0
    assert error(tracker) < 0.12


def test_it_is_robust_to_30_per_cent_one_sided_outliers() -> None:
    tracker = track(4, 1000, spoil=lambda _, rng: float(rng.uniform(4.0, 20.0)) if rng.random() < 0.3 else 0.0)
    assert error(tracker) < 0.15


def test_the_robust_fit_follows_the_rows_that_agree() -> None:
    rng = np.random.default_rng(8)
    v = rng.uniform(3.0, 20.0, 200)
    y = w(v) + NOISE * rng.standard_normal(200)
    y = np.where(rng.random(200) < 0.3, y + rng.uniform(4.0, 20.0, 200), y)
    rows = tuple((1.0, float(x), float(x * x), float(z), NOISE * NOISE, 1.0) for x, z in zip(v, y, strict=True))
    fit = robust_fit(rows, PRIOR)
    assert fit is not None
    at = np.linspace(3.0, 20.0, 30)
    wrong = np.array([fit.predict(phi(x))[0] for x in at.tolist()]) - w(at)
    # Three parameters from 140 good rows: 0.07.
    assert float(np.sqrt(np.mean(wrong**2))) < 0.25


def test_a_parameter_without_steps_keeps_its_variance_in_a_hypothesis_and_its_value_after_a_lock_out() -> None:
    """The second parameter has no step: a jump of the first by 9 does not affect it."""
    rng = np.random.default_rng(7)
    plan = replace(PLAN, step_variances=(1.0, 0.0))
    tracker = Tracker(independent((0.0, 0.0), (4.0, 4.0)), plan)
    for i in range(700):
        x = vec[float]([1.0, float(rng.uniform(-1.0, 1.0))])
        tracker.update(x, (1.0 if i < 600 else 10.0) + 0.5 * x[1] + 0.1 * float(rng.standard_normal()), 0.01)
        if i == 400:
            long, newest = tracker._memory, tracker._hypotheses[-1].normal.covariance
            assert newest[0] > 10.0 / long[0]
            assert newest[3] < 2.0 / long[4]
    assert tracker.steps_found >= 1
    assert tracker.estimate.theta == pytest.approx([10.0, 0.5], abs=0.1)


def test_widening_adds_variance_up_to_the_limit() -> None:
    tracker = track(3, 300)
    before, most = tracker.estimate, np.array((4.0, 0.01, 1e-4))
    tracker.inflate_variance(np.array((0.5, 0.0, 0.0)), most)
    assert tracker.estimate.theta == pytest.approx(before.theta, rel=1e-6)
    assert tracker.estimate.P[0, 0] == pytest.approx(before.P[0, 0] + 0.5, rel=1e-6)
    tracker.inflate_variance(np.array((50.0, 0.0, 0.0)), most)
    assert tracker.estimate.P[0, 0] == pytest.approx(4.0, rel=0.01)
