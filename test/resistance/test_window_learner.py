# SPDX-License-Identifier: Apache-2.0
"""Resistance from a window of speed: exact without noise, else consistent with its noise; windows are cut by time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from test.resistance.reference_vmils import observation
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.resistance.window_learner import (
    Cut,
    SlidingWindow,
    SlowNoise,
    WindowResult,
    WindowSample,
    observe_resistance,
    overlap_factor,
)

INERTIA, STD = 110.0, 0.025
START = 1_700_000_000 * NS_PER_S


def window(
    count: int, davis: tuple[float, float, float] = (2.0, 0.0, 0.0), *,
    seed: int = 0, noise: float = 0.0, force: bool = True, speed: float = 15.0,
) -> list[WindowSample]:  # fmt: skip
    """Ticks of exact motion under a + b v + c v^2, with irregular steps and changing force."""
    rng, (a, b, c) = np.random.default_rng(seed), davis
    v, stamp, ticks = speed, START, []
    for i in range(count):
        dt_ns = int(rng.integers(120_000_000, 380_000_000))
        u = float(rng.uniform(-20.0, 60.0)) if force else 0.0
        dt = dt_ns / NS_PER_S
        if i:
            stamp += dt_ns
            for _ in range(200):
                middle = v + 0.5 * dt / 200 * (u - a - b * v - c * v * v) / INERTIA
                v += dt / 200 * (u - a - b * middle - c * middle * middle) / INERTIA
        ticks.append(WindowSample(stamp, dt, v + noise * float(rng.standard_normal()), u, u))
    return ticks


def observed(ticks: list[WindowSample]) -> WindowResult:
    result = observe_resistance(ticks, INERTIA, STD)
    assert isinstance(result, WindowResult)
    return result


@pytest.mark.parametrize('seed', range(5))
def test_the_regressor_includes_resistance_that_grows_with_speed(seed: int) -> None:
    a, b, c = 1.5, 0.03, 0.008
    result = observed(window(40, (a, b, c), seed=seed))
    # Speed is taken as linear between samples; the curvature of 0.4 s of motion costs less than this.
    assert result.y == pytest.approx(a + b * result.phi[1] + c * result.phi[2], abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(8, 60), st.floats(3.0, 40.0), st.floats(0.0, 0.01))
def test_a_window_is_observed_as_by_the_reference(seed: int, count: int, speed: float, noise: float) -> None:
    ticks = window(count, (1.5, 0.03, 0.004), seed=seed, speed=speed, noise=noise)
    dt, v, force = np.array([(item.dt, item.speed, item.known_force) for item in ticks]).T
    y, phi = observation(dt[1:], v, force[1:], INERTIA)
    assert observed(ticks).y == pytest.approx(y, rel=1e-9, abs=1e-9)
    assert observed(ticks).phi == pytest.approx(phi, rel=1e-9, abs=1e-9)


def test_three_spikes_in_a_window_change_nothing() -> None:
    clean = observed(window(25, seed=1))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        ticks = window(25, seed=1)
        for k in rng.choice(25, 3, replace=False).tolist():
            spike = float(rng.choice([-8.0, -1.0, 0.5, 20.0]))
            ticks[k] = replace(ticks[k], speed=ticks[k].speed + spike)
        result = observed(ticks)
        # The other speeds are exact, so without the spikes the result is exact.
        assert result.y == pytest.approx(clean.y, abs=1e-9), seed
        # Resistance 2 and no noise: the interpolated speeds change the mean speed of the regressor little.
        assert result.phi[0] == pytest.approx(1.0, abs=1e-12)
        assert result.phi[1] == pytest.approx(clean.phi[1], abs=0.1)
        assert result.noise_std > clean.noise_std


def test_slip_over_half_of_the_window_is_rejected_with_value_and_limit() -> None:
    ticks = window(25, seed=1)
    slipped = [replace(t, speed=t.speed + (2.0 if 6 <= i < 18 else 0.0)) for i, t in enumerate(ticks)]
    result = observe_resistance(slipped, INERTIA, STD)
    assert isinstance(result, Rejection)
    assert (result.reason, result.stamp_ns) == (Reason.SPEED_INCONSISTENT, ticks[-1].stamp_ns)
    assert result.value > result.limit == 5.0 * STD


def test_the_stated_noise_is_correct_and_there_is_no_bias() -> None:
    results = [observed(window(25, seed=s, noise=STD, force=False)) for s in range(400)]
    z = np.array([(r.y - 2.0) / r.noise_std for r in results])
    # 400 windows: the mean is known to 0.05, the standard deviation to 0.035.
    assert abs(z.mean()) < 0.2
    assert z.std() == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize('late_s', [0.05, 0.2])
def test_the_rate_of_the_traction_is_the_error_per_second_of_delay(late_s: float) -> None:
    """With a force delayed by d the observed resistance changes by d times the slope of the traction."""
    dt = 0.2
    t: NDArray[np.float64] = dt * np.arange(30, dtype=np.float64)

    def mean_force(at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean since the previous sample of a force that rises to 40 N/kN within a second."""
        middle = at - 0.5 * dt
        return 20.0 + 20.0 * np.tanh((middle - 3.0) / 0.5)

    v = 15.0 + np.cumsum(np.where(t > 0.0, (mean_force(t) - 2.0) * dt / INERTIA, 0.0))

    def result(known: NDArray[np.float64]) -> WindowResult:
        columns = zip(t.tolist(), v.tolist(), known.tolist(), strict=True)
        return observed([WindowSample(START + round(x * NS_PER_S), dt, s, u, u) for x, s, u in columns])

    exact, delayed = result(mean_force(t)), result(mean_force(t - late_s))
    # y = w - delta Dw: the reported force comes late, by delta.
    assert delayed.y - 2.0 == pytest.approx(-late_s * delayed.traction_rate, abs=0.03 * late_s * exact.traction_rate)
    assert exact.y == pytest.approx(2.0, abs=1e-9)


@pytest.mark.parametrize('seed', range(3))
def test_a_scale_error_of_the_traction_changes_y_by_its_weighted_mean(seed: int) -> None:
    """With 5 % too little reported force, y = w - kappa Tw holds exactly."""
    ticks = window(25, seed=seed)
    little = [
        replace(sample, known_force=sample.known_force / 1.05, traction=sample.traction / 1.05) for sample in ticks
    ]
    result = observed(little)
    assert result.y == pytest.approx(2.0 - 0.05 * result.traction, abs=1e-9)
    assert result.traction_size == pytest.approx(np.mean([abs(sample.traction) for sample in little[1:]]))


def test_a_curve_resistance_error_changes_y_by_the_weighted_curvature() -> None:
    """Resistance 2 + 0.3 per unit of curvature, of which 0.1 is known; curvature is the mean of each interval."""
    rng = np.random.default_rng(3)
    curve = np.clip(rng.normal(0.0, 1.0, 30).cumsum(), 0.0, 5.0)
    v = 15.0 - np.append(0.0, np.cumsum(0.2 * (2.0 + 0.3 * curve[1:]) / INERTIA))
    ticks = [
        WindowSample(START + k * NS_PER_S // 5, 0.2, float(v[k]), -0.1 * float(x), 0.0, curve=float(x))
        for k, x in enumerate(curve)
    ]
    result = observed(ticks)
    assert result.y == pytest.approx(2.0 + 0.2 * result.curve, abs=1e-9)


@pytest.mark.parametrize(('size', 'hop'), [(25, 12), (25, 5), (11, 3), (25, 25)])
def test_overlap_factor_by_monte_carlo(size: int, hop: int) -> None:
    """Variance of the mean of many slopes, relative to that of independent slopes."""
    rng = np.random.default_rng(4)
    n, repeats = 60, 3000
    noise = rng.standard_normal((repeats, (n - 1) * hop + size))
    c = np.arange(size) - 0.5 * (size - 1)
    slopes = np.stack([noise[:, k * hop : k * hop + size] @ c / (c @ c) for k in range(n)], axis=1)
    measured = n * slopes.mean(axis=1).var() * (c @ c)
    # 3000 repeats determine a variance to 2.6 %; the ends of 60 slopes lack some neighbours, an effect of order 1/n.
    ends = 2.0 * sum(k * (c[: -k * hop] @ c[k * hop :]) for k in range(1, -(-size // hop))) / (n * (c @ c))
    assert measured + ends == pytest.approx(overlap_factor(size, hop), rel=0.1)
    assert overlap_factor(25, 25) == 1.0


def cuts(dts: list[float]) -> list[tuple[int, Cut]]:
    window, found, stamp = SlidingWindow(4.8, 1.2), [], 1_700_000_000 * NS_PER_S
    for i, dt in enumerate(dts):
        stamp += round(dt * NS_PER_S)
        cut = window.push(WindowSample(stamp, dt, 10.0, 0.0, 0.0))
        if cut is not None:
            found.append((i, cut))
    return found


@pytest.mark.parametrize(
    ('period', 'samples', 'hop'), [(0.1, 49, 12), (0.2, 25, 6), (0.25, 20, 5), (0.5, 11, 2), (1.0, 8, 2), (2.0, 8, 2)]
)
def test_windows_at_all_rates(period: float, samples: int, hop: int) -> None:
    found = cuts([period] * 200)
    assert found[0][0] == samples - 1
    assert {len(cut.samples) for _, cut in found} == {samples}
    assert set(np.diff([i for i, _ in found]).tolist()) == {hop}
    assert found[-1][1].hop_samples == hop


def test_jitter_changes_no_window() -> None:
    rng = np.random.default_rng(2)
    stamps = 0.2 * np.arange(500) + rng.uniform(-0.02, 0.02, 500)
    found = cuts([0.2, *np.diff(stamps).tolist()])
    assert {len(cut.samples) for _, cut in found} == {25}
    assert np.diff([i for i, _ in found]).mean() == pytest.approx(6.0, abs=0.05)


def test_missing_samples_do_not_change_the_duration() -> None:
    found = cuts([0.2, 0.2, 0.4] * 60)
    for _, cut in found:
        duration = (cut.samples[-1].stamp_ns - cut.samples[0].stamp_ns) / NS_PER_S
        assert duration == pytest.approx(4.8, abs=0.25)


def test_after_clearing_a_new_window_begins() -> None:
    window = SlidingWindow(4.8, 1.2)
    for i in range(24):
        assert window.push(WindowSample(i * NS_PER_S // 5, 0.2, 10.0, 0.0, 0.0)) is None
    window.clear()
    assert window.push(WindowSample(24 * NS_PER_S // 5, 0.2, 10.0, 0.0, 0.0)) is None
    assert (len(window.samples), window.fresh_s) == (1, 0.2)


@pytest.mark.parametrize(('rho', 'expected'), [(0.0, 1.0), (0.6, 4.0), (-0.5, 1.0 / 3.0)])
def test_the_factor_is_long_run_over_marginal_variance(rho: float, expected: float) -> None:
    """AR(1): (1 + rho) / (1 - rho). A batch of 20 contains most of it, and large sums are capped."""
    rng = np.random.default_rng(22)
    slow, x, found = SlowNoise(), 0.0, []
    for _ in range(40_000):
        x = rho * x + math.sqrt(1.0 - rho * rho) * float(rng.standard_normal())
        slow.add(0.3 * x, 0.0, 0.09 * slow.factor, (0.1, 10.0))
        found.append(slow.factor)
    assert float(np.mean(found[2000:])) == pytest.approx(expected, rel=0.25)


def test_one_batch_of_a_step_does_not_count_as_noise() -> None:
    slow = SlowNoise()
    for _ in range(20):
        slow.add(50.0, 0.0, 1.0, (0.1, 10.0))
    assert slow.factor <= 1.5
