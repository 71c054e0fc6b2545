# SPDX-License-Identifier: Apache-2.0
"""What the filter bank publishes and saves: estimate, prior, fitness, loads; states restored to the bit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from test.resistance.filter_bank.drives import (
    World,
    after,
    check_finite,
    drive,
    fields_except_speed,
    restored,
    run,
    shifted,
)
from trainid_ros.estimators.settings import FilterBankConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan
from trainid_ros.resistance.speed_states import DELTA, KAPPA, KAPPA_R
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile

Make = Callable[..., Sample]
CONFIG = FilterBankConfig()
# Fewer hypotheses: the same filters, but faster.
SMALL = FilterBankConfig(hypotheses=8, valid_std=0.25)
# Without the wide prior.
STATED = replace(SMALL, wrong_prior=0.0)
G, GAMMA, MASS = 9.80665, 0.08, 200e3
INERTIA = 1000.0 * (1.0 + GAMMA) / G
FILE = TrainFile(Train(MASS, GAMMA, 100.0), Davis(1.5, 0.03, 0.004), Brake(1.0, 0.4, 0.6), Line(gradient_std=0.1))


def test_the_fields_of_an_estimate_are_consistent(learned: str) -> None:
    e = restored(learned).estimate(13.0)
    P = np.array(e.covariance).reshape(3, 3)
    phi = np.array([1.0, 13.0, 169.0])
    assert e.resistance == pytest.approx(e.a + 13.0 * e.b + 169.0 * e.c, rel=1e-12)
    assert e.resistance_std == pytest.approx(math.sqrt(phi @ P @ phi), rel=1e-9)
    assert e.resistance_std_max >= e.resistance_std
    assert restored(learned).estimate(90.0).resistance_std_max == restored(learned).estimate(90.0).resistance_std
    assert e.test_ratio == pytest.approx(e.innovation**2 / (5.5**2 * e.innovation_variance), rel=1e-9)
    check_finite(e)


def test_the_innovation_is_a_resistance_with_its_sign(learned: str, minutes: list[Sample]) -> None:
    """A speed that is too high looks like too little resistance."""
    high, plain = restored(learned), restored(learned)
    odd = after(minutes, speed=minutes[-1].speed + 0.05)
    following = [after(minutes), after([after(minutes)])]
    for bank, first in ((high, odd), (plain, after(minutes))):
        for item in (first, *following):
            bank.step(item)
    difference = high.estimate(12.0).innovation - plain.estimate(12.0).innovation
    assert difference == pytest.approx(-INERTIA * 0.05 / 0.2, rel=0.02)


def test_a_new_bank_states_the_prior(sample: Make) -> None:
    bank = FilterBank(FILE, STATED)
    first, second, third = (step_and_estimate(bank, sample(i)) for i in range(3))
    assert isinstance(first, Rejection)
    assert first.reason is Reason.GAP
    assert isinstance(second, ResistanceEstimate)
    assert isinstance(third, ResistanceEstimate)
    assert (second.a, second.b, second.c) == pytest.approx((1.5, 0.03, 0.004))
    # Half of each value, and the minimum; a wheel diameter error of 0.3 % raises a and lowers c.
    S = np.array(second.covariance).reshape(3, 3)
    a, b, c = 0.75**2 + 0.6**2, 0.015**2 + 0.02**2, 0.002**2 + 0.0006**2
    assert np.diag(S) == pytest.approx([a + 0.0045**2, b, c + 1.2e-5**2], rel=1e-9)
    assert S[0, 2] == pytest.approx(-0.0045 * 1.2e-5, rel=1e-9)
    assert fields_except_speed(third) == fields_except_speed(second)
    assert second.force_scale == 1.0
    assert second.force_delay == 0.0
    assert second.force_delay_std == pytest.approx(0.15)
    assert not bank.converged


def test_the_filters_run_two_samples_late(sample: Make) -> None:
    """After samples 1, 2 and 3, sample 1 starts the filters; sample 4 completes the update with sample 2."""
    bank = FilterBank(FILE, SMALL)
    answers = [step_and_estimate(bank, sample(i)) for i in range(5)]
    before, now = answers[3], answers[4]
    assert isinstance(before, ResistanceEstimate)
    assert isinstance(now, ResistanceEstimate)
    assert before.innovation_variance == 0.0
    assert now.innovation_variance > 0.0
    assert (now.speed_min, now.speed_max) == (15.0, 15.0)


def test_the_mean_curvature_is_stored_relative_to_that_at_600_metres(sample: Make) -> None:
    bank = FilterBank(FILE, SMALL)
    bank.step(sample(1, curve_radius=600.0, curvature_mean=1.0 / 300.0))
    assert bank._admitted[-1].curve == pytest.approx(2.0, rel=1e-12)


def test_a_wheel_diameter_error_adds_to_the_std_of_the_force_scale(sample: Make) -> None:
    bank = FilterBank(replace(FILE, train=replace(FILE.train, mass_std=0.0, force_std=0.0)), STATED)
    bank.step(sample(0))
    assert bank.estimate(12.0).force_scale_std == pytest.approx(0.003, rel=1e-3)


def test_the_priors_of_the_force_errors_come_from_the_train_file() -> None:
    def with_curve(std: tuple[tuple[str, float], ...]) -> TrainFile:
        return replace(FILE, effects=(Effect('curve_resistance', (('coefficient', 600.0),), std),))

    # The stated std; a fifth of the coefficient if not stated; 0.5 N/kN at 600 m without a curve effect.
    for file, std in ((with_curve((('coefficient', 45.0),)), 0.075), (with_curve(()), 0.2), (FILE, 0.5)):
        assert bank_plan(file, CONFIG, INERTIA).variance[KAPPA_R] == pytest.approx(std**2)
    plan = bank_plan(FILE, CONFIG, INERTIA)
    assert plan.variance[KAPPA] == pytest.approx(0.03**2 + 0.02**2)
    assert plan.variance[DELTA] == pytest.approx(0.15**2)


@pytest.mark.parametrize(('length', 'expected'), [(100.0, 284.0), (650.0, 505.0)])
def test_the_map_error_is_correlated_over_the_train(length: float, expected: float) -> None:
    plan = bank_plan(replace(FILE, train=replace(FILE.train, length=length)), CONFIG, INERTIA)
    assert plan.noise.map_length == pytest.approx(expected, abs=0.5)


def test_step_sizes_follow_the_settings_and_the_resistance() -> None:
    of_a, of_c = bank_plan(FILE, CONFIG, INERTIA).step_variances
    assert of_a == pytest.approx((0.3 + 0.15 * 1.5) ** 2)
    assert of_c == pytest.approx((0.2 * 0.004) ** 2)


def test_it_becomes_and_stays_fit_to_use_until_a_reset(followed: tuple[str, list[bool]]) -> None:
    text, fit = followed
    assert not any(fit[:100])
    assert fit[-1]
    # With hysteresis the status does not flicker.
    assert sum(a != b for a, b in pairwise(fit)) <= 3
    bank = restored(text)
    assert bank.converged
    bank.reset()
    assert not bank.converged


@pytest.mark.parametrize('was_accurate', [False, True])
def test_between_the_limit_and_twice_the_limit_the_status_does_not_change(
    learned: str, minutes: list[Sample], was_accurate: bool
) -> None:
    found = restored(learned, replace(SMALL, young_weight=1.0))
    S, at = np.array(found.estimate(12.0).covariance).reshape(3, 3), found._driven
    M = np.array([[1.0, at.m1, at.m2], [at.m1, at.m2, at.m3], [at.m2, at.m3, at.m4]])
    rms = math.sqrt(float(np.sum(S * M)))
    data = json.loads(learned)
    data['state']['_converged'] = was_accurate
    bank = restored(json.dumps(data), replace(SMALL, valid_std=rms / 1.6, valid_share=0.0, young_weight=1.0))
    item = minutes[-1]
    for _ in range(10):
        item = after([item])
        bank.step(item)
    assert bank.converged is was_accurate


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
def test_a_rejected_sample_changes_no_estimate(
    learned: str, minutes: list[Sample], fields: dict[str, Any], reason: Reason
) -> None:
    bank = restored(learned)
    before = bank.estimate(12.0)
    result = bank.step(after(minutes, **fields))
    assert isinstance(result, Rejection)
    assert result.reason is reason
    assert repr(bank.estimate(12.0)) == repr(before)


@pytest.mark.parametrize(('mass', 'step'), [(MASS, 0.004), (math.nan, 0.015)])
def test_a_stop_widens_the_force_scale_by_the_step_of_a_weighed_or_unweighed_load(
    sample: Make, mass: float, step: float
) -> None:
    bank = FilterBank(FILE, STATED)
    bank.step(sample(0))
    before = bank.estimate(0.0).force_scale_std
    for i in range(1, 50):
        bank.step(sample(i, speed=0.0, mass=mass))
    # Nothing changes at rest; the step is added once at departure, independent of the duration of the stop.
    assert bank.estimate(0.0).force_scale_std == before
    for i in range(50, 53):
        bank.step(sample(i, mass=mass))
    found = bank.estimate(0.0).force_scale_std
    assert found**2 - before**2 == pytest.approx(step**2, rel=1e-9)


def test_a_load_changes_by_at_most_half_of_the_mass_std(sample: Make) -> None:
    bank = FilterBank(replace(FILE, train=replace(FILE.train, mass_std=0.002)), STATED)
    bank.step(sample(0))
    before = bank.estimate(0.0).force_scale_std
    bank.step(sample(1, speed=0.0))
    for i in range(2, 5):
        bank.step(sample(i))
    assert bank.estimate(0.0).force_scale_std ** 2 - before**2 == pytest.approx(0.001**2, rel=1e-6)


def test_the_force_scale_adapts_to_an_unweighed_load_after_a_stop(learned: str, minutes: list[Sample]) -> None:
    found = {}
    for weighed in (False, True):
        bank = restored(learned)
        bank.step(after(minutes, speed=0.0, dt=math.nan, mass=MASS if weighed else math.nan))
        mass = MASS if weighed else math.nan
        for item in shifted(drive(120.0, World(mass=1.04), seed=10), 500.0):
            bank.step(replace(item, mass=mass))
        found[weighed] = bank.estimate(12.0)
    assert found[False].force_scale == pytest.approx(1.0 / 1.04, abs=3.0 * found[False].force_scale_std)
    # With a load reported as weighed the force scale changes less.
    assert found[True].force_scale - found[False].force_scale > 0.01


def test_standing_for_half_an_hour_does_not_change_the_bank(sample: Make, learned: str) -> None:
    bank = restored(learned)
    bank.step(sample(10_000, speed=0.0))
    state = json.loads(bank.save())['state']['bank']
    for i in range(1, 9_000):
        bank.step(sample(10_000 + i, speed=0.0))
    assert json.loads(bank.save())['state']['bank'] == state


def test_restored_at_any_sample_it_continues_bit_identically(minutes: list[Sample]) -> None:
    samples = [
        *minutes[:330],
        *(replace(s, brake_command=-0.5) for s in minutes[330:340]),
        *minutes[340:420],
        *(replace(s, speed=0.0) for s in minutes[420:425]),
        *(replace(s, speed=s.speed + 3.0) for s in minutes[425:460]),
        *minutes[460:520],
    ]
    middles = (0, 1, 2, 3, 4, 199, 256, 335, 366, 367, 368, 369, 422, 426, 440, 459, 519)
    original = FilterBank(FILE, SMALL)
    saved: dict[int, str] = {}
    answers = []
    for i, item in enumerate(samples):
        if i in middles:
            saved[i] = original.save()
        answers.append(repr(step_and_estimate(original, item)))
    for i, text in saved.items():
        copy = restored(text)
        assert copy.save() == text
        until = len(samples) if i in (366, 440) else min(i + 25, len(samples))
        assert [repr(step_and_estimate(copy, item)) for item in samples[i:until]] == answers[i:until]
        if until == len(samples):
            assert copy.save() == original.save()


def test_reset_equals_new(minutes: list[Sample]) -> None:
    used, new = run(minutes[:120]), FilterBank(FILE, SMALL)
    used.reset()
    assert used.save() == new.save()
    assert [repr(used.step(s)) for s in minutes[:120]] == [repr(new.step(s)) for s in minutes[:120]]


def test_settings_out_of_range_are_rejected() -> None:
    with pytest.raises(InputError, match='hypotheses'):
        FilterBank(FILE, FilterBankConfig(hypotheses=1))


@pytest.mark.parametrize('at_once', [True, False])
def test_after_a_gap_the_first_samples_are_judged_at_their_own_speed(
    at_once: bool, learned: str, minutes: list[Sample]
) -> None:
    """Nothing is learned from the first samples, and the std at 60 m/s is above twice the limit."""
    bank = restored(learned)
    bank.step(after(minutes, dt=math.nan))
    assert bank.converged
    assert bank.estimate(60.0).resistance_std > 2.0 * math.hypot(0.25, 0.05 * bank.estimate(60.0).resistance)
    speeds = [60.0] if at_once else [minutes[-1].speed, 60.0, 60.0]  # the filters start at the third sample
    for speed in speeds:
        assert bank.converged
        bank.step(after(minutes, speed=speed))
    assert not bank.converged


def test_slow_samples_are_judged_each_by_itself(learned: str) -> None:
    """With a sample every second, an estimate is withdrawn by the next one."""
    bank = restored(learned, replace(SMALL, valid_std=0.15))
    samples = shifted(drive(20.0, period=1.0), 400.0)
    for item in samples:
        bank.step(item)
    assert bank.converged
    bank.bank.idle(1e7)
    last = samples[-1]
    bank.step(replace(last, stamp_ns=last.stamp_ns + 1_000_000_000))
    assert not bank.converged
