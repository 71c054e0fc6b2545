# SPDX-License-Identifier: Apache-2.0
"""Each world can be driven; each unknown makes its records differ from the train file in its own way and size."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, MassRecord, SpeedRecord
from trainid_ros.sim.plant import GustModel
from trainid_ros.sim.scenario import Scenario, SensorModel, Simulation, simulate
from trainid_ros.sim.worlds import (
    REALISMS,
    UNKNOWNS,
    WORLDS,
    Case,
    Unknowns,
    draw_unknowns,
    find_world,
    make_case,
    unknowns_of,
    usual_duration,
    world_train,
)
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import (
    BrakeCommandChange,
    CommandHistory,
    davis,
    lag_response,
    specific_force,
    specific_inertia,
)
from trainid_ros.train.train_file import Brake, TrainFile, dump_train_file

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
@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.long)])
def test_days_are_completed_from_stop_to_stop(name: str, seed: int) -> None:
    world = WORLDS[name]
    stops = world_train(world).line.stops
    runs = {'metro': 6, 'emu': 4, 'high_speed': 2, 'freight': 2, 'tram': 15}[name]
    simulation = field_day(name, runs, seed)
    assert len(simulation.arrivals) == runs
    assert stop_error(simulation) < STOP_ERROR_M.get(name, 2.0)
    assert simulation.duration_s == pytest.approx(usual_duration(world, stops, runs), rel=0.2)
    # All changes happen within the day, regardless of its length.
    assert len(simulation.truth.resistance) in (2, 3)
    assert len(simulation.truth.brake_rate) in (2, 3)
    fastest = max(r.speed for r in simulation.records if isinstance(r, SpeedRecord))
    assert fastest > 0.6 * world_train(world).train.max_speed


TRAM = WORLDS['tram']
FILE = world_train(TRAM)
Floats = NDArray[np.float64]


def case_of(names: Collection[str], seed: int = 1, runs: int = 2) -> Case:
    return make_case(TRAM, FILE, names, runs, np.random.default_rng(seed))


def noiseless(case: Case) -> Simulation:
    """Simulate a case with only the errors of its unknowns: no noise, no gusts."""
    sensors = replace(
        case.scenario.sensors,
        speed_noise=0.0,
        speed_quantum=0.0,
        force_noise=0.0,
        force_noise_relative=0.0,
        position_drift=0.0,
        mass_noise=0.0,
        stamp_jitter=0.0,
    )
    return simulate(replace(case.scenario, sensors=sensors, gust=GustModel(std=0.0)), np.random.default_rng(2))


class Balance(NamedTuple):
    """Residual of the specific balance with traction and curvature, shapes (n,)."""

    residual: Floats
    traction: Floats
    curvature: Floats


def balance(simulation: Simulation, stated: TrainFile) -> Balance:
    """Evaluate the specific balance with the stated train file, without braking and at steady force."""
    speeds = [r for r in simulation.records if isinstance(r, SpeedRecord)]
    forces = [r for r in simulation.records if isinstance(r, ForceRecord)]
    tracks = [r for r in simulation.records if isinstance(r, GradientRecord)]
    brakes = [r for r in simulation.records if isinstance(r, BrakeRecord)]
    masses = [r.mass for r in simulation.records if isinstance(r, MassRecord)]
    coefficient = effect_value(stated.effects, 'curve_resistance', 'coefficient', 0.0)
    rows, idle = [], 0
    for i in range(1, len(speeds) - 1):
        idle = 0 if brakes[i].target_acceleration < 0.0 else idle + 1
        force, mass = forces[i].force, masses[i // 5]
        if idle < 20 or abs(forces[i + 1].force - forces[i - 1].force) > 500.0 or speeds[i - 1].speed < 2.0:
            continue
        a = (speeds[i + 1].speed - speeds[i - 1].speed) / 0.4
        curvature = 1.0 / tracks[i].curve_radius if tracks[i].curve_radius > 0.0 else 0.0
        known = davis(stated.resistance, speeds[i].speed) + tracks[i].gradient + coefficient * curvature
        residual = specific_force(force, mass) - specific_inertia(a, stated.train.rotary_mass) - known
        rows.append((residual, specific_force(force, mass), curvature))
    return Balance(*np.array(rows).T)


def slope(residual: Floats, against: Floats) -> float:
    return float(np.polyfit(against, residual, 1)[0])


@pytest.fixture(scope='module')
def clean() -> Simulation:
    return noiseless(case_of(()))


def test_clean_is_exact(clean: Simulation) -> None:
    case = case_of(())
    residual = balance(clean, case.stated).residual
    assert len(residual) > 60
    # Central differences and the 20 ms between force and speed leave errors of a few 0.01 N/kN, more on steep slopes.
    assert abs(np.mean(residual)) < 0.03
    assert np.std(residual) < 0.15
    assert case.scenario.train_file.effects == FILE.effects
    assert case.scenario.sensors == SensorModel(map_error=0.0)
    assert case.scenario.gust == GustModel()
    assert case.scenario.changes == ()


def test_clean_changes_only_the_stated_standard_deviations() -> None:
    stated = case_of(()).stated
    assert (stated.train.mass_std, stated.train.force_std, stated.line.gradient_std) == (0.002, 0.0, 0.0)
    assert stated.brake.timing_std == 0.01
    assert all(dict(effect.std) == {'coefficient': 0.0} for effect in stated.effects)
    effects = tuple(replace(effect, std=()) for effect in stated.effects)
    assert replace(stated, train=FILE.train, brake=FILE.brake, line=FILE.line, effects=effects) == FILE


def test_a_wrong_mass_gives_a_residual_proportional_to_traction(clean: Simulation) -> None:
    case = case_of(['mass'])
    ratio = dict(case.true_values)['mass_ratio']
    found = balance(noiseless(case), case.stated)
    assert abs(ratio - 1.0) > 0.005
    assert slope(found.residual, found.traction) == pytest.approx(1.0 - 1.0 / ratio, abs=0.002)
    assert 0.02 <= case.stated.train.mass_std <= 0.05
    # The weighed and reported mass remains the stated one.
    weighed = [[r.mass for r in s.records if isinstance(r, MassRecord)] for s in (noiseless(case), clean)]
    assert weighed[0][:100] == weighed[1][:100]


def test_a_wrong_force_gain_gives_a_residual_proportional_to_traction() -> None:
    case = case_of(['force_gain'])
    ratio = dict(case.true_values)['force_ratio']
    found = balance(noiseless(case), case.stated)
    assert abs(ratio - 1.0) > 0.005
    assert slope(found.residual, found.traction) == pytest.approx(1.0 - ratio, abs=0.002)
    assert 0.01 <= case.stated.train.force_std <= 0.03


def test_a_wrong_curve_coefficient_gives_a_residual_proportional_to_curvature() -> None:
    case = case_of(['curve'])
    wrong = dict(case.true_values)['curve_coefficient'] - 400.0
    found = balance(noiseless(case), case.stated)
    assert abs(wrong) > 10.0
    assert slope(found.residual, found.curvature) == pytest.approx(wrong, abs=12.0)
    assert dict(case.stated.effects[0].std) == {'coefficient': 80.0}


def test_late_force_has_later_stamps_and_the_same_values(clean: Simulation) -> None:
    case = case_of(['force_delay'])
    delay_ns = round(dict(case.true_values)['force_delay'] * NS_PER_S)
    here = [r for r in noiseless(case).records if isinstance(r, ForceRecord)]
    there = [r for r in clean.records if isinstance(r, ForceRecord)]
    assert [r.force for r in here] == [r.force for r in there]
    assert {a.stamp_ns - b.stamp_ns for a, b in zip(here, there, strict=True)} == {delay_ns}
    assert 0 < delay_ns <= 300_000_000


def test_a_wrong_wheel_diameter_scales_the_measured_speed(clean: Simulation) -> None:
    case = case_of(['wheels'])
    ratio = dict(case.true_values)['wheel_ratio']
    here = np.array([r.speed for r in noiseless(case).records if isinstance(r, SpeedRecord)])
    there = np.array([r.speed for r in clean.records if isinstance(r, SpeedRecord)])
    assert 0.0 < abs(ratio - 1.0) <= 0.005
    np.testing.assert_allclose(here, ratio * there, rtol=1e-12)


def test_the_map_error_has_the_stated_standard_deviation(clean: Simulation) -> None:
    case = case_of(['map'])
    here, there = ([r.gradient for r in s.records if isinstance(r, GradientRecord)] for s in (noiseless(case), clean))
    error = np.array(here) - np.array(there)
    std = dict(case.true_values)['map_std']
    assert case.stated.line.gradient_std == std
    # 850 m contain only a few independent errors.
    assert 0.3 * std < np.sqrt(np.mean(error**2)) < 2.0 * std
    assert 0.1 <= std <= 0.5
    assert 100.0 <= case.scenario.sensors.map_error_length <= 500.0


def test_gusts_have_the_true_parameters() -> None:
    case = case_of(['gusts'])
    gust, values = case.scenario.gust, dict(case.true_values)
    assert (gust.std, gust.time_constant) == (values['gust_std'], values['gust_time_constant'])
    assert 0.1 <= gust.std <= 0.4
    assert 3.0 <= gust.time_constant <= 12.0


def test_speeds_are_multiples_of_the_quantum() -> None:
    case = case_of(['quantum'], runs=1)
    quantum = dict(case.true_values)['speed_quantum']
    records = simulate(case.scenario, np.random.default_rng(2)).records
    speeds = np.array([r.speed for r in records if isinstance(r, SpeedRecord)]) / quantum
    assert 0.1 <= 3.6 * quantum <= 0.5
    np.testing.assert_allclose(speeds, np.round(speeds), atol=1e-9)


def reported_brake(simulation: Simulation, brake: Brake) -> tuple[Floats, Floats]:
    """Return the braking force over the inertia, as reported and as computed from the commands [m/s^2]."""
    commands, pairs, output, last_ns, mass = CommandHistory(), [], 0.0, simulation.truth.start_ns, 0.0
    delay_ns = round(brake.delay * NS_PER_S)
    for record in simulation.records:
        if isinstance(record, BrakeRecord):
            commands.push(BrakeCommandChange(record.stamp_ns, record.target_acceleration))
        elif isinstance(record, MassRecord):
            mass = record.mass
        elif isinstance(record, ForceRecord):
            for duration, target in commands.segments(last_ns - delay_ns, record.stamp_ns - delay_ns):
                output = lag_response(output, target, brake.time_constant, duration)
            last_ns = record.stamp_ns
            if record.force < 0.0:
                pairs.append((record.force / mass / (1.0 + FILE.train.rotary_mass), output))
    reported, computed = np.array(pairs).T
    return reported, computed


def test_dead_time_and_lag_of_the_brake_differ_from_the_stated_ones() -> None:
    case = case_of(['brake'])
    values, simulation = dict(case.true_values), noiseless(case)
    true = replace(FILE.brake, delay=values['brake_delay'], time_constant=values['brake_time_constant'])
    reported, computed = reported_brake(simulation, true)
    # Except for the moments at departure when traction starts before the brake is released.
    assert np.mean(np.abs(reported - computed) < 1e-9) > 0.98
    reported, stated = reported_brake(simulation, FILE.brake)
    assert np.mean(np.abs(reported - stated) > 0.01) > 0.05
    assert case.stated.brake == replace(FILE.brake, timing_std=0.2)
    assert abs(true.delay - FILE.brake.delay) <= 0.3
    assert 0.7 <= true.time_constant / FILE.brake.time_constant <= 1.3


def test_resistance_and_brake_rate_change_during_the_day() -> None:
    case = case_of(['changes'])
    truth = noiseless(case).truth
    assert len(truth.resistance) in (2, 3)
    assert len(truth.brake_rate) in (2, 3)
    assert truth.resistance[0][1:] == (FILE.resistance.a, FILE.resistance.b, FILE.resistance.c)
    for _, a, b, c in truth.resistance[1:]:
        assert 0.1 <= abs(a / FILE.resistance.a - 1.0) <= 0.3
        assert 0.05 <= abs(c / FILE.resistance.c - 1.0) <= 0.2
        assert b == FILE.resistance.b
    assert all(0.05 <= abs(rate - 1.0) <= 0.2 for _, rate in truth.brake_rate[1:])


def test_the_stated_resistance_differs_from_the_true_one() -> None:
    case = case_of(['resistance'], runs=1)
    _, a, b, c = noiseless(case).truth.resistance[0]
    stated = case.stated.resistance
    ratios = np.array([a / stated.a, b / stated.b, c / stated.c])
    assert np.all((ratios >= 0.8) & (ratios <= 1.2) & (ratios != 1.0))
    assert stated == FILE.resistance


def test_an_unknown_has_the_same_value_alone_and_among_all() -> None:
    field = draw_unknowns(UNKNOWNS, np.random.default_rng(3))
    assert field == draw_unknowns(UNKNOWNS, np.random.default_rng(3))
    assert field != draw_unknowns(UNKNOWNS, np.random.default_rng(4))
    assert draw_unknowns(['wheels'], np.random.default_rng(3)) == Unknowns(wheel_ratio=field.wheel_ratio)
    assert draw_unknowns((), np.random.default_rng(3)) == Unknowns()


@pytest.mark.parametrize('name', UNKNOWNS)
def test_each_unknown_changes_something(name: str) -> None:
    assert draw_unknowns([name], np.random.default_rng(3)) != Unknowns()


def test_errors_have_the_stated_standard_deviation() -> None:
    drawn = [draw_unknowns(['mass', 'force_gain', 'curve'], np.random.default_rng(seed)) for seed in range(300)]
    for std, ratio in (('mass_std', 'mass_ratio'), ('force_std', 'force_ratio'), ('curve_std', 'curve_ratio')):
        scores = np.array([(getattr(u, ratio) - 1.0) / getattr(u, std) for u in drawn])
        assert np.std(scores) == pytest.approx(1.0, abs=0.15)
        assert np.abs(scores).max() < 3.0 + 1e-9


def test_the_stated_file_differs_from_the_given_one_only_in_standard_deviations() -> None:
    stated = case_of(UNKNOWNS).stated
    effects = tuple(replace(effect, std=()) for effect in stated.effects)
    assert replace(stated, train=FILE.train, brake=FILE.brake, line=FILE.line, effects=effects) == FILE
    assert case_of(UNKNOWNS).scenario.stated == stated
    assert 'mass_std' in dump_train_file(stated)


def test_each_realism_has_its_unknowns() -> None:
    assert unknowns_of('clean', (), FILE) == frozenset()
    assert unknowns_of('field', (), FILE) == frozenset(UNKNOWNS) == REALISMS['field']
    assert unknowns_of('clean', ('mass', 'wheels'), FILE) == {'mass', 'wheels'}


@pytest.mark.parametrize(
    ('realism', 'names', 'message'),
    [
        ('feild', (), "realism 'feild' is not known; did you mean 'field'?"),
        ('clean', ('weels',), "unknown 'weels' is not known; did you mean 'wheels'?"),
        ('clean', ('curve',), 'unknown curve: the train file has no line.curve'),
    ],
)
def test_an_invalid_realism_or_unknown_is_named(realism: str, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError) as caught:
        unknowns_of(realism, names, world_train(WORLDS['metro']))
    assert message in str(caught.value)
