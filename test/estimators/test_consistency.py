# SPDX-License-Identifier: Apache-2.0
"""Correct variances pass for any seed; too small ones are detected; each update counts once."""

from __future__ import annotations

import math
import os
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.estimators.pipeline import WINDOW, Consistency, ConsistencyMonitor, ConsistencyVerdict, nis_band

SEEDS = 200


def monitored(z: NDArray[np.float64], stated: float = 1.0) -> ConsistencyMonitor:
    monitor = ConsistencyMonitor()
    for innovation in z:
        monitor.add(float(innovation), stated, used=True)
    return monitor


def correlated(rng: np.random.Generator, rho: float, count: int) -> NDArray[np.float64]:
    """Innovations of variance 1 with correlation rho of neighbours."""
    z = np.empty(count)
    z[0] = rng.standard_normal()
    for k in range(1, count):
        z[k] = rho * z[k - 1] + math.sqrt(1.0 - rho * rho) * rng.standard_normal()
    return z


@pytest.mark.parametrize('count', [30, 50, 200])
def test_the_band_is_that_of_chi_squared(count: int) -> None:
    from scipy.stats import chi2  # noqa: PLC0415 - each process that collects tests would import it

    low, high = nis_band(count)
    assert low == pytest.approx(chi2.ppf(0.005, count) / count, rel=0.01)
    assert high == pytest.approx(chi2.ppf(0.995, count) / count, rel=0.01)


@pytest.mark.parametrize('rho', [0.0, 0.5, 0.8])
def test_correct_variances_are_in_the_band_for_new_seeds(rho: float) -> None:
    """On average 2 of 200 lie outside the band, slightly more with correlation; more than 14 have probability 1e-7."""
    seed = int.from_bytes(os.urandom(4))
    rng = np.random.default_rng(seed)
    verdicts = [monitored(correlated(rng, rho, WINDOW)).current().verdict for _ in range(SEEDS)]
    assert verdicts.count(ConsistencyVerdict.CONSISTENT) >= SEEDS - 14, f'seed {seed}'


@pytest.mark.parametrize(
    ('stated', 'verdict'), [(0.5, ConsistencyVerdict.OPTIMISTIC), (2.0, ConsistencyVerdict.PESSIMISTIC)]
)
@pytest.mark.parametrize('rho', [0.0, 0.4])
def test_a_variance_wrong_by_a_factor_of_two_is_detected(
    stated: float, verdict: ConsistencyVerdict, rho: float
) -> None:
    seed = int.from_bytes(os.urandom(4))
    rng = np.random.default_rng(seed)
    verdicts = [monitored(correlated(rng, rho, WINDOW), stated).current().verdict for _ in range(50)]
    assert verdicts.count(verdict) >= 45, f'seed {seed}'


def test_the_alarm_is_raised_only_after_a_full_optimistic_window() -> None:
    rng = np.random.default_rng(7001)
    monitor = ConsistencyMonitor()
    first, alarmed = 0, 0
    for k in range(1, 4 * WINDOW):
        monitor.add(float(rng.standard_normal()), 0.3, used=True)
        current = monitor.current()
        first = first or (k if current.verdict is ConsistencyVerdict.OPTIMISTIC else 0)
        alarmed = alarmed or (k if current.is_alarm else 0)
    assert 0 < first < WINDOW
    assert alarmed >= first + WINDOW - 1
    for innovation in rng.standard_normal(2 * WINDOW):
        monitor.add(float(innovation), 1.0, used=True)
    assert not monitor.current().is_alarm


def test_an_update_counts_once_and_a_rejected_one_never() -> None:
    monitor = ConsistencyMonitor()
    for innovation, used in ((1.0, True), (2.0, True), (50.0, False), (3.0, True)):
        monitor.add(innovation, 4.0, used=used)
        for _ in range(5):  # samples between updates repeat the pair, accepted or not
            monitor.add(innovation, 4.0, used=True)
            monitor.add(innovation, 4.0, used=False)
    current = monitor.current()
    assert current.updates == 3
    assert current.ratio == pytest.approx((1.0 + 4.0 + 9.0) / 12.0)


@pytest.mark.parametrize(
    ('innovation', 'variance'), [(1.0, 0.0), (1.0, -1.0), (1.0, math.nan), (1.0, math.inf), (math.nan, 1.0)]
)
def test_an_innovation_without_a_variance_is_not_judged(innovation: float, variance: float) -> None:
    monitor = ConsistencyMonitor()
    monitor.add(innovation, variance, used=True)
    current = monitor.current()
    assert (current.verdict, current.updates) == (ConsistencyVerdict.UNKNOWN, 0)
    assert 'no innovation' in str(current)


def test_only_the_window_counts_and_running_sums_stay_exact() -> None:
    rng = np.random.default_rng(7002)
    z = np.concatenate((1e12 * rng.standard_normal(300), 1e-3 * rng.standard_normal(5000), rng.standard_normal(WINDOW)))
    current = monitored(z).current()
    expected = z[-WINDOW:]
    correlation = float(sum(a * b for a, b in pairwise(expected)) / np.sum(expected**2))
    assert current.updates == WINDOW
    assert current.ratio == pytest.approx(float(np.mean(expected**2)), rel=1e-9)
    assert (current.low, current.high) == pytest.approx(nis_band(WINDOW, correlation), rel=1e-9)


@pytest.mark.parametrize(
    ('verdict', 'ratio', 'meaning'),
    [
        ('optimistic', 2.25, ': predictions miss by 1.50 times the stated std, so allow for errors as much larger'),
        ('consistent', 1.0, ''),
        ('pessimistic', 0.49, ': predictions miss by 0.70 times the stated std, so the stated one is safe, '
                              'but wider than it need be'),
    ],
)  # fmt: skip
def test_the_text_states_verdict_numbers_and_what_they_mean(verdict: str, ratio: float, meaning: str) -> None:
    text = str(Consistency(ConsistencyVerdict(verdict), ratio, 0.76, 1.28, 200, 3))
    numbers = f'squared innovations {ratio:.2f} times the stated variance; 99 % band 0.76 to 1.28, 200 updates'
    assert text == f'{verdict} ({numbers}){meaning}'


@pytest.mark.parametrize(('size', 'refuted'), [(1.9, False), (2.1, True)])
def test_errors_twice_as_large_as_stated_refute_after_a_full_window(size: float, refuted: bool) -> None:
    z = size * np.resize([1.0, -1.0], 3 * WINDOW)
    assert monitored(z + 1e-9 * np.arange(len(z))).refuted is refuted
    assert not monitored(z[: WINDOW // 2]).refuted
