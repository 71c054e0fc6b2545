# SPDX-License-Identifier: Apache-2.0
"""Each world has a train file that can be driven, and its driver stops at the stations."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import SpeedRecord
from trainid_ros.sim.scenario import Scenario, Simulation, simulate
from trainid_ros.sim.worlds import UNKNOWNS, WORLDS, find_world, make_case, usual_duration, world_train

STOP_ERROR_M = {'freight': 4.5}


def field_day(name: str, runs: int, seed: int) -> Simulation:
    world, rng = WORLDS[name], np.random.default_rng(seed)
    case = make_case(world, world_train(world), UNKNOWNS, runs, rng.spawn(1)[0])
    return simulate(case.scenario, rng)


def stop_error(simulation: Simulation) -> float:
    return max(abs(arrival.error) for arrival in simulation.arrivals)


def test_there_are_five_worlds() -> None:
    assert tuple(WORLDS) == ('metro', 'emu', 'high_speed', 'freight', 'tram')
    with pytest.raises(InputError, match=r"world 'trm' is not known; did you mean 'tram'\?"):
        find_world('trm')


@pytest.mark.parametrize('name', WORLDS)
def test_train_files_have_all_fields_that_the_simulator_needs(name: str) -> None:
    file = world_train(find_world(name))
    assert len(file.line.stops) >= 3
    assert file.line.gradient
    assert file.line.speed_limit
    assert file.line.curve or name == 'metro'


def test_the_freight_train_has_a_slow_brake() -> None:
    brake = world_train(WORLDS['freight']).brake
    assert (brake.delay, brake.time_constant) == (3.0, 4.0)


def test_the_resistance_of_the_emu_has_half_the_quadratic_term_of_its_source() -> None:
    file = world_train(WORLDS['emu'])
    newton = file.resistance.c * file.train.mass * 9.80665 / 1000.0
    assert newton == pytest.approx(0.5 * 0.00093264e3 * 3.6**2, rel=1e-4)


def test_usual_duration_includes_the_way_back() -> None:
    world = WORLDS['metro']
    dwell = 28.5
    assert usual_duration(world, (0.0, 1400.0, 1680.0), 1) == pytest.approx(100.0 + dwell)
    assert usual_duration(world, (0.0, 1400.0, 1680.0), 4) == pytest.approx(240.0 + 4 * dwell)
    assert usual_duration(world, (), 4) == 0.0


@pytest.mark.parametrize('name', ['tram', 'freight'])
def test_the_trains_hardest_to_drive_stop_at_stations(name: str) -> None:
    runs = {'tram': 2, 'freight': 1}[name]
    simulation = field_day(name, runs, seed=1)
    assert len(simulation.arrivals) == runs
    assert stop_error(simulation) < STOP_ERROR_M.get(name, 2.0)


def test_a_clean_world_is_its_train_file_driven_by_its_driver() -> None:
    world = WORLDS['tram']
    case = make_case(world, world_train(world), (), 1, np.random.default_rng(5))
    plain = Scenario(world_train(world), 1, passengers=world.passengers, driver=world.driver)
    here = simulate(case.scenario, np.random.default_rng(1)).arrivals
    assert here == simulate(plain, np.random.default_rng(1)).arrivals


@pytest.mark.slow
@pytest.mark.parametrize('name', WORLDS)
def test_days_are_completed_from_stop_to_stop(name: str) -> None:
    world = WORLDS[name]
    stops = world_train(world).line.stops
    runs = {'metro': 6, 'emu': 4, 'high_speed': 2, 'freight': 2, 'tram': 15}[name]
    for seed in range(2):
        simulation = field_day(name, runs, seed)
        assert len(simulation.arrivals) == runs
        assert stop_error(simulation) < STOP_ERROR_M.get(name, 2.0)
        assert simulation.duration_s == pytest.approx(usual_duration(world, stops, runs), rel=0.2)
        # All changes happen within the day, regardless of its length.
        assert len(simulation.truth.resistance) in (2, 3)
        assert len(simulation.truth.brake_rate) in (2, 3)
        fastest = max(r.speed for r in simulation.records if isinstance(r, SpeedRecord))
        assert fastest > 0.6 * world_train(world).train.max_speed
