# SPDX-License-Identifier: Apache-2.0
"""Tests of planned drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.resistance.suggested_drive import KM_H, STEP_S, Manoeuvre, plan_run, planned_runs, top_speed
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

FILE = TrainFile(Train(200e3, max_speed=80.0 * KM_H), Davis(2.0, 0.02, 0.004))


DAVIS = FILE.resistance


@pytest.mark.parametrize(
    ('manoeuvre', 'text'),
    [
        (Manoeuvre(70 * KM_H, 40 * KM_H), 'coast from 70 to 40 km/h'),
        (Manoeuvre(70 * KM_H, 70 * KM_H, 60.0), 'hold 70 km/h for 60 s'),
        (Manoeuvre(60 * KM_H, 60 * KM_H, braking=-0.6), 'brake from 60 km/h with -0.6 m/s²'),
        (Manoeuvre(70 * KM_H, 70 * KM_H), 'accelerate with full traction to 70 km/h'),
    ],
)
def test_words(manoeuvre: Manoeuvre, text: str) -> None:
    assert manoeuvre.text == text


def test_coasting_follows_the_resistance() -> None:
    run = plan_run(Manoeuvre(70 * KM_H, 50 * KM_H), FILE, DAVIS)
    assert run is not None
    coasting = [step for step in run.steps if step.traction == 0.0]
    # Mean deceleration at 60 km/h: w g / 1000 / (1 + gamma), and its duration over 20 km/h
    w = 2.0 + 0.02 * 60 * KM_H + 0.004 * (60 * KM_H) ** 2
    assert len(coasting) * STEP_S == pytest.approx(20 * KM_H / (w * 9.80665e-3 / 1.08), rel=0.08)
    assert run.steps[-1].speed == pytest.approx(50 * KM_H, abs=0.05)
    assert max(step.speed for step in run.steps) == pytest.approx(70 * KM_H, abs=0.8)


def test_a_held_speed_is_held() -> None:
    run = plan_run(Manoeuvre(50 * KM_H, 50 * KM_H, 60.0), FILE, DAVIS, force_scale=0.9)
    assert run is not None
    held = run.steps[-round(60.0 / STEP_S) + 5 :]
    assert all(step.speed == pytest.approx(50 * KM_H, abs=1.0) for step in held)
    braked, accelerated = (50 * KM_H) ** 2 / (2.0 * 0.6), (50 * KM_H) ** 2 / (2.0 * 0.9)
    assert run.length_m == pytest.approx(60.0 * 50 * KM_H + braked + accelerated, rel=0.1)


@pytest.mark.parametrize('brake', [Brake(), Brake(delay=3.3, time_constant=1.0), Brake(rate=0.7)])
def test_the_braking_takes_as_long_as_the_brake_of_the_train_file(brake: Brake) -> None:
    free = Davis(0.0, 0.0, 0.0)
    manoeuvre, file = Manoeuvre(60 * KM_H, 60 * KM_H), replace(FILE, brake=brake, resistance=free)
    run, sudden = (
        plan_run(manoeuvre, replace(file, brake=each), free) for each in (brake, Brake(delay=0.0, time_constant=0.0))
    )
    assert run is not None is not sudden
    v, lost_s = sudden.steps[-1].speed, brake.delay + brake.time_constant
    more = v * lost_s + 0.5 * v * v / 0.6 * (1.0 / brake.rate - 1.0)
    assert run.length_m - sudden.length_m == pytest.approx(more, abs=2.0 + 0.04 * more)
    assert run.duration_s - sudden.duration_s == pytest.approx(lost_s + v / 0.6 * (1.0 / brake.rate - 1.0), abs=1.0)


def test_a_drive_that_takes_too_long_is_not_planned() -> None:
    slow = replace(FILE, resistance=Davis(0.1, 0.0, 0.0))
    assert plan_run(Manoeuvre(70 * KM_H, 20 * KM_H), slow, slow.resistance) is None


def test_a_train_too_weak_for_the_speed_is_not_planned() -> None:
    weak = replace(FILE, train=replace(FILE.train, max_traction_power=10e3))
    assert plan_run(Manoeuvre(70 * KM_H, 50 * KM_H), weak, DAVIS) is None


def test_runs_fit_on_the_line() -> None:
    limited = replace(FILE, line=Line(stops=(0.0, 800.0, 2300.0), speed_limit=((0.0, 40 * KM_H), (500.0, 60 * KM_H))))
    assert top_speed(limited) == pytest.approx(60 * KM_H)
    runs = list(planned_runs(limited, DAVIS))
    assert runs
    assert all(run.length_m <= 1500.0 and run.manoeuvre.start <= 60 * KM_H + 1e-9 for run in runs)
    assert len(list(planned_runs(FILE, DAVIS))) > len(runs)


def test_nothing_is_learned_before_the_brake_is_released() -> None:
    run = plan_run(Manoeuvre(70 * KM_H, 50 * KM_H), FILE, DAVIS)
    assert run is not None
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
