# SPDX-License-Identifier: Apache-2.0
"""The tracker follows steps, ignores bursts, recovers from lock-out and otherwise does not forget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from test.resistance.reference_vmils import VMils
from trainid_ros.interface.state import encode, restore
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.change_points import ChangePointConfig, Tracker, robust_fit
from trainid_ros.resistance.normal import independent

STD = 0.5
PRIOR = independent((1.0, 0.0, 0.0), (4.0, 0.01, 1e-4))
PLAN = ChangePointConfig(
    p=4,
    outliers=0.1,
    step_variances=(1.0, 1e-4, 1e-6),
    hazard=1e-3,
    spacing=8,
    hypotheses=5,
    min_age=32,
    lockout=60,
)
Spoil = Callable[[int, np.random.Generator], float]


def phi(v: float) -> vec[float]:
    return vec[float]([1.0, v, v * v])


def w(v: float | NDArray[np.float64], a: float = 1.5) -> float | NDArray[np.float64]:
    return a + 0.03 * v + 0.004 * v * v


def track(seed: int, count: int, *, a: Callable[[int], float] = lambda _: 1.5, spoil: Spoil | None = None) -> Tracker:
    rng, tracker = np.random.default_rng(seed), Tracker(PRIOR, PLAN)
    for i, v in enumerate(rng.uniform(3.0, 20.0, count).tolist()):
        y = float(w(v, a(i))) + STD * float(rng.standard_normal())
        tracker.update(phi(v), y + (spoil(i, rng) if spoil else 0.0), STD * STD)
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
        y = float(w(v)) + STD * float(rng.standard_normal()) + (spoiled if rng.random() < outliers else 0.0)
        weight = tracker.update(phi(v), y, R, slow)
        assert weight == pytest.approx(reference.update(np.array(phi(v)), y, R, slow), rel=1e-6, abs=1e-12)
        std = np.sqrt(np.diag(reference.P))
        assert np.max(np.abs(tracker.estimate.theta - reference.theta) / std) < 1e-6
        assert np.max(np.abs(tracker.estimate.P - reference.P) / np.outer(std, std)) < 1e-6


@pytest.mark.parametrize('seed', range(3))
def test_without_changes_it_is_as_accurate_as_least_squares(seed: int) -> None:
    tracker = track(seed, 2000)
    std = np.mean([tracker.estimate.predict(phi(v))[1] for v in np.linspace(3.0, 20.0, 30).tolist()]) ** 0.5
    assert tracker.steps_found == 0
    # Three parameters from 2000 observations, and some variance for a possible recent step.
    assert 0.9 < std / (STD * (3.0 / 2000.0) ** 0.5) < 1.7
    assert error(tracker) < 3.0 * std


@pytest.mark.parametrize('step', [0.5, -0.8, 6.0, -9.0])
def test_a_step_is_followed(step: float) -> None:
    tracker = track(11, 1120, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    assert error(tracker, 1.5 + step) < 0.2
    tracker = track(11, 1400, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    # One that took over is not followed by a younger one of the same step, except for a short time.
    assert 1 <= tracker.steps_found <= 2
    assert error(tracker, 1.5 + step) < 0.12


def test_the_stated_covariance_covers_a_step_before_the_estimate_follows_it() -> None:
    def known(step_weight: float) -> Tracker:
        tracker, rng = Tracker(PRIOR, replace(PLAN, step_weight=step_weight)), np.random.default_rng(3)
        for i, v in enumerate(rng.uniform(3.0, 20.0, 1010).tolist()):
            y = float(w(v, 1.5 if i < 1000 else 2.0)) + STD * float(rng.standard_normal())
            tracker.update(phi(v), y, STD * STD)
        return tracker

    plain, cautious = known(1.0), known(100.0)
    assert plain.stated.P.tolist() == plain.estimate.P.tolist()
    assert cautious.estimate.theta == pytest.approx(plain.estimate.theta, abs=0.01)
    assert cautious.stated.P[0, 0] > 1.5 * plain.stated.P[0, 0]


@pytest.mark.parametrize('seed', range(3))
def test_noise_that_lasts_for_eight_observations_is_not_detected_as_a_step(seed: int) -> None:
    rng, tracker = np.random.default_rng(seed), Tracker(PRIOR, PLAN)
    for v in rng.uniform(3.0, 20.0, (190, 8)).tolist():
        noise = STD * float(rng.standard_normal())
        for x in v:
            tracker.update(phi(x), float(w(x)) + noise, STD * STD, 8.0)
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


def test_a_restored_tracker_continues_bit_identically() -> None:
    tracker = track(5, 333)
    copy = Tracker(PRIOR, PLAN)
    restore(copy, encode(tracker))
    copy.refresh()
    for item in (tracker, copy):
        item.update(vec[float]([1.0, 10.0, 101.0]), 3.0, 0.2, 1.5)
    assert copy.estimate.theta.tolist() == tracker.estimate.theta.tolist()
    assert encode(copy) == encode(tracker)
    copy.reset()
    assert copy.estimate.theta == pytest.approx(PRIOR.theta)
    assert pytest.approx(PRIOR.P) == copy.estimate.P


def test_the_robust_fit_follows_the_rows_that_agree() -> None:
    rng = np.random.default_rng(8)
    v = rng.uniform(3.0, 20.0, 200)
    y = w(v) + STD * rng.standard_normal(200)
    y = np.where(rng.random(200) < 0.3, y + rng.uniform(4.0, 20.0, 200), y)
    rows = tuple((1.0, float(x), float(x * x), float(z), STD * STD, 1.0) for x, z in zip(v, y, strict=True))
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
