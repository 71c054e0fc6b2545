# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS against a literal reading of (7) in its computable order, and against real life."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Reason, Refusal, SpeedModelEstimate
from trainid_ros.core.samples import Sample
from trainid_ros.estimators.speed_model.am_vff_rls import AmVffRls, AmVffRlsConfig, to_physical, to_speed_model
from trainid_ros.physics.train_file import Davis, TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
Array = NDArray[np.float64]
CONFIG = AmVffRlsConfig()
T = 0.2


def saw_tooth(t: float) -> float:
    return 30.0 if t % 140.0 < 40.0 else 0.0


def to_stops(t: float) -> float:
    return 40.0 if t % 150.0 < 35.0 else 0.0


def braked_to_stops(t: float) -> float:
    return -0.7 if t % 150.0 > 90.0 else 0.0


def literal(
    y: list[float], u: list[float], theta: Array, P: Array, *, sigma: float, low: float
) -> tuple[Array, Array, list[float]]:
    """Algorithm (7) of Yuan et al. with the error of theta(n-1), the auxiliary output of theta(n), lambda clamped.

    Nothing is forgotten while P is wider than P(0) in the mean over its directions.
    """
    x, factors, doubt = y[0], [], np.linalg.inv(P)
    for n in range(1, len(y)):
        phi = np.array([[x * x], [x], [u[n]], [1.0]])
        eps = y[n] - (phi.T @ theta)[0, 0]
        g = (phi.T @ P @ phi)[0, 0]
        lam = 1.0 if np.trace(doubt @ P) > 4.0 else max(low, 1.0 - eps**2 / (sigma * (1.0 + g)))
        K = P @ phi / (g + lam)
        theta = theta + K * eps
        P = (np.eye(4) - K @ phi.T) @ P / lam
        x = (phi.T @ theta)[0, 0]
        factors.append(lam)
    return theta, P, factors


def test_without_kappa_at_the_nominal_step_it_is_the_algorithm_of_the_paper(
    train_file: TrainFile, journey: Journey
) -> None:
    config = replace(CONFIG, kappa=0.0, gate_floor=10.0, min_forgetting=0.97)
    estimator = AmVffRls(train_file, config)
    theta0 = np.array(estimator.state.theta).reshape(4, 1)
    P0 = np.array(estimator.state.P).reshape(4, 4)
    samples = journey(60.0, traction=lambda t: 60.0 if t % 10.0 < 5.0 else 0.0, speed=8.0, noise=0.04)
    results = [estimator.step(item) for item in samples]
    assert all(isinstance(r, SpeedModelEstimate) for r in results[1:])
    y = [item.speed for item in samples]
    u = [1000.0 * item.force_mean / (200e3 * 9.80665) - 6.0 for item in samples]
    sigma = config.forgetting_scale * config.speed_std**2
    theta, P, factors = literal(y, u, theta0, P0, sigma=sigma, low=config.min_forgetting)
    assert min(factors) < 0.99
    assert sum(factor < 1.0 for factor in factors) > 20
    found_P = np.array(estimator.state.P).reshape(4, 4)
    std = np.sqrt(np.diag(P))
    assert np.array(estimator.state.theta) == pytest.approx(theta.ravel(), abs=1e-7 * float(std.min()))
    assert np.max(np.abs(found_P - P) / np.outer(std, std)) < 1e-6
    found = [r.forgetting_factor for r in results[1:] if isinstance(r, SpeedModelEstimate)]
    assert found == pytest.approx(factors, abs=1e-9)


def test_the_map_is_forward_euler_and_goes_back() -> None:
    davis, c = (1.7, 0.02, 0.0086), 9.80665 / 1080.0
    theta = to_speed_model(davis, c)
    x, u = 14.0, 25.0
    stepped = x + T * c * (u - (1.7 + 0.02 * x + 0.0086 * x * x))
    assert theta[0] * x * x + theta[1] * x + theta[2] * u + theta[3] == pytest.approx(stepped, rel=1e-15)
    # 1 - a2 loses digits: a2 is 1 - 4e-5.
    assert to_physical(theta) == pytest.approx((*davis, c), rel=1e-10)


def test_the_prior_means_what_the_settings_say(train_file: TrainFile) -> None:
    """P(0) is the prior of the physical parameters through the map: by Monte Carlo."""
    estimator = AmVffRls(train_file, CONFIG)
    rng = np.random.default_rng(3)
    n = 100_000
    shares = (CONFIG.prior_std_a, CONFIG.prior_std_b, CONFIG.prior_std_c)
    davis = (1.5, 0.03, 0.004)
    # A tenth of the deviations, where the map is linear enough; the covariance is scaled back.
    draws = [
        v + 0.1 * math.hypot(CONFIG.prior_share * v, s) * rng.standard_normal(n)
        for v, s in zip(davis, shares, strict=True)
    ]
    c = 9.80665 / 1080.0 * (1.0 + 0.1 * CONFIG.prior_std_mass * rng.standard_normal(n))
    thetas = np.stack([-T * c * draws[2], 1.0 - T * c * draws[1], T * c, -T * c * draws[0]])
    found = np.array(estimator.estimate(0.0).covariance).reshape(4, 4)
    std = np.sqrt(np.diag(found))
    assert np.cov(thetas) * 100.0 / np.outer(std, std) == pytest.approx(found / np.outer(std, std), abs=0.02)


def test_the_estimate_starts_at_the_train_file(train_file: TrainFile) -> None:
    e = AmVffRls(train_file, CONFIG).estimate(0.0)
    # (M / M_nominal) (1 + gamma) with the believed mass.
    assert (e.a, e.b, e.c, e.mass_factor) == pytest.approx((1.5, 0.03, 0.004, 1.08), rel=1e-9)


def test_forgetting_stays_between_the_clamp_and_one(train_file: TrainFile, journey: Journey) -> None:
    for noise in (0.02, 0.15):
        estimator = AmVffRls(train_file, CONFIG)
        for item in journey(200.0, traction=saw_tooth, noise=noise):
            estimator.step(item)
            assert CONFIG.min_forgetting <= estimator.state.forgetting <= 1.0


def test_standing_and_braking_leave_the_parameters_to_the_bit(train_file: TrainFile, journey: Journey) -> None:
    estimator, learned = AmVffRls(train_file, CONFIG), 0
    for item in journey(600.0, traction=to_stops, brake=braked_to_stops, speed=0.0):
        before = estimator.state
        estimator.step(item)
        after = estimator.state
        if item.brake_command < 0.0 or item.speed < CONFIG.min_speed:
            assert (after.theta, after.P, after.forgetting) == (before.theta, before.P, before.forgetting)
        learned += after.theta != before.theta
    assert learned > 1000


def test_after_a_stop_the_auxiliary_output_starts_from_the_measurement(train_file: TrainFile, sample: Make) -> None:
    estimator = AmVffRls(train_file, CONFIG)
    for i in range(20):
        estimator.step(sample(i))
    result = estimator.step(sample(20, brake_command=-0.5, speed=9.0))
    assert isinstance(result, Refusal)
    assert result.reason is Reason.BRAKING
    assert estimator.state.x_a == 9.0


def test_it_finds_resistance_and_mass(train_file: TrainFile, journey: Journey) -> None:
    """The reported force is 3 % high: only M (1 + gamma) can tell."""
    found = []
    for seed in range(3):
        estimator = AmVffRls(train_file, CONFIG)
        for item in journey(560.0, traction=saw_tooth, speed=8.0, seed=seed):
            force = 1.03 * item.force_mean
            estimator.step(replace(item, force_mean=force, force=force))
        e = estimator.estimate(0.0)
        w12 = e.a + 12.0 * e.b + 144.0 * e.c
        found.append((e.mass_factor, w12))
    mass_factor, w12 = np.mean(found, axis=0)
    assert mass_factor == pytest.approx(1.03 * 1.08, rel=0.02)
    # True: 1.8 + 0.24 + 0.72 plus the gradient's 6, all times 1.03, less the gradient that is known.
    assert w12 == pytest.approx(1.03 * 8.76 - 6.0, abs=0.35)


def test_no_line_is_lost_with_missing_samples_and_outliers(train_file: TrainFile, journey: Journey) -> None:
    """10 % of the samples missing, 5 % outliers of some m/s: the speed predicted is still right."""
    worst = 0.0
    for seed in range(8):
        rng = np.random.default_rng([seed, 1])
        estimator, errors, dt = AmVffRls(train_file, CONFIG), [], math.nan
        clean = journey(210.0, traction=saw_tooth, speed=8.0, noise=0.0)
        noisy = journey(210.0, traction=saw_tooth, speed=8.0, seed=seed)
        force = 0.0
        for true, item in zip(clean, noisy, strict=True):
            step = item.dt if math.isnan(item.dt) else (0.0 if math.isnan(dt) else dt) + item.dt
            force = force + item.force_mean * (0.0 if math.isnan(item.dt) else item.dt)
            dt = 0.0 if math.isnan(step) else step
            if rng.random() < 0.1 and not math.isnan(step):
                continue
            speed = item.speed + (float(rng.uniform(-5.0, 5.0)) if rng.random() < 0.05 else 0.0)
            mean = force / step if step > 0.0 else item.force_mean
            estimator.step(replace(item, speed=max(0.0, speed), dt=step, force_mean=mean))
            dt = force = 0.0
            errors.append(estimator.state.x_a - true.speed)
            assert all(map(math.isfinite, estimator.state.theta))
            assert estimator.state.theta[2] > 0.0
        rms = float(np.sqrt(np.mean(np.square(errors[250:]))))
        worst = max(worst, rms)
    # A lost line shows up as metres per second. Outliers under the gate's floor and re-anchoring cost some.
    assert worst < 0.3


def test_outliers_are_refused_and_several_in_a_row_are_believed(train_file: TrainFile, sample: Make) -> None:
    estimator = AmVffRls(train_file, CONFIG)
    for i in range(50):
        estimator.step(sample(i, gradient_mean=-2.85))
    before = estimator.state.theta
    for i in range(50, 50 + CONFIG.readmit_after):
        result = estimator.step(sample(i, speed=18.0))
        assert isinstance(result, Refusal)
        assert result.reason is Reason.OUTLIER
        assert result.value == pytest.approx(3.0, abs=0.2)
    assert estimator.state.theta == before
    assert estimator.state.x_a == 18.0
    assert isinstance(estimator.step(sample(60, speed=18.0)), SpeedModelEstimate)


def test_a_step_of_two_periods_counts_as_two_steps(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(400.0, traction=saw_tooth, speed=8.0, noise=0.0, resistance=lambda _: Davis(1.5, 0.03, 0.004))
    whole, halved = AmVffRls(train_file, CONFIG), AmVffRls(train_file, CONFIG)
    for k, item in enumerate(samples):
        whole.step(item)
        if k % 2 == 0:
            mean = 0.5 * (item.force_mean + samples[k - 1].force_mean) if k else item.force_mean
            halved.step(replace(item, dt=2.0 * item.dt, force_mean=mean))
    # Without noise and from the right prior both stay where they are.
    assert whole.state.theta == pytest.approx(halved.state.theta, rel=1e-3, abs=1e-6)
    assert halved.estimate(0.0).mass_factor == pytest.approx(1.08, rel=2e-3)


def test_long_holding_of_one_speed_does_not_wind_up(train_file: TrainFile, sample: Make) -> None:
    estimator = AmVffRls(train_file, CONFIG)
    first = float(np.trace(np.array(estimator.state.P).reshape(4, 4)))
    rng = np.random.default_rng(1)
    for i in range(6_000):
        estimator.step(sample(i, gradient_mean=-2.85, speed=15.0 + 0.1 * float(rng.standard_normal())))
    # At most as wide as the prior but for one step of forgetting.
    ratio = np.trace(np.array(estimator.state.P).reshape(4, 4)) / first
    assert ratio < 4.0 / CONFIG.min_forgetting


@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(st.integers(0, 2**32 - 1))
def test_no_input_makes_it_lose_itself(train_file: TrainFile, sample: Make, seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimator, stamp = AmVffRls(train_file, CONFIG), 1_700_000_000 * NS_PER_S

    def wild(value: float, spread: float, low: float, high: float, share: float = 0.1) -> float:
        if rng.random() < share:
            return float(rng.choice([math.nan, low, high, rng.uniform(low, high)]))
        return float(np.clip(value + spread * rng.standard_normal(), low, high))

    for i in range(int(rng.integers(50, 400))):
        dt = float(rng.choice([0.02, 0.2, 0.2, 0.5, 1.0]))
        stamp += round(dt * NS_PER_S)
        speed = wild(12.0, 1.0, 0.0, 200.0)
        fields: dict[str, Any] = {
            'stamp_ns': stamp,
            'dt': math.nan if rng.random() < 0.03 else dt,
            'speed': 0.0 if math.isnan(speed) else speed,
            'force': wild(0.0, 1e5, -1e8, 1e8),
            'force_mean': wild(1e5, 1e5, -1e8, 1e8),
            'gradient_mean': wild(0.0, 10.0, -200.0, 200.0),
            'mass': wild(2e5, 1e4, 100.0, 1e9),
            'brake_command': float(rng.choice([0.0, 0.0, 0.0, 0.0, -1.0, math.nan])) if rng.random() < 0.1 else 0.0,
        }
        estimator.step(sample(i, **fields))
        e = estimator.estimate(12.0)
        values = [getattr(e, name) for name in e.__dataclass_fields__ if name != 'covariance']
        assert all(map(math.isfinite, [*values, *e.covariance])), i
        P = np.array(e.covariance).reshape(4, 4)
        std = np.sqrt(np.diag(P))
        assert np.all(std > 0.0), i
        assert np.max(np.abs(P - P.T) / np.outer(std, std)) < 1e-9
        # Rounding of the printed form of P, relative to its own size.
        assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > -1e-6, i


def test_saved_and_restored_in_the_middle_it_goes_on_to_the_bit(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(200.0, traction=to_stops, brake=braked_to_stops, speed=3.0)
    for middle in (333, 500, 700):
        whole, first, second = (AmVffRls(train_file, CONFIG) for _ in range(3))
        for item in samples[:middle]:
            whole.step(item)
            first.step(item)
        second.restore(first.save())
        for item in samples[middle:]:
            assert repr(second.step(item)) == repr(whole.step(item))
        assert second.save() == whole.save()


def test_reset_equals_new(train_file: TrainFile, journey: Journey) -> None:
    used, new = AmVffRls(train_file, CONFIG), AmVffRls(train_file, CONFIG)
    samples = journey(100.0, traction=to_stops, brake=braked_to_stops)
    for item in samples:
        used.step(item)
    used.reset()
    assert used.save() == new.save()
    assert [repr(used.step(item)) for item in samples] == [repr(new.step(item)) for item in samples]


@pytest.mark.parametrize(('key', 'value'), [('theta', [1.0]), ('P', [1.0]), ('used', 'many'), ('x_a', None)])
def test_a_saved_state_that_does_not_fit_is_refused(train_file: TrainFile, key: str, value: object) -> None:
    estimator = AmVffRls(train_file, CONFIG)
    data = json.loads(estimator.save())
    data['state'][key] = value
    with pytest.raises(InputError):
        estimator.restore(json.dumps(data))


def test_it_is_fit_to_use_after_enough_samples(train_file: TrainFile, sample: Make) -> None:
    estimator = AmVffRls(train_file, CONFIG)
    for i in range(CONFIG.settle_samples):
        estimator.step(sample(i))
    assert not estimator.converged
    estimator.step(sample(CONFIG.settle_samples))
    assert estimator.converged
