# SPDX-License-Identifier: Apache-2.0
"""The stopping distance is that of the simulated train, and its derivatives are right within 5 per cent."""

from __future__ import annotations

import math

import pytest

from trainid_ros.client.stopping import DELAY, EXTRA_STEP, GRADIENT, LAG, PARAMETERS, RATE, Braking, RateShape
from trainid_ros.sim.plant import Plant
from trainid_ros.train.forces import G
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Pairs, Train, TrainFile

EMU: Pairs = ((2.0, 1.25), (8.0, 0.9), (14.0, 0.6), (25.0, 0.4))
TRAIN = Train(mass=194e3)


def shape(table: Pairs = ()) -> RateShape:
    k = G / (1000.0 * (1.0 + TRAIN.rotary_mass))
    return RateShape([v for v, _ in table], [rate for _, rate in table], TRAIN.max_speed, 2.5, k)


def parameters(**changes: float) -> list[float]:
    theta = [0.9, 0.0, 0.0, 1.5, 0.02, 0.001, 0.0, 0.6, 0.4]
    for name, value in changes.items():
        theta[{'rate': RATE, 'gradient': GRADIENT, 'delay': DELAY, 'lag': LAG}[name]] = value
    return theta


def simulated(theta: list[float], table: Pairs, speed: float, command: float) -> float:
    """Return the stopping distance of the simulator's plant [m]."""
    brake = Brake(theta[RATE], theta[LAG], theta[DELAY], rate_table=table)
    line = Line(gradient=((0.0, theta[GRADIENT]),))
    train_file = TrainFile(TRAIN, Davis(*theta[3:6]), brake, line)
    plant = Plant(train_file, LineProfile(line, TRAIN.length), 0, 0.8)
    plant.speed = speed
    plant.command(-command)
    while plant.speed > 0.0:
        plant.step(0.0)
    return plant.distance_run


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize(
    ('speed', 'command', 'changes'),
    [
        (22.0, 1.0, {}),
        (22.0, 0.4, {'delay': 3.3, 'lag': 1.2}),
        (8.0, 1.0, {'gradient': -25.0}),
        (8.0, 0.6, {'gradient': 30.0, 'lag': 0.0}),
        (1.0, 1.0, {'delay': 0.0}),
        (0.4, 1.0, {}),
    ],
)
def test_the_distance_is_that_of_the_simulator(
    table: Pairs, speed: float, command: float, changes: dict[str, float]
) -> None:
    theta = parameters(**changes)
    found = Braking(shape(table), theta, command, 0.0).stop(speed).distance
    assert found == pytest.approx(simulated(theta, table, speed, command), rel=5e-4, abs=2e-3)


@pytest.mark.parametrize('table', [(), EMU])
@pytest.mark.parametrize('speed', [0.7, 4.0, 19.0])
def test_derivatives_are_those_of_the_distance(table: Pairs, speed: float) -> None:
    theta, step = parameters(gradient=-5.0), 1e-4

    def distance(values: list[float], v: float = speed) -> float:
        return Braking(shape(table), values, 0.9, 0.2).stop(v).distance

    stop = Braking(shape(table), theta, 0.9, 0.2).stop(speed)
    for place in range(PARAMETERS):
        above, below = list(theta), list(theta)
        above[place] += step
        below[place] -= step
        numeric = (distance(above) - distance(below)) / (2.0 * step)
        assert stop.gradient[place] == pytest.approx(numeric, rel=0.05), place
    numeric = (distance(theta, speed + step) - distance(theta, speed - step)) / (2.0 * step)
    assert stop.by_speed == pytest.approx(numeric, rel=0.01)


def test_a_table_is_interpolated_linearly() -> None:
    form = shape(EMU)
    for v in (0.0, 2.0, 5.0, 8.0, 13.9, 14.0, 20.0, 25.0, 40.0):
        assert form.table(v) == pytest.approx(Brake(rate_table=EMU).shape_at(v))


def test_an_extra_resistance_acts_as_that_of_the_train() -> None:
    form = shape()
    form.resistances = [0.002 * (EXTRA_STEP * k) ** 2 for k in range(601)]
    assert [form.extra(v) for v in (-1.0, 0.0, 10.0, 150.0, 400.0)] == pytest.approx([0.0, 0.0, 0.2, 45.0, 45.0])
    drag = parameters()
    drag[5] += 0.002
    extra, expected = (Braking(x, y, 0.7, 0.0).stop(20.0) for x, y in ((form, parameters()), (shape(), drag)))
    assert extra.distance == pytest.approx(expected.distance, rel=1e-5)
    assert extra.by_speed == pytest.approx(expected.by_speed, rel=1e-3)


def test_a_train_that_is_braking_already_stops_sooner() -> None:
    theta = parameters()
    released = Braking(shape(), theta, 1.0, 0.0).stop(20.0).distance
    braking = Braking(shape(), theta, 1.0, 1.0).stop(20.0).distance
    # Half a second to a second of braking is lost otherwise.
    assert 0.8 * 20.0 < released - braking < 1.0 * 20.0


def test_a_brake_weaker_than_the_gradient_does_not_stop_the_train() -> None:
    steep = parameters(gradient=-60.0)
    assert math.isinf(Braking(shape(), steep, 0.3, 0.0).stop(10.0).distance)
    assert math.isinf(Braking(shape(), parameters(gradient=-499.0, delay=120.0), 0.3, 0.0).stop(10.0).distance)


def test_a_standing_train_needs_no_distance() -> None:
    assert Braking(shape(), parameters(), 1.0, 0.0).stop(0.0).distance == 0.0


@pytest.mark.parametrize('least', [0.2, 1e-2, 1e-4])
def test_a_train_that_hardly_slows_down_has_the_distance_of_its_balance(least: float) -> None:
    """Its deceleration falls linearly with speed, so that the distance has a closed form."""
    form = RateShape([], [], 22.2, 2.5, 0.01)
    slope = (0.9 - least) / 20.0  # d(v) = 0.9 - slope v with the brake and the resistance
    theta = [0.9, 0.0, 0.0, 0.0, -slope / 0.01, 0.0, 0.0, 0.0, 0.0]
    expected = 0.9 / slope**2 * math.log(0.9 / least) - 20.0 / slope
    assert Braking(form, theta, 1.0, 0.0).stop(20.0).distance == pytest.approx(expected, rel=1e-6)
