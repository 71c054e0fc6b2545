# SPDX-License-Identifier: Apache-2.0
"""Fit of the brake to brakings made here by small steps, with laws and rates that the train file does not state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.brake_rate.brake_fit import (
    CHANGEOVER,
    DEAD_TIME,
    HOLD,
    LAG,
    RELEASE,
    RESPONSE,
    STEP,
    BrakeFit,
    Quantity,
    first_order,
    fit_brake,
    step_response,
)
from trainid_ros.brake_rate.braking import Braking
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.forces import BrakeCommandChange, CommandHistory, actuator_response
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

FILE = TrainFile(Train(mass=2e5), Davis(1.5, 0.03, 0.0008), Brake(delay=0.9, time_constant=0.9), Line(gradient_std=0.1))
STEP_S = 0.01
DELAY = 0.5
SAMPLE = 40  # steps, 2.5 Hz
RESISTANCE = 0.02  # m/s^2


def braking(seed: int, rate: Callable[[float], float], lags: tuple[float, ...], late: float = 0.0) -> Braking:
    """Return a braking after 3 s, with a second step, and released after 11 s."""
    rng = np.random.default_rng(seed)
    level = float(rng.uniform(0.5, 0.9))
    changes = [(3.0, -level), (8.0, -level - 0.2), (11.0, 0.0)]
    acts = [(t + DELAY + late * (u == 0.0), u) for t, u in changes]
    factor = 1.0 + 0.01 * float(rng.standard_normal())
    v, rows, stages = float(rng.uniform(14.0, 19.0)), [], [0.0] * len(lags)
    for i in range(round(24.0 / STEP_S)):
        now = i * STEP_S
        if v < 0.6:
            break
        if i % SAMPLE == 0:
            rows.append((now, v + 0.02 * float(rng.standard_normal())))
        value = next((u for t, u in reversed(acts) if t <= now), 0.0)
        for j, lag in enumerate(lags):
            stages[j] += (value - stages[j]) * STEP_S / lag
            value = stages[j]
        v += (rate(v) * factor * value - RESISTANCE) * STEP_S
    time, speed = np.array(rows).T.copy()
    none = np.zeros_like(time)
    return Braking(
        time, speed, none * math.nan, none, none + RESISTANCE, none, none, none + 1.0, 1, 0.02, tuple(changes)
    )


def fitted(count: int, rate: Callable[[float], float], lags: tuple[float, ...], **more: Any) -> BrakeFit:
    return fit_brake([braking(seed, rate, lags, **more) for seed in range(count)], FILE)


def check(fit: BrakeFit, name: str, true: float, most: float) -> None:
    """Check a value against the truth, and that its standard deviation is below a limit."""
    found = fit.find(name)
    assert abs(found.value - true) < 4.0 * found.std
    assert found.std < most


@pytest.fixture(scope='module')
def plain() -> BrakeFit:
    return fitted(4, lambda _: 0.9, (0.4,))


@pytest.fixture(scope='module')
def uneven() -> BrakeFit:
    return fitted(4, lambda v: 1.0 if v > 12.0 else 0.8, (1.0, 0.8), late=0.7)


def test_one_lag_is_found_where_the_file_is_wrong(plain: BrakeFit) -> None:
    check(plain, DEAD_TIME, 0.5, 0.05)
    check(plain, LAG, 0.4, 0.05)
    check(plain, RESPONSE, 0.9, 0.03)
    check(plain, RELEASE, 0.0, 0.06)
    check(plain, HOLD, 0.0, 0.05)
    assert (len(plain.lags), plain.brakings) == (1, 4)
    assert 'the data contradict the train file, 1.8 s, by ' in plain.find(RESPONSE).verdict


def test_a_rate_that_does_not_change_is_one_number(plain: BrakeFit) -> None:
    assert len(plain.knots) == 1
    assert abs(plain.rates[0] - 0.9) < 4.0 * math.sqrt(plain.covariance[0, 0])
    # The scatter from braking to braking is in the standard deviation.
    assert 0.003 < math.sqrt(plain.covariance[0, 0]) < 0.02


def test_two_lags_and_a_late_release_are_found(uneven: BrakeFit) -> None:
    assert len(uneven.lags) == 2
    # The first-order brake of the same area and spread.
    check(uneven, RESPONSE, 2.3, 0.1)
    check(uneven, LAG, math.hypot(1.0, 0.8), 0.2)
    check(uneven, RELEASE, 0.7, 0.2)


def test_a_changeover_is_found_at_its_speed(uneven: BrakeFit) -> None:
    check(uneven, CHANGEOVER, 12.0, 1.0)
    check(uneven, STEP, 0.2, 0.04)
    assert len(uneven.knots) > 1
    assert uneven.rates[[0, -1]] == pytest.approx([0.8, 1.0], abs=0.04)
    assert max(evidence for _, evidence in uneven.models) == 0.0


def test_without_brakings_there_is_no_answer() -> None:
    with pytest.raises(NoAnswerError, match='no braking'):
        fit_brake([], FILE)


def test_verdicts() -> None:
    known = Quantity(LAG, 0.4, 0.02, 's', stated=0.42, wanted=0.05)
    assert (known.is_told, known.verdict) == (True, 'the data tell: as in the train file, 0.42 s')
    unknown = replace(known, std=0.1)
    assert (unknown.is_told, unknown.verdict) == (False, 'the data cannot tell: its std would have to be below 0.05 s')
    assert replace(known, stated=math.nan).verdict == 'the data tell'
    # A train file that is too sure of a wrong value is contradicted.
    wrong = replace(known, value=0.9, std=0.06)
    assert (wrong.is_told, 'by 8.0 std' in wrong.verdict) == (True, True)


def test_the_response_is_that_of_the_actuator() -> None:
    commands = CommandHistory((BrakeCommandChange(0, -1.0),))
    for lag in (0.0, 0.4):
        at = np.array([0.3, 0.7, 2.0])
        exact = [
            actuator_response(commands, 0, round(t * NS_PER_S), 0.0, delay_ns=300_000_000, time_constant=lag)[1]
            for t in at
        ]
        assert -step_response(at - 0.3, (lag,)) == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize('lags', [(0.9, 0.3), (0.5, 0.5), (0.5, 0.0)])
def test_two_lags_respond_as_one_after_the_other(lags: tuple[float, float]) -> None:
    dt, total, stages = 1e-3, 0.0, [0.0, 0.0]
    for _ in range(2000):
        value = 1.0
        for j, lag in enumerate(lags):
            stages[j] = value if lag == 0.0 else stages[j] + (value - stages[j]) * -math.expm1(-dt / lag)
            value = stages[j]
        total += value * dt
    assert step_response(np.array([2.0]), lags)[0] == pytest.approx(total, abs=3e-3)


def test_the_first_order_brake_has_the_same_area_and_spread() -> None:
    delay, lag, response = first_order(np.array([0.5, 0.2, 0.6, 0.8]))
    assert lag == pytest.approx(1.0)
    assert response == pytest.approx(0.5 + 0.6 + 0.8)
    assert delay + lag == pytest.approx(response)
