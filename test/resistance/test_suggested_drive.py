# SPDX-License-Identifier: Apache-2.0
"""Planned drives; which one is suggested, what it promises, and how a bank of hypotheses foresees that."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from test.estimators.makers import stepped
from trainid_ros.estimators.settings import FilterBankConfig, VMilsConfig
from trainid_ros.interface.records import KM_H, NS_PER_S
from trainid_ros.resistance.davis_posterior import resistance_std
from trainid_ros.resistance.filter_bank import FilterBank, bank_plan, foreseen_mixtures, usual_deviations
from trainid_ros.resistance.hypotheses import Bank, Mixture
from trainid_ros.resistance.suggested_drive import (
    STEP_S,
    Manoeuvre,
    Run,
    SuggestedDrive,
    plan_run,
    planned_runs,
    suggested_drive,
    top_speed,
)
from trainid_ros.resistance.vmils import VMils
from trainid_ros.setup.pipelines import EstimatorSettings, resistance_pipeline
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import G, specific_inertia
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

FILE = TrainFile(Train(200e3, max_speed=80.0 / KM_H), Davis(2.0, 0.02, 0.004), line=Line(gradient_std=0.05))
DAVIS = FILE.resistance
BANK = FilterBankConfig(hypotheses=8)
HELD = 50.0 / KM_H
DT = 0.2
Make = Callable[[], FilterBank | VMils]
MAKERS: list[Make] = [lambda: FilterBank(FILE, BANK), lambda: VMils(FILE, VMilsConfig())]
BOTH = pytest.mark.parametrize('make', MAKERS, ids=['bank', 'V-MILS'])


def planned(manoeuvre: Manoeuvre, file: TrainFile = FILE, scale: float = 1.0) -> Run:
    run = plan_run(manoeuvre, file, file.resistance, scale)
    assert run is not None
    return run


@pytest.mark.parametrize(
    ('manoeuvre', 'text'),
    [
        (Manoeuvre(70 / KM_H, 40 / KM_H), 'coast from 70 to 40 km/h'),
        (Manoeuvre(70 / KM_H, 70 / KM_H, 60.0), 'hold 70 km/h for 60 s'),
        (Manoeuvre(60 / KM_H, 60 / KM_H, braking=-0.6), 'brake from 60 km/h with -0.6 m/s²'),
        (Manoeuvre(70 / KM_H, 70 / KM_H), 'accelerate with full traction to 70 km/h'),
    ],
)
def test_words(manoeuvre: Manoeuvre, text: str) -> None:
    assert manoeuvre.text == text


def test_coasting_follows_the_resistance() -> None:
    run = planned(Manoeuvre(70 / KM_H, 50 / KM_H))
    coasting = [step for step in run.steps if step.traction == 0.0]
    # Mean deceleration at 60 km/h: w g / 1000 / (1 + gamma), and its duration over 20 km/h
    w = 2.0 + 0.02 * 60 / KM_H + 0.004 * (60 / KM_H) ** 2
    assert len(coasting) * STEP_S == pytest.approx(20 / KM_H / (w * 9.80665e-3 / 1.08), rel=0.08)
    assert run.steps[-1].speed == pytest.approx(50 / KM_H, abs=0.05)
    assert max(step.speed for step in run.steps) == pytest.approx(70 / KM_H, abs=0.8)


def test_a_held_speed_is_held() -> None:
    run = planned(Manoeuvre(50 / KM_H, 50 / KM_H, 60.0), scale=0.9)
    held = run.steps[-round(60.0 / STEP_S) + 5 :]
    assert all(step.speed == pytest.approx(50 / KM_H, abs=1.0) for step in held)
    braked, accelerated = (50 / KM_H) ** 2 / (2.0 * 0.6), (50 / KM_H) ** 2 / (2.0 * 0.9)
    assert run.length_m == pytest.approx(60.0 * 50 / KM_H + braked + accelerated, rel=0.1)


@pytest.mark.parametrize('brake', [Brake(), Brake(delay=3.3, time_constant=1.0), Brake(rate=0.7)])
def test_the_braking_takes_as_long_as_the_brake_of_the_train_file(brake: Brake) -> None:
    file = replace(FILE, resistance=Davis(0.0, 0.0, 0.0))
    run, sudden = (
        planned(Manoeuvre(60 / KM_H, 60 / KM_H), replace(file, brake=each))
        for each in (brake, Brake(delay=0.0, time_constant=0.0))
    )
    v, lost_s = sudden.steps[-1].speed, brake.delay + brake.time_constant
    more = v * lost_s + 0.5 * v * v / 0.6 * (1.0 / brake.rate - 1.0)
    assert run.length_m - sudden.length_m == pytest.approx(more, abs=2.0 + 0.04 * more)
    assert run.duration_s - sudden.duration_s == pytest.approx(lost_s + v / 0.6 * (1.0 / brake.rate - 1.0), abs=1.0)


def test_a_drive_that_takes_too_long_or_is_too_fast_for_the_train_is_not_planned() -> None:
    weak = replace(FILE, train=replace(FILE.train, max_traction_power=10e3))
    assert plan_run(Manoeuvre(70 / KM_H, 20 / KM_H), FILE, Davis(0.1, 0.0, 0.0)) is None
    assert plan_run(Manoeuvre(70 / KM_H, 50 / KM_H), weak, DAVIS) is None


def test_runs_fit_on_the_line() -> None:
    limited = replace(FILE, line=Line(stops=(0.0, 800.0, 2300.0), speed_limit=((0.0, 40 / KM_H), (500.0, 60 / KM_H))))
    assert top_speed(limited) == pytest.approx(60 / KM_H)
    runs = list(planned_runs(limited, DAVIS))
    assert runs
    assert all(run.length_m <= 1500.0 and run.manoeuvre.start <= 60 / KM_H + 1e-9 for run in runs)
    assert len(list(planned_runs(FILE, DAVIS))) > len(runs)


def test_nothing_is_learned_before_the_brake_is_released() -> None:
    run = planned(Manoeuvre(70 / KM_H, 50 / KM_H))
    assert run.steps[run.first_learned(0.0, 2.0)].speed >= 2.0 > run.steps[run.first_learned(0.0, 2.0) - 1].speed
    assert run.first_learned(8.0, 2.0) == round(8.0 / STEP_S)
    assert run.first_learned(1e4, 2.0) == run.first_learned(0.0, 99.0) == len(run.steps)


def test_a_run_keeps_to_the_speed_limits_where_they_hold() -> None:
    """Fast for 100 m in the middle of 4 km: there is no room to drive fast."""
    limits = ((0.0, 10.0), (2000.0, 25.0), (2100.0, 10.0))
    tight = replace(FILE, line=Line(stops=(0.0, 4000.0), speed_limit=limits))
    assert all(max(step.speed for step in run.steps) < 10.6 for run in planned_runs(tight, DAVIS))
    wide = replace(tight, line=replace(tight.line, speed_limit=((0.0, 10.0), (1000.0, 25.0))))
    assert any(max(step.speed for step in run.steps) > 15.0 for run in planned_runs(wide, DAVIS))


def test_a_run_brakes_before_a_lower_limit() -> None:
    """Fast for 1000 m, then slow to the stop: at the braking of a fast run from there, the limit is too low."""
    limited = replace(FILE, line=Line(stops=(0.0, 2200.0), speed_limit=((0.0, 25.0), (1000.0, 5.0))))
    for run in planned_runs(limited, DAVIS):
        positions = STEP_S * np.cumsum(run.speeds)
        beyond = [speed for speed, position in zip(run.speeds, positions, strict=True) if position > 1000.0]
        assert max(beyond, default=0.0) < 5.6 or max(run.speeds) < 5.6
    free = replace(limited, line=replace(limited.line, speed_limit=((0.0, 25.0),)))
    assert len(list(planned_runs(free, DAVIS))) > len(list(planned_runs(limited, DAVIS)))


def held(seconds: float) -> list[Sample]:
    """Return samples of a speed that is held."""
    rng, w = np.random.default_rng(3), 2.0 + 0.02 * HELD + 0.004 * HELD * HELD
    force = w * FILE.train.mass * G / 1000.0
    samples = []
    for k in range(round(seconds / DT)):
        speed = HELD + 0.02 * float(rng.standard_normal())
        sample = coasting_sample(round((1000.0 + DT * k) * NS_PER_S), math.nan if k == 0 else DT, speed)
        sample.force = sample.force_mean = force
        sample.position, sample.curvature_mean = HELD * DT * k, 0.0
        samples.append(sample)
    return samples


def driven(estimator: FilterBank | VMils, seconds: float = 120.0) -> FilterBank | VMils:
    stepped(estimator, held(seconds))
    return estimator


def suggested(estimator: FilterBank | VMils, file: TrainFile = FILE) -> SuggestedDrive | None:
    prior = type(estimator)(file, estimator.config).estimate(0.0)  # type: ignore[arg-type]
    return suggested_drive(estimator, file, prior, estimator.estimate(0.0))


@BOTH
def test_after_one_speed_another_is_suggested(make: Make) -> None:
    drive = suggested(driven(make()))
    assert drive is not None
    by_name = {item.wanted.name: item for item in drive.promises}
    # At the speed held w is known already; elsewhere it is not.
    assert by_name['w at 40 km/h'].before < by_name['w at 80 km/h'].before > 1.0
    assert drive.least_known.then < 0.9 * drive.least_known.now
    assert drive.run.manoeuvre.text in drive.text
    assert f'{drive.least_known.wanted.name} ± {drive.least_known.then:.2g}' in drive.text
    assert drive.numbers['least_known'] == drive.least_known.wanted.name
    assert pickle.loads(pickle.dumps(drive)).numbers == drive.numbers  # trials run in other processes


def test_a_promise_leaves_the_estimator_as_it_is() -> None:
    bank = driven(FilterBank(FILE, BANK), 60.0)
    before = bank.save()
    first, second = suggested(bank), suggested(bank)
    assert bank.save() == before
    assert first is not None is not second
    assert first.numbers == second.numbers


@BOTH
def test_repetitions_promise_more(make: Make) -> None:
    estimator = driven(make())
    drive = suggested(estimator)
    assert drive is not None
    stds = [math.sqrt(then.covariance[4]) for then in estimator.foreseen(drive.run, 3)]
    assert stds[0] > stds[1] > stds[2]
    assert stds[0] < math.sqrt(estimator.estimate(0.0).covariance[4])


def test_nothing_is_suggested_where_all_is_known() -> None:
    known = replace(BANK, prior_share=0.0, prior_std_a=0.6, valid_std=10.0)
    sure = replace(FILE, train=replace(FILE.train, mass_std=0.001, force_std=0.0))
    bank = driven(FilterBank(sure, known))
    prior = FilterBank(sure, known).estimate(0.0)
    wide = tuple(100.0 * x for x in prior.covariance)
    prior.covariance = wide
    assert suggested_drive(bank, sure, prior, bank.estimate(0.0)) is None


def test_nothing_is_suggested_before_the_first_sample_or_by_other_estimators() -> None:
    fresh = FilterBank(FILE, BANK)
    assert suggested(fresh) is None
    estimate = driven(FilterBank(FILE, BANK), 20.0).estimate(0.0)
    assert suggested_drive(object(), FILE, fresh.estimate(0.0), estimate) is None


def test_no_drive_is_suggested_after_which_something_known_would_not_be() -> None:
    line = Line(stops=(0.0, 3450.0), speed_limit=((0.0, 8.0),))
    file = TrainFile(Train(194e3, length=118.0, cars=6), Davis(1.0, 0.03, 0.003), line=line)
    pipeline = resistance_pipeline(file, EstimatorSettings())
    prior = pipeline.current().estimate
    for record in simulate(Scenario(file, runs=2), np.random.default_rng(3)).records:
        pipeline.push(record)
    now, bank = pipeline.current().estimate, pipeline.estimator
    assert isinstance(bank, FilterBank)
    found = replace(file, resistance=Davis(now.a, now.b, now.c))
    run = planned(Manoeuvre(25.0 / KM_H, 10.0 / KM_H), found, now.force_scale)
    *_, then = bank.foreseen(run, 3)
    # This drive shows more of c, but for so long that w is no longer known.
    limit = math.hypot(bank.config.valid_std, bank.config.valid_share * 1.2)
    assert math.sqrt(then.covariance[8]) < 0.9 * math.sqrt(now.covariance[8])
    assert resistance_std(then.covariance, 12.0 / KM_H) > limit > resistance_std(now.covariance, 12.0 / KM_H)
    assert suggested_drive(bank, file, prior, now) is None


METRO = TrainFile(Train(194e3, length=118.0, cars=6), Davis(1.0, 0.03, 0.003))
VARIANCES = 1e-4, 1e-4
FIRST = 5


def bank_of_metro() -> Bank:
    return Bank(bank_plan(METRO, FilterBankConfig(), specific_inertia(1.0, METRO.train.rotary_mass)))


RUN = planned(Manoeuvre(60.0 / KM_H, 40.0 / KM_H), METRO)


def after(deviations: np.ndarray) -> list[Mixture]:
    return list(foreseen_mixtures(bank_of_metro(), RUN, deviations, FIRST, 1.0, VARIANCES))


def test_each_run_makes_the_resistance_better_known() -> None:
    first, second = after(np.zeros((2, len(RUN.steps))))
    prior = bank_of_metro().mixture().covariance
    assert prior[0] > first.covariance[0] > second.covariance[0]
    assert prior[9] > first.covariance[9] > second.covariance[9]


def test_an_innovation_far_beyond_its_standard_deviation_makes_a_step_likely() -> None:
    usual, odd = np.zeros((1, len(RUN.steps))), np.zeros((1, len(RUN.steps)))
    odd[0, -40:] = 2.0
    assert after(odd)[0].covariance[0] > 1.2 * after(usual)[0].covariance[0]


def test_usual_deviations_are_two_sequences_of_opposite_sign() -> None:
    one, other = usual_deviations(RUN, 3)
    assert one.shape == (3, len(RUN.steps))
    assert np.array_equal(one, -other)
    assert np.std(one) == pytest.approx(1.0, abs=0.1)


def test_covariances_are_averaged() -> None:
    bank, pair = FilterBank(METRO, FilterBankConfig()), usual_deviations(RUN, 1)
    (both,), (first,), (second,) = (list(bank.foreseen(RUN, 1, some)) for some in (pair, pair[:1], pair[1:]))
    mean = [0.5 * (x + y) for x, y in zip(first.covariance, second.covariance, strict=True)]
    assert first.covariance != second.covariance
    assert both.covariance == pytest.approx(mean, rel=1e-12)
