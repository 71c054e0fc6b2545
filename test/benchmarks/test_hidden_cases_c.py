# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.hidden_cases_c import LIBRARY, OUTSIDE, make_case
from benchmarks.hidden_cases_c import make as generator
from benchmarks.hidden_cases_c import motion as m
from benchmarks.hidden_log import STEP, G, Log
from test.benchmarks.usable_case import aligned_share, check_usable
from trainid_ros.interface.records import GradientRecord, SpeedRecord
from trainid_ros.train.effects import EFFECTS, TrackPoint
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Davis, parse_train_file


def calm_scene(seed: int, *, overlap: float = 1.0) -> generator.Scene:
    """A day of one train without nuisances: no gusts, errors of map and mass, unequal cars and brakes of its own."""
    scene = generator.draw_scene(np.random.default_rng(seed), one_day=True)
    same = {'mass': scene.train.mass, 'weighed': scene.train.mass, 'load': 1.0, 'overlap': overlap}
    legs = (leg._replace(**same, later=0.0, slower=0.0, electric=0.0) for leg in scene.bags[0])
    cells = scene.cells * np.array([[1.0], [0.0], [1.0], [1.0]])
    return replace(
        scene,
        bags=(tuple(legs),),
        gusts=0.0 * scene.gusts,
        cells=cells,
        cars=np.full_like(scene.cars, scene.cars.mean()),
    )


def driven(scene: generator.Scene, sizes: dict[int, float] | None = None) -> Log:
    twists = np.zeros((3, m.TWISTS))
    twists[1:, list(sizes or {})] = list((sizes or {}).values())
    (log,) = generator._drive(scene, scene.track(twists[1, m.START], twists[1, m.END]), twists)
    return log


def nominal_brake(scene: generator.Scene, log: Log) -> NDArray[np.float64]:
    """Deceleration of the brake of the train file [m/s^2], <= 0."""
    keep, wait = math.exp(-STEP / scene.train.lag), round(scene.train.delay / STEP)
    late = np.concatenate([np.full(wait, m.HOLD), log.command[: len(log.command) - wait]])
    brake, _ = lfilter([1.0 - keep], [1.0, -keep], late, zi=[keep * m.HOLD])
    return np.asarray(brake)


def test_names_are_in_the_library_or_outside_effects() -> None:
    assert set(LIBRARY) <= set(EFFECTS)
    assert not set(OUTSIDE) & set(EFFECTS)
    assert {name for effect in OUTSIDE.values() for name in effect.near.split()} <= set(EFFECTS)
    for name, effect in LIBRARY.items():
        assert set(effect.parameters.split()) <= set(EFFECTS[name].parameters)


def test_equal_names_and_seeds_give_equal_cases() -> None:
    assert make_case('local_drag', 5) == make_case('local_drag', 5)
    assert make_case('local_drag', 5).bags != make_case('local_drag', 6).bags


@pytest.mark.parametrize('seed', range(4))
def test_assumed_balance_holds_exactly_without_nuisances(seed: int) -> None:
    log = driven(calm_scene(seed))
    assert np.max(np.abs(log.noise)) < 1e-9
    assert np.max(np.abs(log.added)) < 1e-9


def test_traction_acts_beside_the_brake_only_without_interlock() -> None:
    for overlap, least in ((0.0, 0.0), (2.0, 1.0)):
        scene = calm_scene(3, overlap=overlap)
        log = driven(scene)
        brake = nominal_brake(scene, log)
        traction = log.force / log.weighed - (1.0 + scene.train.gamma) * brake
        # While the traction of an interlocked train falls, the dead time of its brake runs.
        starting = (brake < -0.05) & (np.diff(traction, prepend=0.0) > 1e-6)
        assert np.sum(starting) * STEP >= least
        assert overlap > 0.0 or not starting.any()


SIZES = {
    'tunnel_drag': {m.BORE: 0.8},
    'curve_resistance': {m.FLANGE: 700.0},
    'gradient_error': {m.SLOPE: 2.0},
    'local_drag': {m.RUB: 2.0},
    'headwind': {m.WIND: 5.0},
    'mass_error': {m.HEAVY: 0.05},
    'traction_scale': {m.PULL: 0.04},
    'brake_scale': {m.BITE: -0.1},
    'dragging_brake': {m.CLING: 1.5, m.CLING_FOR: 12.0},
    'starting_resistance': {m.STICK: 5.0, m.STICK_V: 3.0},
    'bearing_warmup': {m.COLD: 1.0, m.COLD_RUN: 3000.0},
    'resistance_step': {m.JUMP: 0.5, m.JUMP_AT: 300.0},
    'higher_order_drag': {m.CUBIC: 1e-5},
}


@pytest.mark.parametrize('name', SIZES)
def test_effect_has_the_equation_of_the_interface(name: str) -> None:
    """The contribution to dv/dt is that of the extra resistance by the library, with the parameters of the truth."""
    scene, sizes = (
        next(scene for scene in map(calm_scene, range(50)) if scene.cells[2:].any(axis=1).all()),
        dict(SIZES[name]),
    )
    sizes |= {m.START: scene.stops[0] + 100.0, m.END: scene.stops[0] + 300.0}
    log, train = driven(scene, sizes), scene.train
    values = [size + (at in generator._RATIOS) for at, size in sizes.items()]
    parameters = dict(zip(LIBRARY[name].parameters.split(), values, strict=False))
    brake, track = nominal_brake(scene, log), scene.track(0.0, 0.0)
    run, function = np.cumsum(log.speed) * STEP, EFFECTS[name].resistance
    assert function is not None
    expected, found, since = [], [], 0.0
    for k in range(len(log.run)):
        since = 0.0 if brake[k] < -0.02 else since + STEP
        if log.run[k] < 0 or log.speed[k] < 1.0 or k % 25:
            continue
        _, _, bend, dark, _ = track.tables[0 if log.heading[k] > 0 else 1][round(log.front[k] - track.origin)]
        if 0.01 < dark < 0.99:
            continue  # The library has a flag.
        at = TrackPoint(
            k * STEP, log.front[k], int(log.heading[k]), log.speed[k], 1.0 / bend if bend > 1e-6 else 0.0,
            bool(dark > 0.5), train.length, run[k], since, brake=1e3 / G * (1.0 + train.gamma) * brake[k],
            traction=1e3 / G * (log.force[k] / log.weighed[k] - (1.0 + train.gamma) * brake[k]),
        )  # fmt: skip
        # A heavier train has less air drag for its weight, and there is no wind in a tunnel.
        if name == 'headwind' and dark > 0.5:
            continue
        air = train.c * log.speed[k] ** 2 * (1.0 - 1.0 / parameters['ratio']) if name == 'mass_error' else 0.0
        expected.append(function(parameters, Davis(train.a, train.b, train.c), at) - air)
        found.append(-log.added[0, k] * 1e3 / G * (1.0 + train.gamma))
    assert np.max(np.abs(expected)) > 0.02
    wrong = np.abs(np.array(found) - expected) > 0.02 * np.max(np.abs(expected))
    # Edges of sections and of times fall between two rows.
    assert np.mean(wrong) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize('name', ['none', 'map_shift+brake_delay', *LIBRARY, *OUTSIDE])
def test_every_name_gives_usable_data(name: str) -> None:
    case = make_case(name, 77)
    check_usable(case, name)
    assert (name == 'none') == (case.answer.visible == 0.0)
    assert aligned_share(case) > (0.45 if '10_hz' in case.answer.flags else 0.9)


@pytest.mark.parametrize(('name', 'sign'), [('none', 0.0), ('map_shift', 1.0)])
def test_gradient_is_that_of_the_map_under_the_train_unless_it_is_read_ahead(name: str, sign: float) -> None:
    case = make_case(name, 21)
    assumed = parse_train_file(case.train_yaml, 'assumed train file')
    shift = sign * sum(value for effect in case.answer.effects for _, value in effect.parameters)
    profile = LineProfile(assumed.line, assumed.train.length)
    speeds = [record for record in case.bags[0] if isinstance(record, SpeedRecord)]
    slopes = [record for record in case.bags[0] if isinstance(record, GradientRecord)]
    places = np.interp(
        [one.stamp_ns for one in slopes], [one.stamp_ns for one in speeds], [one.position for one in speeds]
    )
    ways = np.sign(np.gradient(places))
    apart = [
        profile.gradient(place + way * shift, int(way)) - one.gradient
        for place, way, one in zip(places.tolist(), ways.tolist(), slopes, strict=True)
        if abs(way) > 0.0
    ]
    assert np.median(np.abs(apart)) < 0.05
