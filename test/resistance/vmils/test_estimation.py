# SPDX-License-Identifier: Apache-2.0
"""V-MILS on simulated journeys: resistance, jumps, bad samples, saved states."""

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

from benchmarks.stepping import step_and_estimate
from test.resistance.vmils.drives import after, saw_tooth, w
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.interface.state import encode
from trainid_ros.resistance.normal import gate
from trainid_ros.resistance.vmils import VMils
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Davis, TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = VMilsConfig()
TRUTH = Davis(1.8, 0.02, 0.005)


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'dt': math.nan}, Reason.GAP),
        ({'force_mean': math.nan}, Reason.FORCE_MISSING),
        ({'gradient_mean': math.nan}, Reason.GRADIENT_MISSING),
        ({'brake_command': math.nan}, Reason.BRAKE_COMMAND_MISSING),
        ({'speed': 0.9}, Reason.STANDSTILL),
        ({'brake_command': -0.5}, Reason.BRAKING),
    ],
)
def test_bad_samples_are_rejected_and_change_no_estimate(
    train_file: TrainFile, sample: Make, journey: Journey, fields: dict[str, Any], reason: Reason
) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(60.0, traction=saw_tooth):
        estimator.step(item)
    before = encode(estimator.learner.tracker)
    result = step_and_estimate(estimator, sample(301, **fields))
    assert isinstance(result, Rejection)
    assert result.reason is reason
    assert encode(estimator.learner.tracker) == before
    assert estimator.learner._windows.samples == []


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
    estimator = VMils(train_file, CONFIG)
    for item in journey(840.0, traction=saw_tooth, speed=8.0):
        estimator.step(item)
    found = estimator.estimate(12.0)
    assert estimator.converged
    assert found.speed_max - found.speed_min > 4.0
    for v in np.linspace(found.speed_min, found.speed_max, 5).tolist():
        here = estimator.estimate(v)
        # 180 unbiased observations of about 0.1 N/kN: 0.03 N/kN, and within the stated standard deviation.
        assert here.resistance == pytest.approx(w(TRUTH, v), abs=max(0.05, 3.0 * here.resistance_std))
        assert here.resistance_std < 0.1


def test_the_fields_of_an_estimate_are_consistent(train_file: TrainFile, journey: Journey) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(120.0, traction=saw_tooth):
        estimator.step(item)
    e = estimator.estimate(13.0)
    P = np.array(e.covariance).reshape(3, 3)
    phi = np.array([1.0, 13.0, 169.0])
    assert e.resistance == pytest.approx(e.a + 13.0 * e.b + 169.0 * e.c, rel=1e-12)
    assert e.resistance_std == pytest.approx(math.sqrt(phi @ P @ phi), rel=1e-9)
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
    estimator = VMils(train_file, CONFIG)
    for item in samples[: round(5 * (jump_s + 120.0))]:
        estimator.step(item)
    truth = replace(TRUTH, a=TRUTH.a + step)
    # Two minutes later most of the step is followed, a few minutes later all of it.
    assert abs(estimator.estimate(14.0).resistance - w(truth, 14.0)) < 0.35 * abs(step)
    for item in samples[round(5 * (jump_s + 120.0)) :]:
        estimator.step(item)
    assert estimator.estimate(14.0).resistance == pytest.approx(w(truth, 14.0), abs=0.25)
    assert estimator.learner.tracker.steps_found >= 1


def test_without_a_jump_no_step_is_detected(train_file: TrainFile, journey: Journey) -> None:
    found = 0
    for seed in range(3):
        estimator = VMils(train_file, CONFIG)
        run = journey(560.0, traction=saw_tooth, speed=10.0, seed=seed, resistance=lambda _: Davis(1.5, 0.03, 0.004))
        for item in run:
            estimator.step(item)
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


def garbage(seed: int, make: Make) -> list[Sample]:
    """Samples as bad as the aligner passes on, mixed with good ones."""
    rng = np.random.default_rng(seed)
    wild = rng.random() < 0.5

    def maybe(value: float, spread: float, low: float, high: float) -> float:
        kind = rng.random()
        if kind < 0.08:
            return math.nan
        if wild and kind < 0.2:
            return float(rng.uniform(low, high))
        return float(np.clip(value + spread * rng.standard_normal(), low, high))

    samples, stamp, command, direction = [], 1_700_000_000 * NS_PER_S, 0.0, 1
    for i in range(int(rng.integers(50, 400))):
        dt = float(rng.choice([0.02, 0.2, 0.2, 0.2, 0.4, 1.0]))
        stamp += round(dt * NS_PER_S)
        changes: tuple[BrakeCommandChange, ...] = ()
        if rng.random() < 0.05:
            command = -float(rng.choice([0.0, 0.0, 0.3, 1.0, 10.0]))
            changes = (BrakeCommandChange(stamp - 1, command),)
        speed = maybe(12.0, 0.05, 0.0, 200.0)
        samples.append(
            make(
                i,
                stamp_ns=stamp,
                dt=math.nan if rng.random() < 0.03 else dt,
                speed=12.0 if math.isnan(speed) else speed,
                position=maybe(1e3, 100.0, -1e6, 1e6),
                direction=direction,
                force=maybe(0.0, 1e5, -1e8, 1e8),
                force_mean=maybe(0.0, 1e5, -1e8, 1e8),
                gradient=maybe(0.0, 5.0, -200.0, 200.0),
                gradient_mean=maybe(0.0, 5.0, -200.0, 200.0),
                curve_radius=abs(maybe(0.0, 400.0, 0.0, 1e9)),
                tunnel=bool(rng.random() < 0.3),
                mass=maybe(2e5, 1e3, 100.0, 1e9),
                brake_command=math.nan if rng.random() < 0.03 else command,
                brake_changes=changes,
                brake_gap=bool(rng.random() < 0.02),
                emergency=bool(rng.random() < 0.01),
            )
        )
    return samples


@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(seed=st.integers(0, 2**32 - 1))
def test_the_estimate_stays_finite_for_any_input(train_file: TrainFile, sample: Make, seed: int) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in garbage(seed, sample):
        estimator.step(item)
        e = estimator.estimate(item.speed)
        values = [getattr(e, name) for name in e.__dataclass_fields__ if name != 'covariance']
        assert all(map(math.isfinite, [*values, *e.covariance]))
        P = np.array(e.covariance).reshape(3, 3)
        std = np.sqrt(np.diag(P))
        assert np.max(np.abs(P - P.T) / np.outer(std, std)) < 1e-9
        assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > -1e-9


def test_a_restored_estimator_continues_bit_identically(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(300.0, traction=saw_tooth, brake=lambda t: -0.5 if 170.0 < t < 180.0 else 0.0)
    # Also within a window, and while the brake is still releasing.
    for middle in (333, 777, 905):
        original, first, second = (VMils(train_file, CONFIG) for _ in range(3))
        for item in samples[:middle]:
            original.step(item)
            first.step(item)
        second.restore(first.save())
        assert second.save() == first.save()
        for item in samples[middle:]:
            assert repr(step_and_estimate(second, item)) == repr(step_and_estimate(original, item))
        assert second.save() == original.save()


def test_reset_equals_new(train_file: TrainFile, journey: Journey) -> None:
    used, new = VMils(train_file, CONFIG), VMils(train_file, CONFIG)
    samples = journey(200.0, traction=saw_tooth, brake=lambda t: -0.5 if t > 190.0 else 0.0)
    for item in samples:
        used.step(item)
    used.reset()
    assert used.save() == new.save()
    assert [repr(step_and_estimate(used, item)) for item in samples] == [
        repr(step_and_estimate(new, item)) for item in samples
    ]


@pytest.mark.parametrize('key', ['tracker', '_speed_noise', '_windows', '_slow', 'inflation'])
def test_an_invalid_saved_state_is_rejected(train_file: TrainFile, journey: Journey, key: str) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(60.0, traction=saw_tooth):
        estimator.step(item)
    data = json.loads(estimator.save())
    data['state']['learner'][key] = 7
    with pytest.raises(InputError):
        estimator.restore(json.dumps(data))


def test_a_hop_longer_than_the_window_is_rejected(train_file: TrainFile) -> None:
    with pytest.raises(InputError, match=r'hop = 6 s must not exceed window = 4.8 s'):
        VMils(train_file, VMilsConfig(hop=6.0))


@pytest.mark.parametrize('v', [8.0, 12.0, 20.0])
def test_the_model_error_is_a_share_of_w_at_every_speed(train_file: TrainFile, journey: Journey, v: float) -> None:
    config = replace(CONFIG, drift_share=0.0, model_error=0.2)
    estimator = after(train_file, journey(200.0, traction=saw_tooth), config)
    posterior, found, phi = estimator.learner.tracker.stated, estimator.estimate(v), np.array([1.0, v, v * v])
    variance = estimator.learner.inflation.factor * float(phi @ posterior.P[:3, :3] @ phi)
    assert found.resistance_std**2 - variance == pytest.approx((0.2 * found.resistance) ** 2, rel=1e-6)
