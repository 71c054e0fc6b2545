# SPDX-License-Identifier: Apache-2.0
"""Each world can be driven; each unknown makes its records differ from the train file in its own way and size.

A train of a fleet is the same on all days; its faults act from their day on, beside its own errors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from test.sim.test_scenario import EXACT, balance, of
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    DAY_NS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    SpeedRecord,
)
from trainid_ros.sim.plant import GustModel
from trainid_ros.sim.scenario import Scenario, SensorModel, Simulation, simulate
from trainid_ros.sim.worlds import (
    REALISMS,
    UNKNOWNS,
    WORLDS,
    Case,
    Fleet,
    Unknowns,
    draw_day,
    draw_train,
    draw_unknowns,
    drive,
    find_world,
    make_case,
    parse_fault,
    unknowns_of,
    usual_duration,
    world_train,
)
from trainid_ros.train.forces import BrakeActuator, BrakeCommandChange
from trainid_ros.train.train_file import Brake

STOP_ERROR_M = {'freight': 4.5}


def field_day(name: str, runs: int, seed: int) -> Simulation:
    """Simulate a day with all unknowns on which the train makes its stops."""
    world, rng = WORLDS[name], np.random.default_rng(seed)
    case = make_case(world, world_train(world), UNKNOWNS, runs, rng.spawn(1)[0])
    simulation = simulate(case.scenario, rng)
    assert len(simulation.arrivals) == runs
    assert max(abs(arrival.error) for arrival in simulation.arrivals) < STOP_ERROR_M.get(name, 2.0)
    return simulation


def test_the_train_files_of_the_five_worlds() -> None:
    assert tuple(WORLDS) == ('metro', 'emu', 'high_speed', 'freight', 'tram')
    with pytest.raises(InputError, match=r"world 'trm' is not known; did you mean 'tram'\?"):
        find_world('trm')
    for name in WORLDS:
        file = world_train(find_world(name))
        assert len(file.line.stops) >= 3
        assert file.line.gradient
        assert file.line.speed_limit
        assert file.line.curve or name == 'metro'
    brake, emu = world_train(WORLDS['freight']).brake, world_train(WORLDS['emu'])
    assert (brake.delay, brake.time_constant) == (3.0, 4.0)  # slow
    # The EMU has half the quadratic term of its source.
    newton = emu.resistance.c * emu.train.mass * 9.80665 / 1000.0
    assert newton == pytest.approx(0.5 * 0.00093264e3 * 3.6**2, rel=1e-4)


def test_usual_duration_includes_the_way_back() -> None:
    world = WORLDS['metro']
    dwell = 28.5
    assert usual_duration(world, (0.0, 1400.0, 1680.0), 1) == pytest.approx(100.0 + dwell)
    assert usual_duration(world, (0.0, 1400.0, 1680.0), 4) == pytest.approx(240.0 + 4 * dwell)
    assert usual_duration(world, (), 4) == 0.0


@pytest.mark.parametrize(('name', 'runs'), [('tram', 2), ('freight', 1)])
def test_the_trains_hardest_to_drive_stop_at_stations(name: str, runs: int) -> None:
    field_day(name, runs, seed=1)


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
    assert simulation.duration_s == pytest.approx(usual_duration(world, stops, runs), rel=0.2)
    # All changes happen within the day, regardless of its length.
    assert len(simulation.truth.resistance) in (2, 3)
    assert len(simulation.truth.brake_rate) in (2, 3)
    assert max(record.speed for record in of(SpeedRecord, simulation)) > 0.6 * world_train(world).train.max_speed


TRAM = WORLDS['tram']
FILE = world_train(TRAM)
Floats = NDArray[np.float64]


def case_of(names: Collection[str], seed: int = 1, runs: int = 2) -> Case:
    return make_case(TRAM, FILE, names, runs, np.random.default_rng(seed))


def noiseless(case: Case) -> Simulation:
    """Simulate a case with only the errors of its unknowns: no noise, no gusts."""
    drawn = case.scenario.sensors
    errors = {key: getattr(drawn, key) for key in ('wheel_ratio', 'map_error', 'map_error_length', 'force_delay')}
    quiet = replace(case.scenario, sensors=replace(EXACT, **errors), gust=GustModel(std=0.0))
    return simulate(quiet, np.random.default_rng(2))


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


@pytest.mark.parametrize(
    ('unknown', 'key', 'place', 'error', 'least', 'tolerance'),
    [
        ('mass', 'mass_ratio', 1, lambda ratio: 1.0 - 1.0 / ratio, 0.005, 0.002),  # of the traction
        ('force_gain', 'force_ratio', 1, lambda ratio: 1.0 - ratio, 0.005, 0.002),
        ('curve', 'curve_coefficient', 2, lambda coefficient: coefficient - 400.0, 10.0, 12.0),  # of the curvature
    ],
)
def test_a_wrong_value_gives_a_residual_in_proportion(
    unknown: str, key: str, place: int, error: Callable[[float], float], least: float, tolerance: float
) -> None:
    case = case_of([unknown])
    found, expected = balance(noiseless(case), case.stated), error(dict(case.true_values)[key])
    assert abs(expected) > least
    assert np.polyfit(found[place], found.residual, 1)[0] == pytest.approx(expected, abs=tolerance)


def test_the_stated_standard_deviations_are_those_of_the_errors(clean: Simulation) -> None:
    case = case_of(['mass'])
    assert 0.02 <= case.stated.train.mass_std <= 0.05
    assert 0.01 <= case_of(['force_gain']).stated.train.force_std <= 0.03
    assert dict(case_of(['curve']).stated.effects[0].std) == {'coefficient': 80.0}
    # The weighed and reported mass remains the stated one.
    weighed = [[record.mass for record in of(MassRecord, day)][:100] for day in (noiseless(case), clean)]
    assert weighed[0] == weighed[1]


def test_late_force_has_later_stamps_and_the_same_values(clean: Simulation) -> None:
    case = case_of(['force_delay'])
    delay_ns = round(dict(case.true_values)['force_delay'] * NS_PER_S)
    here, there = of(ForceRecord, noiseless(case)), of(ForceRecord, clean)
    assert [r.force for r in here] == [r.force for r in there]
    assert {a.stamp_ns - b.stamp_ns for a, b in zip(here, there, strict=True)} == {delay_ns}
    assert 0 < delay_ns <= 300_000_000


def test_a_wrong_wheel_diameter_scales_the_measured_speed(clean: Simulation) -> None:
    case = case_of(['wheels'])
    ratio = dict(case.true_values)['wheel_ratio']
    here, there = (np.array([r.speed for r in of(SpeedRecord, s)]) for s in (noiseless(case), clean))
    assert 0.0 < abs(ratio - 1.0) <= 0.005
    np.testing.assert_allclose(here, ratio * there, rtol=1e-12)


def test_the_map_error_has_the_stated_standard_deviation(clean: Simulation) -> None:
    case = case_of(['map'])
    here, there = (np.array([r.gradient for r in of(GradientRecord, s)]) for s in (noiseless(case), clean))
    error = here - there
    std = dict(case.true_values)['map_std']
    assert case.stated.line.gradient_std == std
    # 850 m contain only a few independent errors.
    assert 0.3 * std < np.sqrt(np.mean(error**2)) < 2.0 * std
    assert 0.1 <= std <= 0.5
    assert 100.0 <= case.scenario.sensors.map_error_length <= 500.0


def test_gusts_have_the_true_parameters_and_speeds_are_multiples_of_the_quantum() -> None:
    case = case_of(['gusts'])
    gust, values = case.scenario.gust, dict(case.true_values)
    assert (gust.std, gust.time_constant) == (values['gust_std'], values['gust_time_constant'])
    assert 0.1 <= gust.std <= 0.4
    assert 3.0 <= gust.time_constant <= 12.0
    case = case_of(['quantum'], runs=1)
    quantum = dict(case.true_values)['speed_quantum']
    records = of(SpeedRecord, simulate(case.scenario, np.random.default_rng(2)))
    speeds = np.array([record.speed for record in records]) / quantum
    assert 0.1 <= 3.6 * quantum <= 0.5
    np.testing.assert_allclose(speeds, np.round(speeds), atol=1e-9)


def reported_brake(simulation: Simulation, brake: Brake) -> tuple[Floats, Floats]:
    """Return the braking force over the inertia, as reported and as computed from the commands [m/s^2]."""
    actuator, pairs, last_ns, mass = BrakeActuator(brake), [], simulation.truth.start_ns, 0.0
    for record in simulation.records:
        if isinstance(record, BrakeRecord):
            actuator.commands.push(BrakeCommandChange(record.stamp_ns, record.target_acceleration))
        elif isinstance(record, MassRecord):
            mass = record.mass
        elif isinstance(record, ForceRecord):
            actuator.advance(last_ns, record.stamp_ns)
            last_ns = record.stamp_ns
            if record.force < 0.0:
                pairs.append((record.force / mass / (1.0 + FILE.train.rotary_mass), actuator.output))
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
    assert all(draw_unknowns([name], np.random.default_rng(3)) != Unknowns() for name in UNKNOWNS)


def test_errors_have_the_stated_standard_deviation() -> None:
    drawn = [draw_unknowns(['mass', 'force_gain', 'curve'], np.random.default_rng(seed)) for seed in range(300)]
    for std, ratio in (('mass_std', 'mass_ratio'), ('force_std', 'force_ratio'), ('curve_std', 'curve_ratio')):
        scores = np.array([(getattr(u, ratio) - 1.0) / getattr(u, std) for u in drawn])
        assert np.std(scores) == pytest.approx(1.0, abs=0.15)
        assert np.abs(scores).max() < 3.0 + 1e-9


@pytest.mark.parametrize('names', [(), UNKNOWNS])
def test_the_stated_file_differs_from_the_given_one_only_in_standard_deviations(names: tuple[str, ...]) -> None:
    stated = case_of(names).stated
    effects = tuple(replace(effect, std=()) for effect in stated.effects)
    assert replace(stated, train=FILE.train, brake=FILE.brake, line=FILE.line, effects=effects) == FILE
    assert case_of(names).scenario.stated == stated


def test_a_clean_train_file_states_no_uncertainty_but_that_of_each_weighing() -> None:
    stated = case_of(()).stated
    assert (stated.train.mass_std, stated.train.force_std, stated.line.gradient_std) == (0.002, 0.0, 0.0)
    assert stated.brake.timing_std == 0.01
    assert all(dict(effect.std) == {'coefficient': 0.0} for effect in stated.effects)


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


def fleet() -> Fleet:
    return Fleet(WORLDS['metro'], world_train(WORLDS['metro']), 3)


def wheel_ratio(simulation: Simulation) -> float:
    """Return the distance by the speed over that by the position."""
    speeds = [record for record in simulation.records if isinstance(record, SpeedRecord)]
    driven = sum(
        0.5 * (one.speed + two.speed) * (two.stamp_ns - one.stamp_ns) / NS_PER_S for one, two in pairwise(speeds)
    )
    return driven / abs(speeds[-1].position - speeds[0].position)


def test_a_train_is_the_same_each_day_and_a_fault_comes_on_top() -> None:
    train, fault = draw_train(3, 1), parse_fault('T01:wheel_diameter:ratio=1.03:2', 2, 5)
    assert draw_train(3, 1) == train != draw_train(3, 2)
    drives = [
        drive(fleet(), train, draw_day(3, day), effects, runs=1)
        for day, effects in ((0, ()), (1, ()), (fault.day, fault.effects))
    ]
    first, second, broken = map(wheel_ratio, drives)
    assert first == pytest.approx(train.unknowns.wheel_ratio, abs=2e-3)
    assert second == pytest.approx(first, abs=2e-3)
    assert broken / second == pytest.approx(1.03, abs=2e-3)
    days = [simulation.records[0].stamp_ns // DAY_NS for simulation in drives]
    assert days[1] - days[0] == 1
    # The same fleet gives the same records.
    assert drive(fleet(), train, draw_day(3, 0), runs=1).records == drives[0].records


def test_a_fault_of_a_ratio_multiplies_that_of_the_train() -> None:
    train, day = draw_train(3, 1), draw_day(3, 0)
    pads = parse_fault('T01:brake_scale:ratio=0.8:2', 2, 5).effects
    rates = [drive(fleet(), train, day, faults, runs=1).truth.brake_rate[0][1] for faults in ((), pads)]
    assert rates[1] == pytest.approx(0.8 * rates[0])


def test_the_faults_of_the_page_are_some() -> None:
    text = (Path(__file__).parents[2] / 'docs' / 'simulator.md').read_text(encoding='utf-8')
    found = [parse_fault(name, 8, 8) for name in re.findall(r'(?m)^\| .*\| `(T.*)` \|$', text)]
    assert len(found) == 6


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('T01:brake_scale', 'must have the form TRAIN:EFFECT:key=value:DAY'),
        ('T01:brake_scale:ratio=0.8', 'must have the form'),
        ('T09:brake_scale:ratio=0.8:2', 'the trains are T01 to T02'),
        ('T01:brake_scale:ratio=0.8:1', 'day 1 is outside 2 to 5'),
        ('T01:brake_scale:ratio=0.8,ratio=0.9:2', 'more than once'),
        ('T01:brake_scael:ratio=0.8:2', 'brake_scale'),
        ('T01:brake_scale:ratio=-8:2', 'ratio'),
    ],
)
def test_a_wrong_fault_is_an_error(text: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        parse_fault(text, 2, 5)
