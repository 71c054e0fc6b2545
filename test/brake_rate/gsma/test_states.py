# SPDX-License-Identifier: Apache-2.0
"""GSMA with outliers and any other input; reset, saved and invalid states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from benchmarks.stepping import step_and_estimate
from test.brake_rate.gsma.drives import braking, gsma, power, stop_and_go
from trainid_ros.brake_rate.gsma import GsmaPosterior
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = GsmaConfig()


def test_outliers_are_rejected_and_several_in_a_row_are_accepted(train_file: TrainFile, journey: Journey) -> None:
    estimator = gsma(train_file)
    samples = journey(30.0, brake=braking, speed=25.0)
    for item in samples[:75]:
        estimator.step(item)
    before = estimator.estimate(0.0).brake_rate
    for item in samples[75 : 75 + CONFIG.readmit_after]:
        result = step_and_estimate(estimator, replace(item, speed=item.speed + 3.0))
        assert isinstance(result, Rejection)
        assert result.reason is Reason.OUTLIER
        # Not used; only resampled, within a fraction of the standard deviation.
        assert estimator.estimate(0.0).brake_rate == pytest.approx(before, abs=0.005)
    assert estimator.estimate(0.0).speed == pytest.approx(samples[79].speed + 3.0, abs=1e-9)
    assert estimator.step(replace(samples[80], speed=samples[80].speed + 3.0)) is None


@pytest.mark.parametrize(
    ('fields', 'reason'),
    [
        ({'dt': math.nan}, Reason.GAP),
        ({'force_mean': math.nan}, Reason.FORCE_MISSING),
        ({'force_mean': 1e8}, Reason.OUT_OF_RANGE),
        ({'gradient_mean': math.nan}, Reason.GRADIENT_MISSING),
        ({'brake_command': math.nan}, Reason.BRAKE_COMMAND_MISSING),
        ({'speed': 0.4}, Reason.STANDSTILL),
    ],
)
def test_invalid_samples_are_rejected_with_their_reason(
    train_file: TrainFile, journey: Journey, fields: dict[str, Any], reason: Reason
) -> None:
    estimator = gsma(train_file)
    samples = journey(12.0, brake=braking, speed=25.0)
    for item in samples[:50]:
        estimator.step(item)
    before = estimator.estimate(0.0)
    result = step_and_estimate(estimator, replace(samples[50], **fields))
    assert isinstance(result, Rejection)
    assert result.reason is reason
    after = estimator.estimate(0.0)
    assert after.brake_rate == before.brake_rate
    assert after.brake_rate_std > before.brake_rate_std


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


@settings(max_examples=20, deadline=None, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(seed=st.integers(0, 2**32 - 1))
def test_no_input_invalidates_the_estimate(train_file: TrainFile, sample: Make, seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimator, stamp, command = gsma(train_file), 1_700_000_000 * NS_PER_S, 0.0

    def wild(value: float, spread: float, low: float, high: float, share: float = 0.1) -> float:
        if rng.random() < share:
            return float(rng.choice([math.nan, low, high, rng.uniform(low, high)]))
        return float(np.clip(value + spread * rng.standard_normal(), low, high))

    for i in range(int(rng.integers(50, 300))):
        dt = float(rng.choice([0.02, 0.2, 0.2, 0.5, 1.0]))
        stamp += round(dt * NS_PER_S)
        changes: tuple[BrakeCommandChange, ...] = ()
        if rng.random() < 0.1:
            command = -float(rng.choice([0.0, 0.4, 1.0, 10.0]))
            changes = (BrakeCommandChange(stamp - 10, command), BrakeCommandChange(stamp, command))
        speed = wild(12.0, 0.1, 0.0, 200.0)
        fields: dict[str, Any] = {
            'stamp_ns': stamp,
            'dt': math.nan if rng.random() < 0.03 else dt,
            'speed': 0.0 if math.isnan(speed) else speed,
            'position': wild(1e3, 10.0, -1e6, 1e6),
            'force_mean': wild(1e5, 1e5, -1e8, 1e8),
            'gradient_mean': wild(0.0, 10.0, -200.0, 200.0),
            'mass': wild(2e5, 1e4, 100.0, 1e9),
            'brake_command': math.nan if rng.random() < 0.05 else command,
            'brake_changes': changes,
        }
        estimator.step(sample(i, **fields))
        e = estimator.estimate(12.0)
        values = [getattr(e, name) for name in e.__dataclass_fields__ if name != 'position']
        assert all(map(math.isfinite, values)), i
        assert 0.0 <= e.brake_rate <= 3.0
        assert e.brake_rate_std > 0.0
        assert 1.0 <= e.effective_particles <= 3 * CONFIG.particles * (1.0 + 1e-9)
        assert isinstance(estimator.posterior, GsmaPosterior)
        P = estimator.posterior.P
        std = np.sqrt(np.diag(P))
        if np.all(std > 0.0):
            assert np.max(np.abs(P - P.T) / np.outer(std, std)) < 1e-9
            assert np.min(np.linalg.eigvalsh(P / np.outer(std, std))) > -1e-9


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


def test_a_run_saved_and_restored_in_the_middle_continues_bit_identical(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(120.0, brake=stop_and_go, traction=power, speed=10.0, rate=lambda _: 0.9)
    # In traction, in the dead time, while braking (particles not pruned yet), at standstill.
    for middle in (100, 178, 250, 350):
        uninterrupted, first, second = gsma(train_file), gsma(train_file), gsma(train_file, seed=99)
        for item in samples[:middle]:
            uninterrupted.step(item)
            first.step(item)
        second.restore(first.save())
        for item in samples[middle:]:
            assert repr(step_and_estimate(second, item)) == repr(step_and_estimate(uninterrupted, item))
        assert second.save() == uninterrupted.save()


def test_a_state_saved_while_braking_and_restored_after_the_release_does_not_go_on_braking(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(120.0, brake=stop_and_go, traction=power, speed=10.0, rate=lambda _: 0.9)
    old, later = gsma(train_file), gsma(train_file)
    for item in samples[:250]:
        old.step(item)
    later.restore(old.save())
    assert later.state.commands.value(samples[249].stamp_ns) < 0.0
    released = [item for item in samples[410:] if item.brake_command == 0.0][:100]
    stated = (BrakeCommandChange(released[0].stamp_ns, 0.0),)  # by the stream, after a contradiction
    results = [later.step(replace(released[0], dt=math.nan, brake_gap=True, brake_changes=stated))]
    results += [later.step(item) for item in released[1:]]
    assert all(isinstance(result, Rejection) for result in results)
    assert later.state.commands.value(released[-1].stamp_ns) == 0.0


def test_a_reset_estimator_equals_a_new_one(train_file: TrainFile, journey: Journey) -> None:
    used, new = gsma(train_file), gsma(train_file)
    samples = journey(60.0, brake=stop_and_go, speed=15.0)
    for item in samples:
        used.step(item)
    used.reset()
    assert used.save() == new.save()
    assert [repr(step_and_estimate(used, item)) for item in samples] == [
        repr(step_and_estimate(new, item)) for item in samples
    ]
