# SPDX-License-Identifier: Apache-2.0
"""The driver alone: settings, dwell, traction limits and the braking curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.sim.plant import Driver, DriverModel, Phase, Plant
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

FILE = TrainFile(Train(200e3), Davis(1.5, 0.03, 0.004), Brake(), Line(stops=(0.0, 2000.0)))
PROFILE = LineProfile(FILE.line, FILE.train.length)


def driver(**settings: float) -> Driver:
    return Driver(replace(DriverModel(), **settings), FILE, PROFILE, np.random.default_rng(1))


def test_the_train_is_held_until_the_dwell_is_over() -> None:
    ato, train = driver(dwell_low=20.0, dwell_high=20.0), Plant(FILE, PROFILE, 1, 0.8)
    decision = ato.decide(0.0, train)
    assert (decision.traction, decision.brake) == (0.0, -0.6)
    assert not ato.may_depart(9.9)
    assert ato.may_depart(10.0)


def test_traction_stays_within_force_and_power() -> None:
    ato, train = driver(), Plant(FILE, PROFILE, 1, 0.8)
    ato.depart(2000.0)
    train.speed, train.position = 18.0, 300.0
    decision = ato.decide(20.0, train)
    assert ato.phase is Phase.POWER
    assert decision.traction == pytest.approx(3.1e6 / 18.0)
    train.speed = 1.0
    # At low speed 0.9 m/s^2 on 216 t and the resistance need less than the available 310 kN.
    assert ato.decide(20.2, train).traction == pytest.approx(0.9 * 216e3 + 1.534 * 200 * 9.80665)


def phase_at(left: float) -> Phase:
    ato, train = driver(), Plant(FILE, PROFILE, 1, 0.8)
    ato.depart(2000.0)
    train.speed, train.position = 15.0, 2000.0 - left
    ato.decide(100.0, train)
    return ato.phase


def test_braking_starts_on_the_curve_before_the_stop() -> None:
    # Braking from 15 m/s at 0.65 m/s^2 takes 173 m, plus 15 m for dead time and lag.
    assert phase_at(200.0) is Phase.POWER
    assert phase_at(180.0) is Phase.BRAKE


def test_a_setting_out_of_range_is_rejected() -> None:
    with pytest.raises(InputError, match='jerk = 0 '):
        driver(jerk=0.0)


@pytest.mark.parametrize(('window', 'phase'), [(1.0, Phase.POWER), (4.0, Phase.DWELL)])
def test_a_stationary_train_within_the_stop_window_has_arrived(window: float, phase: Phase) -> None:
    ato, train = driver(stop_window=window), Plant(FILE, PROFILE, 1, 0.8)
    ato.depart(2000.0)
    train.position = 1997.0
    ato.decide(100.0, train)
    assert ato.phase is phase
