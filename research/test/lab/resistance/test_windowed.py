# SPDX-License-Identifier: Apache-2.0
"""The streaming regressions on coasting runs with known resistance, and statistics of their residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from research.papers import coasts as data
from trainid_lab.resistance.least_squares import least_squares
from trainid_lab.resistance.segments import Segments, Windows, observe
from trainid_lab.resistance.windowed import Residuals, WindowedRegression
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.setup.pipelines import RESISTANCE


def residuals_of(values: list[float]) -> Residuals:
    residuals = Residuals()
    for value in values:
        residuals = residuals.add(value)
    return residuals


def test_without_residuals_the_variance_is_the_declared_one() -> None:
    assert Residuals().variance(0.8) == pytest.approx(0.64)
    assert Residuals().long_run_variance(0.8) == pytest.approx(0.64)


def test_white_noise_is_estimated_and_has_equal_long_run_variance() -> None:
    residuals = residuals_of((0.5 * np.random.default_rng(80).standard_normal(4000)).tolist())
    assert residuals.variance(2.0) == pytest.approx(0.25, rel=0.1)
    assert residuals.long_run_variance(2.0) == pytest.approx(0.25, rel=0.25)


def test_positive_correlation_raises_and_negative_lowers_the_long_run_variance() -> None:
    noise = np.random.default_rng(81).standard_normal(4000)
    together, alternating = noise[1:] + noise[:-1], noise[1:] - noise[:-1]
    factors = [
        residuals_of(x.tolist()).long_run_variance(1.0) / residuals_of(x.tolist()).variance(1.0)
        for x in (together, alternating)
    ]
    assert factors[0] == pytest.approx(1.0 + 2.0 * 0.5 * 8.0 / 9.0, rel=0.15)
    assert 0.1 <= factors[1] < 0.3


def test_an_outlier_lies_beyond_the_robust_spread() -> None:
    residuals = Residuals()
    for value in np.random.default_rng(82).standard_normal(200):
        assert residuals.is_outlier(40.0, 3.0) is (len(residuals.recent) == 51)
        residuals = residuals.remember(float(value))
    assert not residuals.is_outlier(1.0, 3.0)
    assert residuals.is_outlier(6.0, 3.0)


NAMES = [name for name in RESISTANCE.names if isinstance(RESISTANCE[name].config, type(RESISTANCE['LS'].config))]
PLAN = data.CoastPlan(gust_std=0.1, coasts=8)


def made(name: str, **changes: float) -> WindowedRegression:
    generator = np.random.default_rng(0)
    estimator = RESISTANCE.make(RESISTANCE.choose(name, **changes), data.train_file(), generator)
    assert isinstance(estimator, WindowedRegression)
    return estimator


def learned(estimator: WindowedRegression, coasts: data.Coasts) -> ResistanceEstimate:
    for sample in data.samples(coasts):
        estimator.step(sample)
    return estimator.estimate(14.0)


def curve_error(estimate: ResistanceEstimate) -> float:
    theta = estimate.a, estimate.b * data.KMH, estimate.c * data.KMH**2
    return data.curve_error(theta, data.PAPER)


@pytest.mark.parametrize('name', NAMES)
def test_the_resistance_of_coasting_runs_is_estimated(name: str) -> None:
    estimator = made(name, window=11, hop=5)
    estimate = learned(estimator, data.drive(PLAN, np.random.default_rng(91)))
    assert curve_error(estimate) < 0.2
    assert estimator.converged
    # 24 to 79 km/h
    assert 5.5 < estimate.speed_min < 7.5
    assert 19.0 < estimate.speed_max < 22.5


def test_one_pass_of_the_stream_equals_the_batch() -> None:
    coasts = data.drive(PLAN, np.random.default_rng(92))
    # The first sample of a coasting run follows a gap and is not used.
    records = coasts.speed[:, 1:]
    for cutter, changes in (
        (Windows(11, 5), {'window': 11, 'hop': 5}),
        (Segments(1.0), {'segment': 1.0 * data.KMH}),
    ):
        seen = observe(records, cutter, period=0.2, rotary_mass=data.GAMMA, speed_unit=data.KMH)
        expected = least_squares(seen.regressors(), seen.y).theta
        found = learned(made('LS', **changes), coasts)
        theta = np.array([found.a, found.b * data.KMH, found.c * data.KMH**2])
        # Only the regressor differs: mean of v^2 with the weights of the slope, not the square of the mean speed.
        assert data.curve_error(theta - expected, (0.0, 0.0, 0.0)) < 2e-3


def test_innovation_length_does_not_shrink_the_covariance() -> None:
    coasts = data.drive(PLAN, np.random.default_rng(93))
    spread = {p: learned(made('MILS', innovation_length=p), coasts).resistance_std for p in (1, 8)}
    assert spread[8] == pytest.approx(spread[1], rel=0.15)


def test_vmils_skips_a_bad_observation_and_ls_does_not() -> None:
    coasts = data.drive(PLAN, np.random.default_rng(94))
    speed = coasts.speed.copy()
    speed[3:, 60:66] += 4.0
    spoiled = replace(coasts, speed=speed)
    estimator = made('V-MILS-printed')
    answers = [step_and_estimate(estimator, sample) for sample in data.samples(spoiled)]
    assert any(isinstance(answer, Rejection) and answer.reason is Reason.OUTLIER for answer in answers)
    assert curve_error(estimator.estimate(14.0)) < 0.4 * curve_error(learned(made('LS'), spoiled))


def test_wind_up_ends_in_a_rejection_never_in_nan() -> None:
    estimator = made('RLS', forgetting=0.5, window=5, hop=1)
    coast = data.drive(data.CoastPlan(coasts=1, samples=40), np.random.default_rng(95))
    steady = replace(coast, speed=np.full((1, 1100), 60.0))
    answers = [step_and_estimate(estimator, sample) for sample in data.samples(steady)]
    assert all(np.isfinite(answer.covariance).all() for answer in answers if isinstance(answer, ResistanceEstimate))
    assert isinstance(answers[-1], Rejection)
    assert answers[-1].reason is Reason.NUMERICAL


def test_a_restored_state_continues_bit_identically() -> None:
    samples = list(data.samples(data.drive(PLAN, np.random.default_rng(96))))[:900]
    original, copy = made('V-MILS-printed', window=11, hop=5), made('V-MILS-printed', window=11, hop=5)
    for sample in samples[:500]:
        original.step(sample)
    copy.restore(original.save())
    # As text, in which NaN equals NaN.
    assert [repr(original.step(s)) for s in samples[500:]] == [repr(copy.step(s)) for s in samples[500:]]
    assert copy.save() == original.save()


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match='hop = 30 must lie in'):
        made('LS', hop=30)
    with pytest.raises(InputError, match='penalty = -1'):
        made('regularised-LS', penalty=-1.0)
