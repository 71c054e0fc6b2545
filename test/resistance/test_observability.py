# SPDX-License-Identifier: Apache-2.0
"""Observability of least squares on known speeds is reported correctly."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.resistance.davis_posterior import Observability, observe, resistance_std

Speeds: TypeAlias = NDArray[np.float64]
PRIOR_STD = (0.9, 0.025, 0.003)
PRIOR = np.diag(np.square(PRIOR_STD))


def learned(speeds: Speeds, std: float = 0.2) -> tuple[float, ...]:
    """Covariance after one observation of w at each speed."""
    information = np.linalg.inv(PRIOR)
    for v in speeds:
        phi = np.array([1.0, v, v * v])
        information = information + np.outer(phi, phi) / std**2
    return tuple(map(float, np.linalg.inv(information).ravel()))


def seen(speeds: Speeds, std: float = 0.2) -> Observability:
    return observe(learned(speeds, std), tuple(map(float, PRIOR.ravel())), float(speeds.min()), float(speeds.max()))


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
    prior = tuple(map(float, PRIOR.ravel()))
    outcome = observe(prior, prior, 0.0, 0.0)
    assert outcome.text == 'nothing seen yet: estimates are the prior'
    assert outcome.shares == (0.0, 0.0, 0.0)
    assert math.isnan(outcome.std_observed)


def test_a_variance_that_grew_gives_no_negative_share() -> None:
    prior = tuple(map(float, PRIOR.ravel()))
    outcome = observe(tuple(2.0 * p for p in prior), prior, 5.0, 20.0)
    assert outcome.shares == (0.0, 0.0, 0.0)


def test_the_standard_deviation_of_w_is_that_of_the_quadratic_form() -> None:
    P = learned(np.linspace(3.0, 9.0, 20))
    phi = np.array([1.0, 7.0, 49.0])
    assert resistance_std(P, 7.0) == pytest.approx(math.sqrt(phi @ np.reshape(P, (3, 3)) @ phi))
