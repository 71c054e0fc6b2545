# SPDX-License-Identifier: Apache-2.0
"""V-MILS on simulated journeys: resistance, jumps, bad samples; wrong mass, late force, wrong curves; coverage."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from test.estimators.makers import stepped
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.resistance.change_points import gate
from trainid_ros.resistance.vmils import VMils
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
TRUTH = Davis(1.8, 0.02, 0.005)
CONFIG = VMilsConfig()


def saw_tooth(t: float) -> float:
    """Power for 40 s, coast for 100 s [N/kN]: uphill the speed stays between 7 and 18 m/s."""
    return 30.0 if t % 140.0 < 40.0 else 0.0


def after(train_file: TrainFile, samples: list[Sample], config: VMilsConfig = CONFIG) -> VMils:
    return stepped(VMils(train_file, config), samples)


def w(davis: Davis, v: float) -> float:
    return davis.a + davis.b * v + davis.c * v * v


def test_standing_and_braking_do_not_change_the_parameters(train_file: TrainFile, journey: Journey) -> None:
    """Ten minutes of stops: between the start of braking and the next departure only kappa may step."""
    samples = journey(
        600.0,
        traction=lambda t: 40.0 if t % 150.0 < 35.0 else 0.0,
        brake=lambda t: -0.7 if t % 150.0 > 90.0 else 0.0,
        speed=0.0,
    )
    estimator = VMils(train_file, CONFIG)
    learned = 0
    for item in samples:
        before, observations = estimator.learner.tracker.estimate, estimator.learner.driven.count
        estimator.step(item)
        if item.brake_command < 0.0 or item.speed < CONFIG.min_speed:
            now = estimator.learner.tracker.estimate
            std = np.sqrt(np.diag(before.P))
            assert np.max(np.abs(now.theta - before.theta) / std) < 1e-6
            assert np.max(np.abs((now.P - before.P)[:3] / np.outer(std, std)[:3])) < 1e-6
            assert estimator.learner.driven.count == observations
        learned += estimator.learner.driven.count != observations
    assert learned > 20


def test_it_estimates_the_resistance_over_the_observed_speeds(train_file: TrainFile, journey: Journey) -> None:
    estimator = after(train_file, journey(840.0, traction=saw_tooth, speed=8.0))
    found = estimator.estimate(12.0)
    assert estimator.converged
    assert found.speed_max - found.speed_min > 4.0
    for v in np.linspace(found.speed_min, found.speed_max, 5).tolist():
        here = estimator.estimate(v)
        # 180 unbiased observations of about 0.1 N/kN: 0.03 N/kN, and within the stated standard deviation.
        assert here.resistance == pytest.approx(w(TRUTH, v), abs=max(0.05, 3.0 * here.resistance_std))
        # The rest is for a step that does not show yet.
        assert here.resistance_std < 0.15


def test_the_test_ratio_is_relative_to_the_gate(train_file: TrainFile, journey: Journey) -> None:
    e = after(train_file, journey(120.0, traction=saw_tooth)).estimate(13.0)
    assert e.test_ratio == pytest.approx(
        e.innovation**2 / (gate(CONFIG.outlier_share) ** 2 * e.innovation_variance), rel=1e-12
    )


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('step', [5.0, -1.2])
def test_it_recovers_after_a_jump_of_the_resistance(
    train_file: TrainFile, journey: Journey, step: float, seed: int
) -> None:
    """A hard gate alone would never recover: +5 N/kN is far beyond it."""
    jump_s = 420.0
    samples = journey(
        840.0,
        speed=10.0,
        traction=lambda t: saw_tooth(t) + (max(0.0, step) if t > jump_s else 0.0),
        resistance=lambda t: replace(TRUTH, a=TRUTH.a + (step if t > jump_s else 0.0)),
        seed=seed,
    )
    estimator = stepped(VMils(train_file, CONFIG), samples[: round(5 * (jump_s + 120.0))])
    truth = replace(TRUTH, a=TRUTH.a + step)
    # Two minutes later most of the step is followed, a few minutes later all of it.
    assert abs(estimator.estimate(14.0).resistance - w(truth, 14.0)) < 0.35 * abs(step)
    stepped(estimator, samples[round(5 * (jump_s + 120.0)) :])
    assert estimator.estimate(14.0).resistance == pytest.approx(w(truth, 14.0), abs=0.25)
    assert estimator.learner.tracker.steps_found >= 1


def test_the_band_covers_a_step_that_is_hidden_by_gusts(train_file: TrainFile, journey: Journey) -> None:
    """Wrong by three standard deviations for less than a fifth of five minutes; by the mixture alone for longer."""
    jump_s, step, shares = 900.0, 0.4, []
    for seed in range(4):
        rng, gust, gusts = np.random.default_rng(200 + seed), 0.0, []
        for _ in range(6001):
            gust = 0.97 * gust + 0.3 * math.sqrt(1.0 - 0.97**2) * float(rng.standard_normal())
            gusts.append(gust)

        def blown(t: float, gusts: list[float] = gusts) -> Davis:
            return replace(TRUTH, a=TRUTH.a + gusts[round(5.0 * t)] + (step if t > jump_s else 0.0))

        samples = journey(1200.0, speed=10.0, traction=saw_tooth, resistance=blown, seed=seed)
        estimator = stepped(VMils(train_file, CONFIG), samples[: round(5 * jump_s)])
        wrong = []
        for sample in samples[round(5 * jump_s) :]:
            stepped(estimator, [sample])
            found = estimator.estimate(14.0)
            wrong.append(abs(found.resistance - step - w(TRUTH, 14.0)) > 3.0 * found.resistance_std)
        shares.append(np.mean(wrong))
    assert max(shares) < 0.2


def test_without_a_jump_no_step_is_detected(train_file: TrainFile, journey: Journey) -> None:
    found = 0
    for seed in range(3):
        estimator = VMils(train_file, CONFIG)
        run = journey(560.0, traction=saw_tooth, speed=10.0, seed=seed, resistance=lambda _: Davis(1.5, 0.03, 0.004))
        stepped(estimator, run)
        found += estimator.learner.tracker.steps_found
    assert found <= 1


def test_windows_with_slip_are_rejected(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(400.0, traction=saw_tooth)
    slipping = [
        replace(item, speed=item.speed + 2.0) if i >= 1000 and i % 25 < 11 else item for i, item in enumerate(samples)
    ]
    estimator = VMils(train_file, CONFIG)
    reasons = [r.reason for r in map(estimator.step, slipping) if isinstance(r, Rejection)]
    assert reasons.count(Reason.SPEED_INCONSISTENT) + reasons.count(Reason.OUTLIER) > 20
    assert estimator.estimate(14.0).resistance == pytest.approx(w(TRUTH, 14.0), abs=0.4)


def test_accepted_samples_give_an_observation_every_hop(train_file: TrainFile, journey: Journey) -> None:
    estimator = VMils(train_file, CONFIG)
    results = [step_and_estimate(estimator, item) for item in journey(100.0, speed=20.0)]
    accepted = sum(isinstance(r, ResistanceEstimate) for r in results)
    # The first sample has no dt; the first window has 25, then one every 6.
    assert accepted == 499
    assert estimator.learner.driven.count == 1 + (499 - 25) // 6


def test_a_hop_longer_than_the_window_is_rejected(train_file: TrainFile) -> None:
    with pytest.raises(InputError, match=r'hop = 6 s must not exceed window = 4.8 s'):
        VMils(train_file, VMilsConfig(hop=6.0))


@pytest.mark.parametrize('v', [8.0, 12.0, 20.0])
def test_the_model_error_is_a_share_of_w_at_every_speed(train_file: TrainFile, journey: Journey, v: float) -> None:
    config = replace(CONFIG, drift_share=0.0, step_share=0.01, step_interval=1e7, model_error=0.2)
    estimator = after(train_file, journey(200.0, traction=saw_tooth), config)
    posterior, found, phi = estimator.learner.tracker.stated, estimator.estimate(v), np.array([1.0, v, v * v])
    variance = estimator.learner.inflation.factor * float(phi @ posterior.P[:3, :3] @ phi)
    assert found.resistance_std**2 - variance == pytest.approx((0.2 * found.resistance) ** 2, rel=1e-6)


def known_file(train_file: TrainFile) -> TrainFile:
    """Return a train file with standard deviations of mass and force of 0.2 and 0.3 %."""
    return replace(train_file, train=replace(train_file.train, mass_std=0.002, force_std=0.003))


def misreported(samples: list[Sample], *, scale: float = 1.0, late_s: float = 0.0) -> list[Sample]:
    """Report a force that is too small by a factor and late; the actual force is unchanged."""
    t = np.array([(item.stamp_ns - samples[0].stamp_ns) / NS_PER_S for item in samples])
    # Cumulative force, so that the mean over any interval is exact.
    dt = np.diff(t, prepend=t[0])
    pushed = np.cumsum(np.array([item.force_mean for item in samples]) * dt)
    late = np.interp(t - late_s, t, pushed)
    mean = np.divide(np.diff(late, prepend=0.0), dt, out=np.zeros_like(dt), where=dt > 0.0)
    pairs = zip(samples, (mean / scale).tolist(), strict=True)
    return [replace(item, force=force, force_mean=force) for item, force in pairs]


@pytest.mark.parametrize('scale', [0.95, 1.05])
def test_a_wrong_mass_gives_the_right_resistance_and_scale(
    train_file: TrainFile, journey: Journey, scale: float
) -> None:
    """A mass or gain error of 5 % is 1.5 N/kN under power; the prior std is 3.6 %, the estimate is within 1 %."""
    samples = misreported(journey(1400.0, traction=saw_tooth, speed=8.0), scale=scale)
    found = after(train_file, samples).estimate(13.0)
    assert found.resistance == pytest.approx(w(TRUTH, 13.0), abs=0.15)
    assert found.force_scale == pytest.approx(scale, abs=0.01)
    assert abs(found.force_scale - scale) < 3.0 * found.force_scale_std < 0.03
    narrow = after(known_file(train_file), samples).estimate(13.0)
    assert abs(narrow.resistance - w(TRUTH, 13.0)) > 2.0 * abs(found.resistance - w(TRUTH, 13.0))


@pytest.mark.parametrize('late_s', [0.0, 0.3])
def test_the_delay_of_the_force_is_estimated(train_file: TrainFile, journey: Journey, late_s: float) -> None:
    samples = misreported(journey(1400.0, traction=saw_tooth, speed=8.0), late_s=late_s)
    found = after(train_file, samples).estimate(13.0)
    assert found.force_delay == pytest.approx(late_s, abs=0.08)
    assert abs(found.force_delay - late_s) < 3.0 * found.force_delay_std
    assert found.resistance == pytest.approx(w(TRUTH, 13.0), abs=0.15)


def test_the_curve_resistance_is_estimated_too(train_file: TrainFile, journey: Journey) -> None:
    """A third of the time in a curve of 300 m with 1.6 N/kN more resistance than in the train file."""

    def curved(t: float) -> bool:
        return t % 90.0 > 60.0

    def resists(t: float) -> Davis:
        return replace(TRUTH, a=TRUTH.a + (1.6 if curved(t) else 0.0))

    samples = [
        replace(item, curve_radius=300.0 if curved(0.2 * i) else 0.0)
        for i, item in enumerate(journey(1400.0, traction=saw_tooth, speed=8.0, resistance=resists))
    ]
    estimator = after(train_file, samples)
    assert estimator.learner.tracker.estimate.theta[5] == pytest.approx(0.8, abs=0.15)
    assert estimator.estimate(13.0).resistance == pytest.approx(w(TRUTH, 13.0), abs=0.15)


def test_the_force_scale_changes_only_at_stops(train_file: TrainFile, sample: Make) -> None:
    """Weighed or not, the variance of kappa grows by one step at each departure, up to the prior and one step."""

    def variance(mass: float, stops: int, file: TrainFile) -> float:
        estimator, i = VMils(file, CONFIG), 0
        for _ in range(stops):
            for speed in (5.0, 0.0, 0.0, 0.05, 0.0, 0.4, 5.0):
                estimator.step(sample(i, speed=speed, mass=mass))
                i += 1
        return float(estimator.learner.tracker.estimate.P[3, 3])

    prior, known = 0.03**2 + 0.02**2, known_file(train_file)
    assert variance(math.nan, 0, train_file) == pytest.approx(prior)
    assert variance(2e5, 1, train_file) == pytest.approx(prior + 0.004**2)
    assert variance(math.nan, 1, train_file) == pytest.approx(prior + 0.03**2)
    assert variance(math.nan, 5, train_file) == pytest.approx(prior + 0.03**2)
    assert variance(2e5, 9, known) == pytest.approx(0.002**2 + 0.003**2 + 0.001**2)


def test_with_a_known_force_the_force_error_states_do_not_reduce_accuracy(
    train_file: TrainFile, journey: Journey
) -> None:
    """With a narrow prior the error is that without the force error states, over five drives."""
    errors = []
    for seed in range(5):
        samples = journey(700.0, traction=saw_tooth, speed=8.0, seed=20 + seed)
        exact = replace(train_file, train=replace(train_file.train, mass_std=0.0, force_std=0.0))
        errors.append(
            [
                abs(after(file, samples).estimate(13.0).resistance - w(TRUTH, 13.0))
                for file in (known_file(train_file), exact)
            ]
        )
    narrow, none = np.mean(errors, axis=0).tolist()
    assert narrow < none + 0.02


@pytest.mark.slow
def test_the_95_per_cent_band_covers_the_truth_over_new_drives(train_file: TrainFile, journey: Journey) -> None:
    """Twelve drives with different scale, delay, gusts and noise: 95 % bands of w at three speeds.

    The three speeds of a drive are correlated, so there are 12 to 20 independent trials: a consistent band covers
    fewer than 80 % in about one of 50 runs.
    """
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        gust, gusts = 0.0, []
        for _ in range(3600):
            gust = 0.97 * gust + 0.3 * math.sqrt(1.0 - 0.97**2) * float(rng.standard_normal())
            gusts.append(gust)

        def blown(t: float, gusts: list[float] = gusts) -> Davis:
            return replace(TRUTH, a=TRUTH.a + gusts[round(5.0 * t)])

        samples = misreported(
            journey(720.0, traction=saw_tooth, speed=8.0, seed=seed, resistance=blown),
            scale=1.0 + 0.036 * float(rng.standard_normal()),
            late_s=float(rng.uniform(0.0, 0.3)),
        )
        estimator = after(train_file, samples)
        for v in (9.0, 12.0, 15.0):
            found = estimator.estimate(v)
            inside.append(abs(found.resistance - w(TRUTH, v)) <= 1.96 * found.resistance_std)
    assert np.mean(inside) >= 0.8


def test_one_sample_per_second_is_sufficient(train_file: TrainFile, journey: Journey) -> None:
    """Windows of 8 s: half as many observations, each as accurate."""
    samples = journey(1400.0, traction=saw_tooth, speed=8.0)
    slow = []
    for k in range(5, len(samples), 5):
        together = samples[k - 4 : k + 1]
        mean = sum(item.force_mean for item in together) / 5.0
        slow.append(replace(samples[k], dt=math.nan if k == 5 else 1.0, force_mean=mean))
    estimator = after(train_file, slow)
    found = estimator.estimate(13.0)
    assert 500 < estimator.learner.driven.count < 750
    assert found.resistance == pytest.approx(w(TRUTH, 13.0), abs=max(0.15, 3.0 * found.resistance_std))
    assert found.resistance_std < 0.2
