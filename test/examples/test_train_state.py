# SPDX-License-Identifier: Apache-2.0
"""Speed and position as a controller knows them."""

from __future__ import annotations

import numpy as np
import pytest

from ato.train_state import PositionModel, TrainState, stopping_curve
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, GradientRecord, SpeedRecord
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Line

LINE = Line(stops=(0.0, 1000.0), gradient=((0.0, 0.0), (500.0, 10.0)))


def train_state(**model: float) -> TrainState:
    return TrainState(PositionModel(**model), LineProfile(LINE, 100.0), np.random.default_rng(1))


def test_the_speed_follows_its_measurements_and_learns_what_is_not_explained() -> None:
    state, true, now_ns = train_state(), 10.0, NS_PER_S
    state.speed = 10.0
    for _ in range(400):
        state.predict(-0.1 + state.unexplained, now_ns, 0.2)
        now_ns += NS_PER_S // 5
        true += -0.02 * 0.2
        state.measure_speed(SpeedRecord(now_ns, true, 0.0))
    assert state.speed == pytest.approx(true, abs=0.01)
    assert state.unexplained == pytest.approx(0.08, abs=0.005)


def test_a_measurement_counts_at_its_stamp() -> None:
    state = train_state()
    state.speed = 10.0
    state.predict(-1.0, NS_PER_S, 0.2)
    state.measure_speed(SpeedRecord(NS_PER_S + NS_PER_S // 10, 9.9, 0.0))
    assert state.speed == pytest.approx(9.8)
    assert state.unexplained == pytest.approx(0.0)


def test_a_wheel_that_gives_no_pulses_stands() -> None:
    state = train_state()
    state.speed = 0.3
    state.measure_speed(SpeedRecord(NS_PER_S, 0.0, 0.0))
    assert state.speed == 0.0


def test_a_balise_corrects_the_position_once() -> None:
    state = train_state(balise_std=0.0)
    state.stand(700.0, 1)
    state.position = 845.0
    state.pass_balises(1000.0, 849.9)
    assert state.position == 845.0
    state.position = 845.0
    state.pass_balises(1000.0, 850.1)
    assert state.position == 850.1
    state.position = 860.0
    state.pass_balises(1000.0, 861.0)
    assert state.position == 860.0


def test_the_error_of_the_map_reaches_ahead() -> None:
    state = train_state()
    state.position = 300.0
    state.measure_gradient(GradientRecord(NS_PER_S, 2.0, 0.0, False))
    assert state.gradient() == pytest.approx(2.0)
    assert state.gradient(400.0) == pytest.approx(12.0)


def test_a_stopping_curve() -> None:
    assert stopping_curve(50.0, 1.0) == pytest.approx(10.0)
    assert stopping_curve(-1.0, 1.0) == 0.0


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match='speed_gain'):
        train_state(speed_gain=2.0)
