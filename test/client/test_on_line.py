# SPDX-License-Identifier: Apache-2.0
"""Answers at a place on the line are those of the simulated train there, and their bounds hold as often as stated."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainid_ros.client import TrainModel
from trainid_ros.client.stopping import PARAMETERS, Braking
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import Plant
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, TrainFile, load_train_file

METRO = load_train_file(Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml')
OF_PLACE = parse_effects(
    [
        'local_drag:start=2000,end=5000,permille=5',
        'gradient_error:start=1000,end=4000,permille=4',
        'curve_resistance:coefficient=700',
        'map_shift:distance=60',
        'tunnel_drag:factor=3',
    ]
)
WINDING = replace(
    METRO.line,
    tunnel=((1000.0, 2200.0), (5000.0, 5300.0)),
    curve=((500.0, 300.0), (1500.0, 0.0), (4000.0, 500.0), (4500.0, 0.0)),
)
EMU = Brake(delay=0.8, time_constant=0.6, rate_table=((2.0, 1.25), (8.0, 0.9), (14.0, 0.6), (25.0, 0.4)))
RICH = replace(METRO, line=WINDING, effects=OF_PLACE)


def dropping(permille: float, length: float) -> TrainFile:
    """Return a train on a level line with a short stretch uphill, downhill if negative, from 1000 m on."""
    profile = ((0.0, 0.0), (1000.0, permille), (1000.0 + length, 0.0))
    return replace(METRO, line=replace(METRO.line, stops=(0.0, 1e4), gradient=profile))


def simulated(file: TrainFile, speed: float, command: float, position: float, direction: int) -> float:
    """Return the stopping distance of the simulator's plant [m], extrapolated to infinitely short steps."""
    runs = []
    for step_ns in (20_000_000, 10_000_000):
        plant = Plant(file, LineProfile(file.line, file.train.length), NS_PER_S, 0.8)
        plant.speed, plant.position, plant.direction = speed, position, direction
        plant.command(command)
        while plant.speed > 0.0:
            plant.step(0.0, step_ns)
        runs.append(plant.distance_run)
    return 2.0 * runs[1] - runs[0]


@pytest.mark.parametrize(
    ('file', 'speed', 'command', 'position', 'direction'),
    [
        (METRO, 20.0, -0.8, 4000.0, 1),
        (METRO, 12.0, -0.45, 19300.0, -1),
        (RICH, 21.0, -0.6, 1900.0, 1),
        (RICH, 17.0, -0.5, 5600.0, -1),
        (replace(METRO, brake=EMU), 21.0, -1.0, 7600.0, 1),
        (dropping(-70.0, 200.0), 10.0, -0.4, 960.0, 1),
    ],
)
def test_the_distance_is_that_of_the_simulator_within_a_centimetre(
    file: TrainFile, speed: float, command: float, position: float, direction: int
) -> None:
    found = TrainModel(None, file).stopping_distance(speed, 0.0, command, 0.5, direction=direction, position=position)
    assert found.value == pytest.approx(simulated(file, speed, command, position, direction), abs=0.01)


def test_a_short_descent_does_not_prevent_an_answer_but_an_endless_one_does() -> None:
    short, endless = (TrainModel(None, dropping(-70.0, length)) for length in (200.0, 1e6))
    assert short.stopping_distance(10.0, 0.0, -0.4, position=960.0).value > 300.0
    with pytest.raises(NoAnswerError):
        endless.stopping_distance(10.0, 0.0, -0.4, position=960.0)
    with pytest.raises(NoAnswerError):
        short.stopping_distance(10.0, -70.0, -0.4)
    # In the other direction it is behind the train.
    away = short.stopping_distance(10.0, 0.0, -0.4, position=880.0, direction=-1)
    assert away == endless.stopping_distance(10.0, 0.0, -0.4, position=880.0, direction=-1)


def test_on_a_line_of_one_gradient_answers_are_those_without_a_place() -> None:
    slope = TrainModel(None, replace(METRO, line=replace(METRO.line, stops=(0.0, 1e4), gradient=((0.0, -12.0),))))
    for direction, gradient in ((1, -12.0), (-1, 12.0)):
        here = slope.stopping_distance(18.0, 3.0, -0.7, direction=direction, position=5000.0)
        anywhere = slope.stopping_distance(18.0, gradient + 3.0, -0.7, direction=direction)
        assert here.value == pytest.approx(anywhere.value, abs=0.005)
        assert here.std == pytest.approx(anywhere.std, rel=0.01)


def test_derivatives_are_those_of_the_distance() -> None:
    """A quarter of the effect of a parameter is that the train stops where the gradient is another."""
    shape = TrainModel(None, RICH)._file.stop_shape(1, 1600.0)
    theta, step = [0.9, 0.02, 0.02, 1.5, 0.02, 0.001, 2.0, 0.6, 0.4], 1e-4

    def distance(values: list[float], v: float = 19.0) -> float:
        return Braking(shape, values, 0.6, 0.1).stop(v).distance

    stop = Braking(shape, theta, 0.6, 0.1).stop(19.0)
    for place in range(PARAMETERS):
        above, below = list(theta), list(theta)
        above[place] += step
        below[place] -= step
        numeric = (distance(above) - distance(below)) / (2.0 * step)
        assert stop.gradient[place] == pytest.approx(numeric, rel=0.03), place
    assert stop.dD_dv == pytest.approx(
        (distance(theta, 19.0 + step) - distance(theta, 19.0 - step)) / (2.0 * step), rel=0.01
    )


DRAWS = 3000


@pytest.mark.parametrize(('position', 'speed', 'rate_std'), [(4000.0, 20.0, 0.2), (18100.0, 15.0, 0.02)])
def test_bounds_cover_their_share_of_the_posterior(
    position: float, speed: float, rate_std: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Integrated in small equal steps of time, for all draws at once."""
    model, command, dt, rng = TrainModel(None, METRO), 0.8, 0.05, np.random.default_rng(11)
    known = model._posterior(0.0)
    stated = replace(known, variances=(rate_std**2, *known.variances[1:]))
    monkeypatch.setattr(model, '_posterior', lambda *_: stated)
    bound = model.stopping_distance(speed, 0.0, -command, 0.95, position=position).value
    theta = np.array(known.mean)[:, None] + np.sqrt(known.variances)[:, None] * rng.standard_normal((9, DRAWS))
    theta[0] = known.mean[0] + rate_std * rng.standard_normal(DRAWS)
    theta[3:6] = rng.multivariate_normal(known.mean[3:6], np.reshape(known.davis, (3, 3)), DRAWS).T
    f, e, h, a, b, c, i, delay, tau = theta
    profile = LineProfile(METRO.line, METRO.train.length)
    places = np.arange(0.0, 3000.0, 2.0)
    gradients = np.array([profile.gradient(position + x, 1) for x in places])
    v, run, t, k, top = np.full(DRAWS, speed), np.zeros(DRAWS), 0.0, model._file.k, METRO.train.max_speed
    while np.any(v > 0.0) and t < 90.0:
        lag = np.exp(-np.maximum(0.0, t + 0.5 * dt - delay) / np.maximum(tau, 1e-3))
        rate = f + e * (np.minimum(v / top, 1.0) - 0.5) + h * np.maximum(0.0, 1.0 - np.abs(v / 2.5 - 1.0))
        track = i + np.interp(run + 0.5 * dt * v, places, gradients)
        d = rate * command * (1.0 - lag) + k * (a + v * (b + c * v) + track)
        after = np.maximum(0.0, v - dt * d)
        run += np.where(after > 0.0, 0.5 * (v + after) * dt, 0.5 * v * v / np.maximum(d, 1e-9))
        v, t = np.where(v > 0.0, after, 0.0), t + dt
    covered = float(np.mean(run <= bound))
    print(f'{covered:.4f}')
    assert abs(covered - 0.95) < 0.012


def test_the_speed_is_the_inverse_of_the_distance() -> None:
    model = TrainModel(None, RICH)
    for position, target, direction in ((3600.0, 3906.0, 1), (6500.0, 6272.0, -1), (1500.0, 2631.0, 1)):
        speed = model.braking_speed(
            command=-0.8, target_position=target, position=position, direction=direction, applied=-0.2
        )
        back = model.stopping_distance(speed.value, command=-0.8, position=position, direction=direction, applied=-0.2)
        assert back.value == pytest.approx(abs(target - position), abs=1e-6)
        assert speed.std > 0.0


def test_a_target_that_is_not_ahead_permits_no_speed_and_is_named() -> None:
    model = TrainModel(None, METRO)
    for target, direction in ((2631.0, 1), (2769.0, -1), (2700.0, 1)):
        found = model.braking_speed(target_position=target, position=2700.0, direction=direction)
        assert found.value == 0.0
        assert found.reason == 'train file: no estimate yet; the target is not ahead in this direction'


@pytest.mark.parametrize(('position', 'direction', 'end'), [(22700.0, 1, 22846), (100.0, -1, -118)])
def test_a_stop_beyond_the_end_of_the_line_is_named(position: float, direction: int, end: int) -> None:
    model = TrainModel(None, METRO)
    slow, fast = (model.stopping_distance(v, position=position, direction=direction) for v in (8.0, 18.0))
    assert slow.reason == 'train file: no estimate yet'
    assert fast.reason == f'train file: no estimate yet; beyond the end of the line at {end} m'
    away = model.stopping_distance(18.0, position=position, direction=-direction)
    assert away.reason == 'train file: no estimate yet'


def test_a_line_without_stops_is_known_as_far_as_its_gradients() -> None:
    model = TrainModel(None, replace(METRO, line=replace(METRO.line, stops=())))
    last = METRO.line.gradient[-1][0]
    assert model.stopping_distance(18.0, position=last - 1000.0).reason == 'train file: no estimate yet'
    for position in (last - 100.0, 1e5):
        reason = model.stopping_distance(18.0, position=position).reason
        assert reason == f'train file: no estimate yet; beyond the gradients of the line, which end at {last:.10g} m'


def test_a_single_gradient_holds_everywhere() -> None:
    model = TrainModel(None, replace(METRO, line=replace(METRO.line, stops=(), gradient=((0.0, 5.0),))))
    assert model.stopping_distance(18.0, position=1e5).reason == 'train file: no estimate yet'


def test_a_speed_that_carries_the_train_over_a_summit_is_not_allowed() -> None:
    """Slower trains stop before the descent; all others run through it, so no train stops in between."""
    model = TrainModel(None, dropping(-70.0, 200.0))
    speed = model.braking_speed(None, 0.0, -0.35, target_position=1250.0, position=900.0).value
    distances = [model.stopping_distance(x * speed, 0.0, -0.35, position=900.0).value for x in (0.6, 0.9, 1.0, 1.001)]
    assert distances == sorted(distances)
    assert distances[2] < 350.0
    assert distances[3] > 600.0


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        ({}, 'give either distance, or target_position and position'),
        ({'distance': 100.0, 'position': 0.0}, 'give either'),
        ({'distance': 100.0, 'target_position': 0.0, 'position': 0.0}, 'give either'),
        ({'target_position': 100.0}, 'give either'),
        ({'target_position': math.nan, 'position': 0.0}, '^target_position = '),
        ({'target_position': 100.0, 'position': '7'}, '^position = .* must be a number'),
        (
            {'target_position': 23000.0, 'position': 100.0},
            '^target_position = 23000 m is not on the line',
        ),
        ({'target_position': 100.0, 'position': -400.0}, r'^position = -400 m is not on the line, -118 to 22846 m'),
    ],
)
def test_a_place_that_cannot_be_is_named(arguments: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        TrainModel(None, METRO).braking_speed(**arguments)


def test_without_gradients_there_is_no_answer_at_a_place() -> None:
    bare = TrainModel(None, replace(METRO, line=replace(METRO.line, gradient=())))
    with pytest.raises(InputError, match=r'^line\.gradient of the train file is missing'):
        bare.stopping_distance(10.0, position=100.0)
