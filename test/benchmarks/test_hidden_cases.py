# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.explain import GENERATORS
from benchmarks.hidden_cases.effects import COUNTS_FROM_START, LIBRARY, OUTSIDE, Hidden, Moment, traction_scale
from benchmarks.hidden_cases.make import make_case, ride_case
from benchmarks.hidden_cases.motion import Ride
from benchmarks.hidden_cases.world import Track, World, draw_world
from benchmarks.hidden_log import STEP, Log, measure_gaps
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord

G = 9.81


def small_world(seed: int, legs: int = 2, *, calm: bool = False) -> World:
    """A run up the line and one back on the same track; ``calm``: without gusts, map and sensor errors."""
    world = draw_world(np.random.default_rng([seed, 1]))
    day = [leg for bag in world.bags for leg in bag]
    back = [leg for leg in reversed(day) if leg.heading < 0] or day[1:]
    chosen = [day[0], *back][:legs]
    nuisance = replace(world.nuisance, contamination=(), mass_topic=True)
    if calm:
        chosen = [replace(leg, weighed=leg.mass) for leg in chosen]
        nuisance = replace(nuisance, gust=0.0, map_error=0.0, force_lag=0.0, force_noise=0.0)
        nuisance = replace(nuisance, speed_noise=0.0, speed_step=1e-6, jitter=0.0)
    return replace(world, nuisance=nuisance, bags=(tuple(chosen),))


def two_way_seed(start: int) -> int:
    return next(seed for seed in range(start, start + 99) if not draw_world(np.random.default_rng([seed, 1])).one_way)


def ridden(world: World, effects: Sequence[Hidden], seed: int = 1) -> Log:
    track = Track(world.route, world.vehicle.length, world.nuisance, np.random.default_rng([seed, 2]))
    return Ride(world, track, effects, seed).drive(world.bags[0], 0)


def column(records: Sequence[Record], kind: type[Record], name: str) -> NDArray[np.float64]:
    return np.array([getattr(record, name) for record in records if type(record) is kind], dtype=float)


def gap(world: World, effect: Hidden) -> float:
    log = ridden(world, [effect])
    return measure_gaps([log], [np.zeros((1, len(log.speed)))], world.vehicle.davis, world.vehicle.rotary).total


@pytest.mark.parametrize('generator', GENERATORS.values())
def test_a_generator_imports_no_code_under_test_and_no_other_one(generator: ModuleType) -> None:
    folder = Path(str(generator.__file__)).parent
    paths = [*folder.glob('*.py'), *folder.parent.glob('hidden_*.py')]
    trees = [ast.parse(path.read_text(encoding='utf-8')) for path in paths]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    modules = {node.module or '' for node in nodes if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    ours = {name for name in modules if name.startswith(('trainid', 'benchmarks'))}
    own = {name for name in ours if f'{name}.'.startswith(f'{generator.__name__}.')}
    assert ours - own <= {'benchmarks.hidden_case', 'benchmarks.hidden_log', 'trainid_ros.interface.records'}


@pytest.mark.parametrize('generator', GENERATORS.values())
def test_mix_of_cases(generator: Any) -> None:
    cases = generator.draw_cases(8, 300)
    assert cases == generator.draw_cases(8, 300)
    assert len(set(cases)) == 300
    names = [name for name, _ in cases]
    assert names.count('none') == 45
    assert sum(name in generator.OUTSIDE for name in names) == 45
    assert sum('+' in name for name in names) == 30
    assert {*generator.LIBRARY, *generator.OUTSIDE} <= set(names)


def test_records_of_a_calm_day_balance_energy() -> None:
    """Work of the force minus that of resistance and gradient is kinetic energy, in every run, from records alone."""
    world = small_world(two_way_seed(7001), calm=True)
    records = ride_case(1, world, []).bags[0]
    gamma, (a, b, c) = world.vehicle.rotary, world.vehicle.davis
    v = column(records, SpeedRecord, 'speed')
    time = column(records, SpeedRecord, 'stamp_ns') * 1e-9
    force = np.interp(time, column(records, ForceRecord, 'stamp_ns') * 1e-9, column(records, ForceRecord, 'force'))
    track_time = column(records, GradientRecord, 'stamp_ns') * 1e-9
    gradient = np.interp(time, track_time, column(records, GradientRecord, 'gradient'))
    mass = np.interp(time, column(records, MassRecord, 'stamp_ns') * 1e-9, column(records, MassRecord, 'mass'))
    power = (force / mass - G / 1000.0 * (a + b * v + c * v * v + gradient)) * v
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(time))])
    kinetic = 0.5 * (1.0 + gamma) * v * v
    assert np.max(np.abs(work - kinetic)) < 0.02 * np.max(kinetic)


def test_conventions_of_the_interface() -> None:
    world = small_world(7101, legs=1, calm=True)
    weak = Hidden('brake_scale', (), brake_gain=lambda _: 0.85)
    records = ride_case(1, world, [weak]).bags[0]
    position = column(records, SpeedRecord, 'position')
    assert position[-1] > position[0] + 1000.0
    assert np.all(column(records, BrakeRecord, 'target_acceleration') <= 0.0)
    assert np.all(column(records, SpeedRecord, 'speed') >= 0.0)
    # The reported force while braking is that of the nominal brake, although the true one is weaker.
    log = ridden(world, [weak])
    braking = np.flatnonzero((log.command < -0.3) & (log.run == 0))
    settled = braking[np.all([log.command[braking - k] == log.command[braking] for k in range(0, 300, 20)], axis=0)]
    nominal = log.weighed[settled] * (1.0 + world.vehicle.rotary) * log.command[settled]
    assert log.force[settled] == pytest.approx(nominal, rel=0.03)


def test_track_values_are_means_under_the_train_with_the_sign_of_travel() -> None:
    world = small_world(two_way_seed(7201), calm=True)
    length = world.vehicle.length
    track = Track(world.route, length, world.nuisance, np.random.default_rng(1))
    front = np.array([500.0, 500.0 - length])
    means = track.under(front, np.array([1, -1]))
    # Both trains cover the same track, in opposite directions.
    assert means[0] == pytest.approx(means[1], abs=1e-12)
    place = np.arange(500 - length, 500) + 0.5
    starts, values = np.array(world.route.gradient).T
    assert means[0, 1] == pytest.approx(np.mean(values[np.searchsorted(starts, place, side='right') - 1]), abs=1e-9)
    records = ride_case(1, world, []).bags[0]
    gradient, place = column(records, GradientRecord, 'gradient'), column(records, SpeedRecord, 'position')
    away, back = np.abs(place - 700.0) < 8.0, np.abs(place - (700.0 - length)) < 8.0
    turn = len(place) // 2
    assert gradient[:turn][away[:turn]].mean() == pytest.approx(-gradient[turn:][back[turn:]].mean(), abs=0.5)


@pytest.mark.parametrize(('name', 'same_both_ways'), [('local_drag', True), ('gradient_error', False)])
def test_sign_of_a_section(name: str, same_both_ways: bool) -> None:
    world = small_world(7301)
    effect = LIBRARY[name](world, np.random.default_rng(3))
    start, end, permille = (value for _, value in effect.parameters)
    middle, length = 0.5 * (start + end), world.vehicle.length
    assert effect.drag is not None
    up = effect.drag(Moment(front=middle + 0.5 * length, heading=1, speed=10.0))
    down = effect.drag(Moment(front=middle - 0.5 * length, heading=-1, speed=10.0))
    assert up == pytest.approx(permille * min(1.0, (end - start) / length))
    assert down == pytest.approx(up if same_both_ways else -up)


def test_positive_headwind_opposes_a_train_with_rising_positions() -> None:
    world = small_world(7401)
    effect = LIBRARY['headwind'](world, np.random.default_rng(2))
    wind, c = effect.parameters[0][1], world.vehicle.davis[2]
    assert effect.drag is not None
    assert effect.drag(Moment(speed=20.0, heading=1)) == pytest.approx(c * ((20.0 + wind) ** 2 - 400.0))


def test_mass_ratio_changes_acceleration_but_not_specific_resistance() -> None:
    world = small_world(7501, legs=1, calm=True)
    heavy = Hidden('mass_error', (), mass_ratio=1.1)
    log = ridden(world, [heavy])
    moving = log.run >= 0
    reported = log.force[moving] / log.weighed[moving] / (1.0 + world.vehicle.rotary)
    assert log.added[0][moving] == pytest.approx(reported * (1.0 / 1.1 - 1.0), abs=1e-9)


def test_drag_of_davis_form_leaves_no_gap_and_other_drag_does() -> None:
    world = small_world(two_way_seed(7601), calm=True)
    davis = Hidden('x', (), drag=lambda m: 0.3 + 0.02 * m.speed + 0.0004 * m.speed**2)
    one_way = Hidden('x', (), drag=lambda m: 0.3 * m.heading)
    assert gap(world, davis) < 2e-3
    assert gap(world, one_way) > 0.03


def test_gap_equals_that_of_a_nonlinear_refit() -> None:
    """Integrate the assumed equation and fit initial speeds and a, b, c by nonlinear least squares."""
    world = small_world(7701, calm=True)
    effect = traction_scale(world, np.random.default_rng(4))
    log = ridden(world, [effect])
    track = Track(world.route, world.vehicle.length, world.nuisance, np.random.default_rng([1, 2]))
    every, rotary = 10, 1.0 + world.vehicle.rotary
    runs = [np.flatnonzero(log.run == number)[: np.sum(log.run == number) // every * every] for number in (0, 1)]
    mapped = log.heading * track.under(log.front, log.heading)[:, 1]
    known = (log.force / log.weighed - G / 1000.0 * mapped) / rotary
    means = [known[rows].reshape(-1, every).mean(axis=1).tolist() for rows in runs]

    def gaps(x: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c = (x[:3] * np.array([1.0, 0.1, 0.005])).tolist()
        path: list[float] = []
        for v, forces in zip(x[3:].tolist(), means, strict=True):
            speed = v
            for push in forces:
                path.append(speed)
                guess = push - G / 1000.0 / rotary * (a + b * speed + c * speed * speed)
                half = speed + 0.5 * STEP * every * guess
                speed += STEP * every * (push - G / 1000.0 / rotary * (a + b * half + c * half * half))
        measured = np.concatenate([log.speed[rows[::every]] for rows in runs])
        apart: NDArray[np.float64] = np.array(path) - measured
        return apart

    a, b, c = world.vehicle.davis
    best = least_squares(gaps, [a, b / 0.1, c / 0.005, 0.0, 0.0])
    nonlinear = math.sqrt(float(np.mean(best.fun**2)))
    assert gap(world, effect) == pytest.approx(nonlinear, rel=0.1)


@pytest.mark.parametrize('name', [*LIBRARY, *OUTSIDE])
def test_every_effect_changes_the_motion_or_the_sensors(name: str) -> None:
    rng = np.random.default_rng(5)
    world = small_world(7801)
    effect = (LIBRARY | OUTSIDE)[name](world, rng)
    assert effect.name == name
    assert all(math.isfinite(value) for _, value in effect.parameters)
    moment = Moment(
        time=2000.0,
        front=900.0,
        speed=0.9 * world.vehicle.top_speed,
        tunnel_share=1.0,
        curvature=1 / 300,
        travelled=900.0,
        released_for=2.0,
        applied_for=1.0,
        pull=30.0,
        heat=200.0,
        acceleration=0.5,
        load=0.9,
    )
    spots = [replace(moment, front=x, heading=heading) for x, heading in _spots(world)]
    drags = [effect.drag(spot) for spot in spots] if effect.drag else []
    gains = [law(spot) for law in (effect.pull_gain, effect.brake_gain) if law for spot in spots]
    ratios = [*gains, effect.mass_ratio, effect.inertia_ratio, effect.wheel_ratio]
    assert any(drags) or any(ratio != 1.0 for ratio in ratios) or effect.brake_wait or effect.slip[0]


def _spots(world: World) -> list[tuple[float, int]]:
    return [(float(x), heading) for x in range(0, int(world.route.stops[-1]), 50) for heading in (1, -1)]


def test_assumed_train_file_contains_no_truth() -> None:
    world = small_world(7901, legs=1)
    effect = LIBRARY['dragging_brake'](world, np.random.default_rng(1))
    case = ride_case(7901, world, [effect])
    assert case.answer.kind == 'single'
    assert case.answer.effects[0].parameters == effect.parameters
    assert case.answer.visible > 0.0
    assert 'dragging' not in case.train_yaml
    assert 'effects: []' in case.train_yaml
    assert case == ride_case(7901, world, [effect])


def test_pairs_have_a_gap_for_each_effect() -> None:
    world = small_world(7951, legs=1)
    both = [draw(world, np.random.default_rng(1)) for draw in (LIBRARY['brake_delay'], LIBRARY['local_drag'])]
    answer = ride_case(3, world, both).answer
    assert answer.kind == 'pair'
    assert [effect.name for effect in answer.effects] == ['brake_delay', 'local_drag']
    assert over_floor(answer.visible) <= sum(over_floor(effect.visible) for effect in answer.effects) * 1.05


def over_floor(visible: float) -> float:
    """Return the gap over the noise floor of a visibility in percent."""
    return math.sqrt((1.0 + visible / 100.0) ** 2 - 1.0)


def test_unknown_name_is_rejected() -> None:
    with pytest.raises(ValueError, match="'gremlins' is not known"):
        make_case('gremlins', 1)


def test_effects_that_depend_on_the_start_use_one_bag() -> None:
    assert set(LIBRARY | OUTSIDE) >= COUNTS_FROM_START
    worlds = [draw_world(np.random.default_rng([seed, 1]), one_bag=True) for seed in range(40)]
    assert {len(world.bags) for world in worlds} == {1}
    assert min(len(world.bags[0]) for world in worlds) >= 7
