# SPDX-License-Identifier: Apache-2.0
"""Davis parameters: prior of the force errors, drift, inflation, when an estimate is fit to use, and observability."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.resistance.davis_posterior import (
    DavisPosterior,
    DrivenSpeeds,
    Inflation,
    Observability,
    drift_rates,
    drifted,
    force_variances,
    is_accurate,
    is_accurate_over_driven_speeds,
    largest_std,
    length_under_train,
    observe,
    predict,
    representative_speeds,
    resistance_std,
    scale_step,
)
from trainid_ros.train.train_file import Davis, Effect, Train, TrainFile

Array = NDArray[np.float64]
ESTIMATE: DavisPosterior = (1.4, 0.02, 0.01, 0.81, 0.001, -1e-5, 4e-4, 1e-6, 2.5e-5)


def matrix(estimate: DavisPosterior) -> Array:
    A, B, C, D, E, F = estimate[3:]
    return np.array([[A, B, C], [B, D, E], [C, E, F]])


def test_prediction_and_the_standard_deviation_of_w_are_quadratic_forms() -> None:
    phi, P = np.array([1.0, 7.0, 53.0]), matrix(ESTIMATE)
    assert predict(ESTIMATE, 7.0, 53.0) == pytest.approx((float(phi @ ESTIMATE[:3]), float(phi @ P @ phi)))
    phi[2] = 49.0
    assert resistance_std(P.ravel().tolist(), 7.0) == pytest.approx(math.sqrt(phi @ P @ phi))


def test_drift_increases_variances_up_to_the_limit_and_keeps_correlations() -> None:
    rates = 1e-3, 1e-6, 1e-7
    some = drifted(ESTIMATE, rates, 10.0, (9.0, 9.0, 9.0))
    assert np.diag(matrix(some)) - np.diag(matrix(ESTIMATE)) == pytest.approx([1e-2, 1e-5, 1e-6])
    most = drifted(ESTIMATE, rates, 1e9, (1.0, 1e-3, 1e-4))
    assert np.diag(matrix(most)) == pytest.approx([1.0, 1e-3, 1e-4])
    assert np.min(np.linalg.eigvalsh(matrix(most))) > 0.0
    assert most[:3] == ESTIMATE[:3]


def mean_over(length: float, train_length: float) -> float:
    """Return integral over variance of the mean over a train of a process with the autocorrelation exp(-d / length)."""
    u = np.linspace(-train_length, train_length, 200_001)
    weights = (train_length - np.abs(u)) / train_length**2
    variance = float(np.sum(weights * np.exp(-np.abs(u) / length)) * (u[1] - u[0]))
    return length / variance


@pytest.mark.parametrize(('length', 'train_length'), [(250.0, 30.0), (250.0, 650.0), (1000.0, 200.0), (1000.0, 1000.0)])
def test_the_map_error_under_a_train_is_correlated_further(length: float, train_length: float) -> None:
    assert length_under_train(length, train_length) == pytest.approx(mean_over(length, train_length), rel=1e-4)


def test_the_map_error_under_a_short_train_is_that_of_the_map() -> None:
    assert length_under_train(250.0, 1e-9) == pytest.approx(250.0)
    assert length_under_train(250.0, 0.2499) == pytest.approx(length_under_train(250.0, 0.2501), rel=1e-6)


def test_after_an_hour_the_drift_is_its_share_of_the_prior() -> None:
    rates = drift_rates(0.1, (4.0, 1.0, 0.25))
    assert [3600.0 * rate for rate in rates] == pytest.approx([0.04, 0.01, 0.0025])


@pytest.mark.parametrize(
    ('sign', 'driven'),
    [
        (1.0, (3.0, 20.0)),  # largest at the fastest speed
        (-1.0, (3.0, 20.0)),  # a and c make up for each other: largest at an end or in between
        (-1.0, (0.0, 0.0)),  # nothing learned yet
    ],
)
def test_the_largest_deviation_is_that_at_the_worst_speed(sign: float, driven: tuple[float, float]) -> None:
    # w is exact at 15 m/s where the errors of a and c cancel.
    shape = np.array([0.9, 0.0, sign * 0.004])
    P = np.outer(shape, shape) + np.diag([1e-3, 1e-6, 1e-8])
    speeds = np.linspace(*driven, 200)
    phi = np.stack((np.ones(200), speeds, speeds**2))
    stds = np.sqrt(np.einsum('it,ij,jt->t', phi, P, phi))
    covariance = tuple(P.ravel().tolist())
    assert largest_std(covariance, driven, 0.0) == pytest.approx(float(stds.max()), rel=0.01)
    assert largest_std(covariance, driven, 50.0) == 50.0


FILE = TrainFile(Train(200e3, mass_std=0.03, force_std=0.02), Davis(1.5, 0.03, 0.004))


def prior_stds(file: TrainFile) -> list[float]:
    return [math.sqrt(variance) for variance in force_variances(file, 0.15)]


def test_the_scale_follows_mass_and_force_and_the_delay_its_setting() -> None:
    known, exact = (
        replace(FILE, train=replace(FILE.train, mass_std=mass, force_std=force))
        for mass, force in ((0.002, 0.003), (0.0, 0.0))
    )
    assert prior_stds(FILE)[:2] == pytest.approx([math.hypot(0.03, 0.02), 0.15])
    # The uncertainty of the force is independent of that of its stamps.
    assert prior_stds(known)[:2] == pytest.approx([math.hypot(0.002, 0.003), 0.15])
    assert min(force_variances(exact, 0.0)) > 0.0


@pytest.mark.parametrize(
    ('effects', 'std'),
    [
        ((), 0.5),
        ((Effect('curve_resistance', (('coefficient', 600.0),), (('coefficient', 60.0),)),), 0.1),
        ((Effect('curve_resistance', (('coefficient', 600.0),)),), 0.2),
        ((Effect('tunnel_drag', (('factor', 1.3),)),), 0.5),
    ],
)
def test_the_curve_has_its_stated_uncertainty_or_a_fifth(effects: tuple[Effect, ...], std: float) -> None:
    assert prior_stds(replace(FILE, effects=effects))[2] == pytest.approx(std)


def test_a_stop_changes_the_scale_by_a_load_or_at_most_half_of_the_error_of_the_weighed_mass() -> None:
    assert scale_step(FILE.train, weighed=True) == 0.004
    assert scale_step(replace(FILE.train, mass_std=0.0), weighed=False) == 0.03
    assert scale_step(replace(FILE.train, mass_std=0.002), weighed=True) == 0.001


def inflation(std: float, rho: float = 0.0) -> list[float]:
    """Return the factors for innovations of unit predicted variance."""
    rng, item, x, found = np.random.default_rng(1), Inflation(), 0.0, []
    for _ in range(20_000):
        x = rho * x + (1.0 - rho * rho) ** 0.5 * float(rng.standard_normal())
        item.add(std * x, 1.0, 1.2)
        found.append(item.factor)
    return found


def test_correct_variances_hardly_inflate_the_covariance() -> None:
    found = inflation(1.0)
    assert min(found) == 1.0
    # A mean of about 15 squares has a standard deviation of a third.
    assert np.mean(found) < 1.25


def test_large_and_correlated_errors_inflate_the_covariance() -> None:
    assert np.mean(inflation(2.0)) == pytest.approx(3.6, rel=0.2)  # 4, reduced by the limit of one batch
    assert np.mean(inflation(1.0, rho=0.5)) == pytest.approx(3.0, rel=0.2)  # (1 + rho) / (1 - rho)


def test_the_contribution_of_one_batch_is_limited() -> None:
    item = Inflation()
    for _ in range(40):
        item.add(1e6, 1.0, 1.2)
    assert item.factor == pytest.approx(2.0)


@pytest.mark.parametrize(
    ('std', 'was_accurate', 'expected'),
    [(0.09, False, True), (0.11, False, False), (0.11, True, True), (0.149, True, True), (0.151, True, False)],
)
def test_the_limit_is_half_as_large_again_for_an_estimate_that_was_fit(
    std: float, was_accurate: bool, expected: bool
) -> None:
    assert is_accurate((std * std,) * 3, 0.1, was_accurate=was_accurate) is expected


def test_both_ends_and_the_middle_of_the_speeds_have_equal_weight() -> None:
    assert representative_speeds(2.0, 10.0) == (2.0, 6.0, 10.0)
    variances = (0.01, 0.02, 0.03)
    assert is_accurate(variances, 0.02**0.5 + 1e-9, was_accurate=False)
    assert not is_accurate(variances, 0.02**0.5 - 1e-9, was_accurate=False)


def driven(*speeds: float) -> DrivenSpeeds:
    found = DrivenSpeeds()
    for v in speeds:
        found.add(v)
    return found


def moments(found: DrivenSpeeds) -> tuple[float, float, float, float]:
    return found.m1, found.m2, found.m3, found.m4


def test_a_mean_speed_updates_slowest_and_fastest() -> None:
    found = driven(10.0)
    found.add_mean(6.0, 4.0, 11.0)
    assert (found.slowest, found.fastest) == (4.0, 11.0)
    assert moments(found) == moments(driven(10.0, 6.0))


def test_moments_of_a_day_lose_no_digits() -> None:
    speeds = np.random.default_rng(1).uniform(0.0, 80.0, 50_000)
    found = driven(*speeds.tolist())
    assert (found.count, found.slowest, found.fastest) == (50_000, speeds.min(), speeds.max())
    assert moments(found) == pytest.approx(tuple(np.mean(speeds**k) for k in (1, 2, 3, 4)), rel=1e-11)


THETA = (1.0, 0.1, 0.01)


def fit_where(
    driven: DrivenSpeeds, covariance: Array, valid_std: float, share: float = 0.0, *, was_accurate: bool = False
) -> bool:
    """Return whether w with the parameters THETA is fit."""
    posterior = (*THETA, *covariance[np.triu_indices(3)].tolist())
    return is_accurate_over_driven_speeds(posterior, driven, valid_std, share, was_accurate=was_accurate)


def fit(std_a: float, std_b: float = 0.0, *, share: float = 0.0, was_accurate: bool = False) -> bool:
    """Return whether w is fit at 5 and 15 m/s, driven equally often, with a limit of 0.1 N/kN."""
    covariance = np.diag([std_a**2, std_b**2, 0.0])
    return fit_where(driven(5.0, 15.0), covariance, 0.1, share, was_accurate=was_accurate)


def test_before_the_first_speed_nothing_is_fit() -> None:
    for was_accurate in (False, True):
        assert not fit_where(DrivenSpeeds(), np.zeros((3, 3)), 0.1, 0.05, was_accurate=was_accurate)


@pytest.mark.parametrize(
    ('std', 'was_accurate', 'expected'),
    [(0.099, False, True), (0.101, False, False), (0.101, True, True), (0.199, True, True), (0.201, True, False)],
)
def test_over_driven_speeds_the_limit_is_twice_as_large_if_it_was_fit(
    std: float, was_accurate: bool, expected: bool
) -> None:
    assert fit(std, was_accurate=was_accurate) is expected


def test_the_limit_applies_to_the_root_mean_square_over_the_driven_speeds() -> None:
    # An error of b of 0.01 N/kN per m/s: 0.05 N/kN at 5 m/s, 0.15 N/kN at 15 m/s, 0.1118 N/kN in root mean square.
    rms = math.sqrt((0.05**2 + 0.15**2) / 2.0)
    assert fit(0.0, 0.01 * 0.1 / rms * 0.999)
    assert not fit(0.0, 0.01 * 0.1 / rms * 1.001)


def test_a_speed_counts_as_often_as_it_was_driven() -> None:
    covariance = np.diag([0.0, 0.01**2, 0.0])
    for speeds, expected in (((5.0, 5.0, 5.0, 15.0), True), ((5.0, 15.0, 15.0, 15.0), False)):
        assert fit_where(driven(*speeds), covariance, 0.1) is expected


def test_a_share_of_the_resistance_adds_to_the_limit_in_squares() -> None:
    # w is 1.75 and 4.75 N/kN: 3.5795 in root mean square. A twentieth of it is 0.17897; with 0.1 the limit is 0.20502.
    limit = math.hypot(0.1, 0.05 * math.sqrt((1.75**2 + 4.75**2) / 2.0))
    assert limit == pytest.approx(0.20502, abs=1e-5)
    assert fit(0.999 * limit, share=0.05)
    assert not fit(1.001 * limit, share=0.05)
    assert fit(1.999 * limit, share=0.05, was_accurate=True)
    assert not fit(2.001 * limit, share=0.05, was_accurate=True)


def test_correlated_errors_may_cancel_where_driven() -> None:
    # Only w at 10 m/s is known: the errors of a and b cancel there.
    direction = np.array([1.0, -0.1, 0.0])
    covariance = np.outer(direction, direction)
    assert fit_where(driven(10.0, 10.0), covariance, 0.01)
    assert not fit_where(driven(5.0, 15.0), covariance, 0.4)


PRIOR = np.diag(np.square((0.9, 0.025, 0.003)))
STATED = tuple(map(float, PRIOR.ravel()))


def learned(speeds: Array, std: float = 0.2) -> tuple[float, ...]:
    """Covariance after one observation of w at each speed."""
    information = np.linalg.inv(PRIOR)
    for v in speeds:
        phi = np.array([1.0, v, v * v])
        information = information + np.outer(phi, phi) / std**2
    return tuple(map(float, np.linalg.inv(information).ravel()))


def seen(speeds: Array, std: float = 0.2) -> Observability:
    return observe(learned(speeds, std), STATED, float(speeds.min()), float(speeds.max()))


def test_all_speeds_determine_all_parameters() -> None:
    speeds = np.linspace(1.0, 22.0, 300)
    outcome, P = seen(speeds, 0.05), np.reshape(learned(speeds, 0.05), (3, 3))
    assert outcome.shares == pytest.approx(tuple(1.0 - np.diag(P) / np.diag(PRIOR)))
    assert all(share > 0.8 for share in outcome.shares)
    assert outcome.text == 'a, b and c seen: speeds seen 1.0 to 22.0 m/s'
    assert outcome.std_observed < 0.02
    assert outcome.known == (0.0, 25.0)


def test_low_speeds_do_not_determine_c_and_the_speed_from_which_it_shows_is_named() -> None:
    speeds = np.linspace(0.5, 5.0, 60)
    outcome = seen(speeds)
    assert outcome.text.startswith('a seen, b not seen below ')
    assert outcome.text.endswith(' m/s: speeds seen 0.5 to 5.0 m/s')
    assert outcome.shares[0] > 0.5 > outcome.shares[2]
    named = float(outcome.text.split('c not seen below ')[1].split()[0])
    # There the standard deviation of c alone changes w by two standard deviations of w at the speeds seen.
    std_c = math.sqrt(learned(speeds)[8])
    assert named == pytest.approx(math.sqrt(2.0 * outcome.std_observed / std_c), abs=0.5)
    assert named > 5.0
    assert outcome.std_outside > 3.0 * outcome.std_observed


def test_one_speed_determines_w_there_and_no_parameter() -> None:
    outcome = seen(np.full(200, 15.0))
    assert outcome.std_observed == pytest.approx(0.2 / math.sqrt(200.0), rel=0.05)
    assert 'not distinguishable' in outcome.text
    low, high = outcome.known
    assert 13.0 < low <= 15.0 <= high < 17.0


def test_the_known_range_ends_where_the_standard_deviation_has_doubled() -> None:
    speeds = np.linspace(4.0, 10.0, 80)
    outcome, P = seen(speeds), learned(speeds)
    low, high = outcome.known
    assert all(resistance_std(P, v) <= 2.0 * outcome.std_observed for v in (low, high))
    assert resistance_std(P, high + 0.5) > 2.0 * outcome.std_observed
    assert low <= 4.0
    assert high > 10.0


def test_an_estimate_without_data_is_reported_as_the_prior() -> None:
    outcome = observe(STATED, STATED, 0.0, 0.0)
    assert outcome.text == 'nothing seen yet: estimates are the prior'
    assert outcome.shares == (0.0, 0.0, 0.0)
    assert math.isnan(outcome.std_observed)


def test_a_variance_that_grew_gives_no_negative_share() -> None:
    assert observe(tuple(2.0 * p for p in STATED), STATED, 5.0, 20.0).shares == (0.0, 0.0, 0.0)
