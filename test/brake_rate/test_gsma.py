# SPDX-License-Identifier: Apache-2.0
"""GSMA against the exact Kalman filter; the rate is found, and kept while no brake acts; outliers; states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from test.estimators.makers import stepped
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Davis, TrainFile

Journey = Callable[..., list[Sample]]
CONFIG = GsmaConfig()
STATED = Davis(1.5, 0.03, 0.004)
TAU, LAG, DT, GRADIENT = 0.4, 3, 0.2, 6.0
INERTIA = 1000.0 * 1.08 / 9.80665


def exactly_known(train_file: TrainFile) -> TrainFile:
    train, line = replace(train_file.train, mass_std=0.0, force_std=0.0), replace(train_file.line, gradient_std=0.0)
    return replace(train_file, train=train, line=line, brake=replace(train_file.brake, timing_std=0.0))


def gsma(train_file: TrainFile, config: GsmaConfig = CONFIG, seed: int = 1) -> Gsma:
    return Gsma(train_file, config, np.random.default_rng(seed))


def braking(t: float) -> float:
    """Return the levels of one long braking from 4 s on; the gradient assists it."""
    return 0.0 if t < 4.0 else -(0.35 + 0.15 * math.sin(0.4 * (0.2 * round(5 * t))))


def stop_and_go(t: float) -> float:
    return -0.6 if 35.0 < t % 80.0 < 72.0 else 0.0


def power(t: float) -> float:
    return 60.0 if t % 80.0 < 30.0 else 0.0


class Kalman:
    """The exact filter for one uninterrupted braking of a train without traction, implemented independently."""

    def __init__(self, first: Sample, config: GsmaConfig, disturbance: float) -> None:
        self.config = config
        self.r = config.speed_std**2
        self.x = np.array([first.speed, 0.0, 0.0, 1.0])
        self.P = np.diag(np.square([config.speed_std, 0.05, disturbance, config.prior_std]))
        self.target = 0.0
        self.waited = 0.0

    def step(self, sample: Sample, delayed: float, r: float, disturbance: float) -> None:
        config, decay, v = self.config, math.exp(-DT / TAU), sample.speed
        gain_a = delayed * (1.0 - decay)
        gain_v = delayed * (DT - TAU * (1.0 - decay))
        rho = math.exp(-v * DT / config.disturbance_length)
        reach = TAU * (1.0 - decay)
        F = np.array([[1.0, reach, DT, gain_v], [0.0, decay, 0.0, gain_a], [0.0, 0.0, rho, 0.0], [0.0, 0.0, 0.0, 1.0]])
        w = STATED.a + STATED.b * v + STATED.c * v * v
        known = -(GRADIENT + w) / INERTIA
        before, self.target = self.target, decay * self.target + gain_a
        walk = config.drift**2 * DT
        observable = max(abs(before), abs(self.target)) >= config.min_braking
        # f always drifts, but without a brake it has no effect and is not observable.
        self.P[3, 3] += walk
        self.x = F @ self.x + np.array([known * DT, 0.0, 0.0, 0.0])
        Q = np.diag([config.acceleration_noise**2 * DT, 0.0, disturbance**2 * (1.0 - rho * rho), 0.0])
        self.P = F @ self.P @ F.T + Q
        K = self.P[:, 0] / (self.P[0, 0] + r)
        if not observable:
            K = K * [1.0, 1.0, 1.0, 0.0]
        A = np.eye(4)
        A[:, 0] -= K
        self.x = self.x + K * (v - self.x[0])
        self.P = A @ self.P @ A.T + r * np.outer(K, K)


def compare(train_file: TrainFile, journey: Journey, config: GsmaConfig, seed: int) -> tuple[float, float]:
    """Return rms difference of the means in KF standard deviations, and mean ratio of the standard deviations."""
    rng = np.random.default_rng([seed, 7])
    start = 0.15 * float(np.clip(rng.standard_normal(), -2.0, 2.0))
    walk = 1.0 + start + config.drift * math.sqrt(DT) * np.cumsum(rng.standard_normal(251))
    samples = journey(
        46.0,
        brake=braking,
        rate=lambda t: float(walk[round(5 * t)]),
        resistance=lambda _: STATED,
        speed=25.0,
        seed=seed,
    )
    particles = gsma(exactly_known(train_file), config, seed)
    exact = Kalman(samples[0], config, math.sqrt(particles.state.disturbance.variance))
    particles.step(samples[0])
    differences, ratios = [], []
    for k, item in enumerate(samples[1:], start=1):
        if item.speed < 1.0:
            break
        disturbance, excess = math.sqrt(particles.state.disturbance.variance), particles.state.excess
        particles.step(item)
        delayed = samples[k - 1 - LAG].brake_command if k > LAG else 0.0
        exact.step(item, delayed, particles.state.noise.variance * excess, disturbance)
        if particles.state.observable:
            e, std = particles.estimate(0.0), math.sqrt(exact.P[3, 3])
            differences.append((e.brake_rate - exact.x[3]) / std)
            ratios.append(e.brake_rate_std / std)
    assert len(differences) > 100
    return float(np.sqrt(np.mean(np.square(differences)))), float(np.mean(ratios))


# Settings for a train file without errors.
NO_ERRORS: dict[str, Any] = dict.fromkeys(('resistance_std', 'slope_std', 'blend_std', 'level_std', 'scale_std'), 0.0)


@pytest.mark.parametrize(('drift', 'particles', 'most'), [(0.003, 50, 0.1), (0.003, 300, 0.03), (0.02, 300, 0.08)])
def test_it_equals_the_exact_kalman_filter_within_sampling_noise(
    train_file: TrainFile, journey: Journey, drift: float, particles: int, most: float
) -> None:
    """Differences in stds of the Kalman filter; the true f is a random walk that starts within two prior stds."""
    # Before any data, the prior mean of this disturbance is 0.006.
    config = GsmaConfig(
        particles=particles, drift=drift, jump_rate=0.0, gate=100.0, disturbance_std=0.0028, **NO_ERRORS
    )
    found = np.array([compare(train_file, journey, config, seed) for seed in range(5)])
    print(f'drift {drift}, {particles} particles: rms {found[:, 0]} KF std, std ratio {found[:, 1]}')
    assert np.sqrt(np.mean(np.square(found[:, 0]))) < most
    assert found[:, 1].mean() == pytest.approx(1.0, abs=0.05)


def test_a_group_spreads_like_the_random_walk(train_file: TrainFile, journey: Journey) -> None:
    """One step without information: the variance grows by q dt, h^2 / 3."""
    config = GsmaConfig(particles=400, prior_std=1e-4, drift=0.1, jump_rate=0.0, speed_std=2.0, gate=100.0, **NO_ERRORS)
    estimator, grown = gsma(exactly_known(train_file), config), []
    for item in journey(9.0, brake=braking, speed=25.0, noise=0.0, resistance=lambda _: STATED):
        before = estimator.estimate(0.0).brake_rate_std if estimator.state.unbraked_s == 0.0 else None
        estimator.step(item)
        if before is not None and estimator.state.observable:
            grown.append(estimator.estimate(0.0).brake_rate_std ** 2 - before**2)
    # With a speed noise of 2 m/s (0.6 m/s when estimated) the first second has almost no information.
    assert np.mean(grown[:6]) == pytest.approx(0.1**2 * DT, rel=0.1)


def test_without_braking_the_std_grows_with_the_drift_and_the_mean_is_constant(
    train_file: TrainFile, journey: Journey
) -> None:
    """Four minutes of coasting, power and standing after a braking: std follows sqrt(s^2 + q t) within 2 %."""
    config = GsmaConfig(drift=0.01)
    estimator = gsma(train_file, config)
    samples = journey(
        330.0,
        brake=lambda t: -0.6 if 5.0 <= t < 20.0 or 200.0 < t < 300.0 else 0.0,
        traction=lambda t: 40.0 if 40.0 < t < 80.0 else 5.0 if 20.0 < t < 200.0 else 0.0,
        speed=14.0,
        rate=lambda _: 0.9,
    )
    since = held = None
    for item in samples:
        estimator.step(item)
        t = (item.stamp_ns - samples[0].stamp_ns) / NS_PER_S
        e = estimator.estimate(0.0)
        standing = item.speed < config.min_speed
        if since is None and t > 24.0:
            since, held = t, e
            assert not e.observable
        elif since is not None and held is not None and (t < 200.0 or standing):
            law = math.hypot(held.brake_rate_std, config.drift * math.sqrt(t - since))
            if t < 200.0:
                assert e.brake_rate_std == pytest.approx(law, rel=0.02)
                assert e.brake_rate == held.brake_rate
    assert samples[-1].speed == 0.0


def test_standstill_and_traction_leave_the_rate_bit_identical(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file)
    seen = set()
    for item in journey(240.0, brake=stop_and_go, traction=power, speed=0.0, rate=lambda _: 0.85):
        before = estimator.posterior.rate, estimator.posterior.variance
        result = step_and_estimate(estimator, item)
        if isinstance(result, Rejection):
            seen.add(result.reason)
            assert (estimator.posterior.rate, estimator.posterior.variance) == before
            assert not estimator.estimate(0.0).observable
    assert {Reason.STANDSTILL, Reason.NOT_BRAKING, Reason.GAP} <= seen


@pytest.mark.parametrize('rate', [0.7, 0.85, 1.1])
def test_the_brake_rate_is_estimated_in_the_first_braking(train_file: TrainFile, journey: Journey, rate: float) -> None:
    errors = []
    for seed in range(5):
        estimator = stepped(
            gsma(train_file, seed=seed),
            journey(23.0, brake=lambda t: -0.7 if t > 4.0 else 0.0, speed=18.0, rate=lambda _: rate, seed=seed),
        )
        e = estimator.estimate(0.0)
        errors.append(e.brake_rate - rate)
        assert abs(e.brake_rate - rate) < 4.0 * e.brake_rate_std
    # The true resistance differs from the stated one by 0.4 N/kN, 0.0036 m/s^2: a bias of 0.005 in the rate.
    assert abs(float(np.mean(errors))) < 0.02
    assert float(np.max(np.abs(errors))) < 0.06


@pytest.mark.parametrize('rate', [0.55, 1.45])
def test_a_rate_three_standard_deviations_from_the_prior_is_found_in_one_braking(
    train_file: TrainFile, journey: Journey, rate: float
) -> None:
    """The exact filter is within 0.01; the estimate must not depend on the few particles in the tail of the prior."""
    for seed in range(3):
        estimator = gsma(train_file, seed=seed)
        samples = journey(30.0, brake=braking, speed=25.0, rate=lambda _: rate, seed=seed, resistance=lambda _: STATED)
        stepped(estimator, samples)
        e = estimator.estimate(0.0)
        assert e.brake_rate == pytest.approx(rate, abs=0.03)
        assert abs(e.brake_rate - rate) < 3.0 * e.brake_rate_std


def test_the_dead_time_uses_stamps(train_file: TrainFile, journey: Journey) -> None:
    """A shift of the command by 1 us changes the rate by 1e-6 s over the time braked, which is negligible."""

    def shifted(item: Sample, by_ns: int) -> Sample:
        changes = tuple(BrakeCommandChange(c.stamp_ns + by_ns, c.target_acceleration) for c in item.brake_changes)
        return replace(item, brake_changes=changes)

    samples = journey(25.0, brake=braking, speed=25.0, rate=lambda _: 0.9)
    plain, moved = gsma(train_file), gsma(train_file)
    for item in samples:
        plain.step(item)
        moved.step(shifted(item, -1000))
        assert moved.estimate(0.0).brake_rate == pytest.approx(plain.estimate(0.0).brake_rate, abs=1e-3)
    # A shift of one second has an effect, so the stamps are used.
    late = gsma(train_file)
    for item in samples:
        late.step(shifted(item, -NS_PER_S))
        if item.stamp_ns == samples[35].stamp_ns:
            break
    assert late.state.filtered_target < -0.05


def test_the_filtered_target_is_the_command_after_dead_time_and_lag(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file)
    samples = journey(20.0, brake=braking, speed=25.0)
    target = 0.0
    for k, item in enumerate(samples):
        estimator.step(item)
        delayed = samples[k - 1 - LAG].brake_command if k > LAG else 0.0
        target = delayed + (target - delayed) * math.exp(-DT / TAU) if k else 0.0
        assert estimator.state.filtered_target == pytest.approx(target, abs=1e-12)


def test_a_gap_of_the_speed_does_not_affect_the_brake_target(train_file: TrainFile, journey: Journey) -> None:
    """The brake is applied while the speed is missing; then the target equals that of a filter without the gap."""
    samples = journey(20.0, brake=braking, speed=25.0)
    missing = range(18, 32)
    first = samples[missing.stop]
    changes = tuple(c for k in (*missing, missing.stop) for c in samples[k].brake_changes)
    complete, gapped = gsma(train_file), gsma(train_file)
    for k, item in enumerate(samples):
        complete.step(item)
        if k not in missing:
            gapped.step(item if item is not first else replace(item, dt=math.nan, brake_changes=changes))
        if k == missing.stop:
            assert gapped.state.filtered_target == pytest.approx(complete.state.filtered_target, abs=1e-9)


def test_outliers_are_rejected_and_several_in_a_row_are_accepted(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file)
    samples = journey(30.0, brake=braking, speed=25.0)
    stepped(estimator, samples[:75])
    before = estimator.estimate(0.0).brake_rate
    for item in samples[75 : 75 + CONFIG.readmit_after]:
        result = step_and_estimate(estimator, replace(item, speed=item.speed + 3.0))
        assert isinstance(result, Rejection)
        assert result.reason is Reason.OUTLIER
        # Not used; only resampled, within a fraction of the standard deviation.
        assert estimator.estimate(0.0).brake_rate == pytest.approx(before, abs=0.005)
    assert estimator.estimate(0.0).speed == pytest.approx(samples[79].speed + 3.0, abs=1e-9)
    assert estimator.step(replace(samples[80], speed=samples[80].speed + 3.0)) is None


def test_the_particles_start_at_the_quantiles_of_the_prior(train_file: TrainFile) -> None:
    e = gsma(train_file).estimate(0.0)
    assert e.brake_rate == pytest.approx(1.0, abs=1e-12)
    # Quantiles omit the outermost tails.
    assert e.brake_rate_std == pytest.approx(CONFIG.prior_std, rel=0.02)
    assert e.effective_particles == pytest.approx(CONFIG.particles)
    assert math.isnan(e.position)


def test_the_position_follows_the_odometer_and_bridges_its_loss(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file)
    for k, item in enumerate(journey(60.0, speed=20.0)):
        position = math.nan if 100 <= k < 120 else item.position
        estimator.step(replace(item, position=position))
        if not 100 <= k < 120:
            assert estimator.estimate(0.0).position == pytest.approx(item.position, abs=0.5)


def test_the_convergence_flag_has_hysteresis(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file, GsmaConfig(drift=0.01))
    changes, stds = [], []
    was = False
    for item in journey(200.0, brake=lambda t: -0.6 if 4.0 < t < 16.0 else 0.0, traction=lambda _: 9.0, speed=15.0):
        estimator.step(item)
        if estimator.converged != was:
            was = estimator.converged
            changes.append(was)
            stds.append(estimator.estimate(0.0).brake_rate_std)
    assert changes == [True, False]
    assert stds[0] < CONFIG.valid_std
    assert stds[1] == pytest.approx(2.0 * CONFIG.valid_std, rel=0.01)


def test_the_same_seed_gives_identical_results_and_another_seed_different_ones(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(60.0, brake=stop_and_go, speed=20.0, rate=lambda _: 0.9)
    same, again, other = gsma(train_file, seed=5), gsma(train_file, seed=5), gsma(train_file, seed=6)
    for item in samples:
        same.step(item)
        again.step(item)
        other.step(item)
    assert same.save() == again.save()
    assert other.estimate(0.0) != same.estimate(0.0)
    # Another draw of the same posterior.
    assert other.estimate(0.0).brake_rate == pytest.approx(same.estimate(0.0).brake_rate, abs=0.02)


def test_a_state_saved_while_braking_and_restored_after_the_release_does_not_go_on_braking(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(120.0, brake=stop_and_go, traction=power, speed=10.0, rate=lambda _: 0.9)
    old, later = gsma(train_file), gsma(train_file)
    stepped(old, samples[:250])
    later.restore(old.save())
    assert later.state.commands.value(samples[249].stamp_ns) < 0.0
    released = [item for item in samples[410:] if item.brake_command == 0.0][:100]
    stated = (BrakeCommandChange(released[0].stamp_ns, 0.0),)  # by the stream, after a contradiction
    results = [later.step(replace(released[0], dt=math.nan, brake_gap=True, brake_changes=stated))]
    results += [later.step(item) for item in released[1:]]
    assert all(isinstance(result, Rejection) for result in results)
    assert later.state.commands.value(released[-1].stamp_ns) == 0.0
