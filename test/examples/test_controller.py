# SPDX-License-Identifier: Apache-2.0
"""The controller on a simulated train."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ato.controller import Ato, AtoModel
from ato.knowledge import StatedValues, TrueValues
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import BrakeRecord, SpeedRecord
from trainid_ros.sim.plant import Decision, Plant
from trainid_ros.sim.scenario import Scenario, Simulation, simulate
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

LINE = Line(
    stops=(0.0, 700.0, 1500.0),
    gradient=((0.0, 0.0), (900.0, -15.0)),
    speed_limit=((0.0, 18.0), (300.0, 10.0), (500.0, 18.0)),
)
FILE = TrainFile(Train(mass=200e3, length=100.0), Davis(2.0, 0.0, 0.008), Brake(), LINE)


@cache
def driven(rate: float, *, knows: bool, **model: float) -> Simulation:
    true = replace(FILE, brake=replace(FILE.brake, rate=rate))
    profile = LineProfile(FILE.line, FILE.train.length)

    def make(plant: Plant, rng: np.random.Generator) -> Ato:
        return Ato(AtoModel(**model), FILE, profile, TrueValues(true, plant) if knows else StatedValues(FILE), rng)

    return simulate(Scenario(true, runs=4, stated=FILE), np.random.default_rng(3), make)


@pytest.mark.parametrize('rate', [0.75, 1.0, 1.2])
def test_it_stops_in_place_if_it_knows_the_brake(rate: float) -> None:
    errors = [arrival.error for arrival in driven(rate, knows=True).arrivals]
    assert len(errors) == 4
    assert max(map(abs, errors)) < 0.2


def test_it_stops_too_late_if_the_brake_is_weaker_than_it_knows() -> None:
    errors = [arrival.error for arrival in driven(0.7, knows=False).arrivals]
    assert min(errors) > 0.0
    assert np.median(errors) > 1.0


def test_it_keeps_the_speed_limits() -> None:
    profile = LineProfile(FILE.line, FILE.train.length)
    simulation = driven(1.0, knows=True)
    first = simulation.arrivals[0].time_s
    speeds = [record for record in simulation.records if isinstance(record, SpeedRecord)]
    speeds = [record for record in speeds if (record.stamp_ns - speeds[0].stamp_ns) / 1e9 < first]
    assert max(record.speed for record in speeds) > 14.0
    assert all(record.speed < profile.speed_limit(record.position, 1) for record in speeds)


def test_it_regulates_to_the_speed_allowed_whatever_the_resistance() -> None:
    line = Line(stops=(0.0, 3000.0), speed_limit=((0.0, 10.0),))
    file = replace(FILE, line=line)
    true = replace(file, resistance=Davis(16.0, 0.0, 0.008))

    def make(_: Plant, rng: np.random.Generator) -> Ato:
        return Ato(AtoModel(speed_margin=0.0), file, LineProfile(line, 100.0), StatedValues(file), rng)

    simulation = simulate(Scenario(true, runs=1, stated=file), np.random.default_rng(3), make)
    speeds = [record for record in simulation.records if isinstance(record, SpeedRecord)]
    settled = [record.speed for record in speeds if 2200.0 < record.position < 2800.0]
    # Without integral action it would be slower by the error of 14 N/kN over the gain, 0.3 m/s.
    assert np.mean(settled) == pytest.approx(10.0, abs=0.15)


def test_brake_commands_change_by_one_step_at_a_time() -> None:
    records = driven(1.0, knows=True, brake_step=0.15).records
    given = np.array([record.target_acceleration for record in records if isinstance(record, BrakeRecord)])
    assert np.abs(np.diff(given)).max() == pytest.approx(0.15)
    assert np.abs(given / 0.15 - np.round(given / 0.15)).max() < 1e-6
    assert given.min() >= -1.1 - 1e-9


@pytest.mark.parametrize('gradient', [-30.0, 0.0, 30.0])
def test_there_is_no_traction_before_the_brake_is_released(gradient: float) -> None:
    line = replace(LINE, gradient=((0.0, gradient), (900.0, -gradient)))
    file = replace(FILE, train=replace(FILE.train, max_traction_force=200e3), line=line)
    ato: list[Recorded] = []

    def make(plant: Plant, rng: np.random.Generator) -> Recorded:
        ato.append(Recorded(AtoModel(), file, LineProfile(line, 100.0), TrueValues(file, plant), rng))
        return ato[0]

    simulation = simulate(Scenario(file, runs=2, stated=file), np.random.default_rng(3), make)
    assert len(simulation.arrivals) == 2
    given = ato[0].given
    assert max(decision.traction for decision in given) > 100e3
    assert not [decision for decision in given if decision.traction > 0.0 and decision.brake < 0.0]


class Recorded(Ato):
    """A controller that keeps what it demands."""

    def decide(self, time_s: float, train: Plant) -> Decision:
        decision = super().decide(time_s, train)
        self.given = [*getattr(self, 'given', []), decision]
        return decision


def test_the_aim_may_lie_beside_the_stop() -> None:
    profile = LineProfile(FILE.line, FILE.train.length)

    def make(plant: Plant, rng: np.random.Generator) -> Ato:
        return Ato(AtoModel(), FILE, profile, TrueValues(FILE, plant), rng, lambda: 1.0)

    simulation = simulate(Scenario(FILE, runs=2, stated=FILE), np.random.default_rng(3), make)
    assert [arrival.error for arrival in simulation.arrivals] == pytest.approx([1.0, 1.0], abs=0.2)


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match='brake_step'):
        driven(1.0, knows=True, brake_step=0.0)
