# SPDX-License-Identifier: Apache-2.0
"""V-MILS: what it skips, what it learns, that it recovers and that it never loses itself."""

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

from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Reason, Refusal, ResistanceEstimate
from trainid_ros.core.samples import BrakeCommandChange, Sample
from trainid_ros.estimators.resistance.robust import gate
from trainid_ros.estimators.resistance.vmils import VMils, VMilsConfig
from trainid_ros.physics.train_file import Davis, TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]
CONFIG = VMilsConfig()
TRUTH = Davis(1.8, 0.02, 0.005)


def saw_tooth(t: float) -> float:
    """Power for 40 s, coast for 100 s [N/kN]: uphill the speed stays between 7 and 18 m/s."""
    return 30.0 if t % 140.0 < 40.0 else 0.0


def w(davis: Davis, v: float) -> float:
    return davis.a + davis.b * v + davis.c * v * v


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
def test_bad_samples_are_skipped_and_change_no_belief(
    train_file: TrainFile, sample: Make, journey: Journey, fields: dict[str, Any], reason: Reason
) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(60.0, traction=saw_tooth):
        estimator.step(item)
    before = estimator.state.learner.tracker
    result = estimator.step(sample(301, **fields))
    assert isinstance(result, Refusal)
    assert result.reason is reason
    assert estimator.state.learner.tracker == before
    assert estimator.state.learner.ticks == ()


def test_standing_and_braking_leave_the_parameters_to_the_bit(train_file: TrainFile, journey: Journey) -> None:
    """Ten minutes of stops: nothing is learned between the start of a braking and the next departure."""
    samples = journey(
        600.0,
        traction=lambda t: 40.0 if t % 150.0 < 35.0 else 0.0,
        brake=lambda t: -0.7 if t % 150.0 > 90.0 else 0.0,
        speed=0.0,
    )
    estimator = VMils(train_file, CONFIG)
    learned = 0
    for item in samples:
        before = estimator.learner.tracker.belief
        estimator.step(item)
        if item.brake_command < 0.0 or item.speed < CONFIG.min_speed:
            assert estimator.learner.tracker.belief == before
        learned += estimator.learner.tracker.belief != before
    assert learned > 20


def test_it_learns_the_resistance_over_the_speeds_it_saw(train_file: TrainFile, journey: Journey) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(840.0, traction=saw_tooth, speed=8.0):
        estimator.step(item)
    found = estimator.estimate(12.0)
    assert estimator.converged
    assert found.speed_max - found.speed_min > 4.0
    for v in np.linspace(found.speed_min, found.speed_max, 5).tolist():
        here = estimator.estimate(v)
        # 180 observations of about 0.1 N/kN and none of them biased: 0.03 N/kN, and what it says of itself.
        assert here.resistance == pytest.approx(w(TRUTH, v), abs=max(0.05, 3.0 * here.resistance_std))
        assert here.resistance_std < 0.1


def test_the_estimate_is_consistent_in_itself(train_file: TrainFile, journey: Journey) -> None:
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
    """A hard gate alone never would: +5 N/kN lies far beyond it."""
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
    after = replace(TRUTH, a=TRUTH.a + step)
    # Two minutes later most of the step is found, a few minutes later all of it.
    assert abs(estimator.estimate(14.0).resistance - w(after, 14.0)) < 0.35 * abs(step)
    for item in samples[round(5 * (jump_s + 120.0)) :]:
        estimator.step(item)
    assert estimator.estimate(14.0).resistance == pytest.approx(w(after, 14.0), abs=0.25)
    assert estimator.learner.tracker.steps_found >= 1


def test_without_a_jump_it_finds_no_step(train_file: TrainFile, journey: Journey) -> None:
    found = 0
    for seed in range(3):
        estimator = VMils(train_file, CONFIG)
        run = journey(560.0, traction=saw_tooth, speed=10.0, seed=seed, resistance=lambda _: Davis(1.5, 0.03, 0.004))
        for item in run:
            estimator.step(item)
        found += estimator.learner.tracker.steps_found
    assert found <= 1


def test_slipping_windows_are_refused(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(400.0, traction=saw_tooth)
    slipping = [
        replace(item, speed=item.speed + 2.0) if i >= 1000 and i % 25 < 11 else item for i, item in enumerate(samples)
    ]
    estimator = VMils(train_file, CONFIG)
    reasons = [r.reason for r in map(estimator.step, slipping) if isinstance(r, Refusal)]
    assert reasons.count(Reason.SPEED_INCONSISTENT) + reasons.count(Reason.OUTLIER) > 20
    assert estimator.estimate(14.0).resistance == pytest.approx(w(TRUTH, 14.0), abs=0.4)


def test_used_samples_make_an_observation_every_hop(train_file: TrainFile, journey: Journey) -> None:
    estimator = VMils(train_file, CONFIG)
    results = [estimator.step(item) for item in journey(100.0, speed=20.0)]
    accepted = sum(isinstance(r, ResistanceEstimate) for r in results)
    # The first sample has no dt; the first window needs 25, then one every 6.
    assert accepted == 499
    assert estimator.learner.observations == 1 + (499 - 25) // 6


def garbage(seed: int, make: Make) -> list[Sample]:
    """Samples as bad as the aligner lets them through, mixed with good ones."""
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
@given(st.integers(0, 2**32 - 1))
def test_no_input_makes_it_lose_itself(train_file: TrainFile, sample: Make, seed: int) -> None:
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


def test_saved_and_restored_in_the_middle_it_goes_on_to_the_bit(train_file: TrainFile, journey: Journey) -> None:
    samples = journey(300.0, traction=saw_tooth, brake=lambda t: -0.5 if 170.0 < t < 180.0 else 0.0)
    # Also within a window, and while the brake still releases.
    for middle in (333, 777, 905):
        whole, first, second = (VMils(train_file, CONFIG) for _ in range(3))
        for item in samples[:middle]:
            whole.step(item)
            first.step(item)
        second.restore(first.save())
        assert repr(second.state) == repr(first.state)
        for item in samples[middle:]:
            assert repr(second.step(item)) == repr(whole.step(item))
        assert second.save() == whole.save()


def test_reset_equals_new(train_file: TrainFile, journey: Journey) -> None:
    used, new = VMils(train_file, CONFIG), VMils(train_file, CONFIG)
    samples = journey(200.0, traction=saw_tooth, brake=lambda t: -0.5 if t > 190.0 else 0.0)
    for item in samples:
        used.step(item)
    used.reset()
    assert used.save() == new.save()
    assert [repr(used.step(item)) for item in samples] == [repr(new.step(item)) for item in samples]


@pytest.mark.parametrize('key', ['tracker', 'tachometer', 'ticks', 'slow'])
def test_a_saved_state_that_does_not_fit_is_refused(train_file: TrainFile, journey: Journey, key: str) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(60.0, traction=saw_tooth):
        estimator.step(item)
    data = json.loads(estimator.save())
    data['state']['learner'][key] = 7
    with pytest.raises(InputError):
        estimator.restore(json.dumps(data))


@pytest.mark.parametrize(
    ('path', 'wrong'),
    [
        (('disturbance_variance',), -5.0),
        (('disturbance_variance',), math.nan),
        (('innovation_variance',), -1.0),
        (('tachometer', 'variance'), math.nan),
        (('tachometer', 'variance'), -1.0),
        (('tachometer', 'last'), math.inf),
        (('slow', 'memory'), 0.0),
        (('slow', 'factor'), -1.0),
        (('ticks', 0, 'dt'), 0.0),
        (('tracker', 'memory', 0), 0.0),
        (('tracker', 'memory', 3), 0.0),
        (('tracker', 'rows', 0, 3), -1.0),
        (('tracker', 'mean_weight'), math.nan),
        (('speed_max',), 1e308),
        (('observations',), 10**40),
    ],
)
def test_numbers_that_would_break_later_are_refused_and_nothing_changes(
    train_file: TrainFile, journey: Journey, path: tuple[Any, ...], wrong: float
) -> None:
    estimator = VMils(train_file, CONFIG)
    for item in journey(60.0, traction=saw_tooth):
        estimator.step(item)
    before = estimator.save()
    data = json.loads(before)
    part = data['state']['learner']
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = wrong
    with pytest.raises(InputError):
        estimator.restore(json.dumps(data))
    assert estimator.save() == before


def test_a_hop_longer_than_the_window_is_refused(train_file: TrainFile) -> None:
    with pytest.raises(InputError, match=r'hop = 30 must not exceed window = 25'):
        VMils(train_file, VMilsConfig(hop=30))
