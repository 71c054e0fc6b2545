# SPDX-License-Identifier: Apache-2.0
"""Predicted speeds are those of the simulated train, with the standard deviation that follows from what is known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.client import TrainModel
from trainid_ros.client.prediction import Plan, predicted_speeds
from trainid_ros.client.stopping import RateShape, StopPosterior
from trainid_ros.estimators.settings import GsmaConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import BrakeRateEstimate, Output, Status
from trainid_ros.sim.plant import Plant
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, load_train_file

METRO = load_train_file(Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml')
EMU = replace(METRO, brake=Brake(delay=0.8, time_constant=0.6, rate_table=((2.0, 1.25), (14.0, 0.6), (25.0, 0.4))))
TIMES = (5.0, 9.7, 30.0, 60.0)


@pytest.mark.parametrize(
    ('file', 'direction', 'position'), [(METRO, 1, 3000.0), (METRO, -1, 19500.0), (EMU, 1, 7000.0)]
)
def test_the_speed_is_that_of_the_simulator(file: Any, direction: int, position: float) -> None:
    """Power, coasting, and two steps of the brake, on a hilly line."""
    force, command = ((0.0, 90e3), (7.3, 0.0)), ((0.0, 0.0), (20.0, -0.3), (27.0, -0.6), (33.0, 0.0))
    found = TrainModel(None, file).predict(
        TIMES, speed=14.0, force=force, command=command, position=position, direction=direction
    )
    train = Plant(file, LineProfile(file.line, file.train.length), NS_PER_S, 1e3)
    train.speed, train.position, train.direction = 14.0, position, direction
    speeds, commands = [14.0], dict(command)
    for k in range(3000):
        if k * 0.02 in commands:
            train.command(commands[k * 0.02])
        train.step(90e3 if k * 0.02 < 7.3 else 0.0)
        speeds.append(train.speed)
    for time, value in zip(TIMES, found, strict=True):
        assert value.value == pytest.approx(speeds[round(time / 0.02)], abs=0.03)


SHAPE = RateShape([], [], 22.0, 2.5, 0.009)
STILL = replace(GsmaConfig(), speed_std=0.0, acceleration_noise=0.0)
NOTHING = Plan([], [], 0.0)


def known(**variances: float) -> StopPosterior:
    places = {'rate': 0, 'gradient': 6, 'delay': 7, 'lag': 8}
    every = [0.0] * 9
    for name, value in variances.items():
        if name in places:
            every[places[name]] = value
    a = variances.get('a', 0.0)
    return StopPosterior((0.9, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.6, 0.4), tuple(every), (a, *[0.0] * 8))


@pytest.mark.parametrize(
    ('plan', 'posterior', 'scale_std', 'std'),
    [
        (NOTHING, known(a=0.04), 0.0, 0.009 * 0.2 * 20.0),
        (NOTHING, known(a=0.04), 0.1, 0.009 * 0.2 * 20.0),  # without force its scale does not matter
        (Plan([(0.0, 0.3)], [], 0.0), known(), 0.01, 0.01 * 0.3 * 20.0),
        (Plan([], [(-9.0, 0.5)], 0.5), known(rate=0.02**2), 0.0, 0.02 * 0.5 * 20.0),
        (Plan([], [(0.0, 0.5)], 0.0), known(delay=0.1**2), 0.0, 0.9 * 0.5 * 0.1),
        (Plan([], [(0.0, 0.5)], 0.0), known(lag=0.05**2), 0.0, 0.9 * 0.5 * 0.05),
    ],
)
def test_each_parameter_has_its_share_of_the_std(
    plan: Plan, posterior: StopPosterior, scale_std: float, std: float
) -> None:
    ((_, found, _),) = predicted_speeds(40.0, [20.0], plan, SHAPE, posterior, (1.0, scale_std), STILL)
    assert found == pytest.approx(std, rel=0.01, abs=1e-9)


def test_the_error_of_the_map_averages_out_over_its_correlation_length() -> None:
    posterior = known(gradient=0.5**2)
    (_, soon, _), (_, late, _) = predicted_speeds(40.0, [0.5, 300.0], NOTHING, SHAPE, posterior, (1.0, 0.0), STILL)
    assert soon == pytest.approx(0.009 * 0.5 * 0.5, rel=0.03)
    lengths = (40.0 - 0.5 * 0.018 * 300.0) * 300.0 / 200.0  # it slows down by 0.018 m/s^2
    assert late == pytest.approx(0.009 * 0.5 * 300.0 * math.sqrt(2.0 / lengths), rel=0.02)


def test_noise_of_speed_and_motion_count() -> None:
    config = replace(GsmaConfig(), speed_std=0.03, acceleration_noise=0.02)
    ((_, std, _),) = predicted_speeds(20.0, [4.0], NOTHING, SHAPE, known(), (1.0, 0.0), config)
    assert std == pytest.approx(math.hypot(0.03, 0.02 * 2.0))


def test_a_train_that_has_stopped_stands_until_it_is_driven() -> None:
    model = TrainModel(None, METRO)
    braked = model.predict((10.0, 59.0), speed=5.0, command=-0.8)
    assert [value.value for value in braked] == [0.0, 0.0]
    again = model.predict((10.0, 59.0), speed=5.0, command=((0.0, -0.8), (20.0, 0.0)), force=((30.0, 200e3),))
    assert again[0].value == 0.0
    assert again[1].value > 10.0


def test_noise_does_not_move_a_train_that_is_held() -> None:
    model = TrainModel(None, METRO)
    stds = [value.std for value in model.predict((8.5, 9.5, 40.0), speed=8.0, command=-1.0)]
    assert stds[0] > stds[1] > stds[2]
    assert stds[2] < 1e-3


def test_a_command_given_before_now_acts_sooner() -> None:
    model = TrainModel(None, METRO)
    now, before, long_ago = (
        model.predict((3.0,), speed=15.0, command=((time, -0.8),), applied=applied)[0].value
        for time, applied in ((0.0, 0.0), (-0.4, 0.0), (-0.6, -0.8))
    )
    assert now - before == pytest.approx(0.8 * 0.4, abs=0.03)
    assert before - long_ago == pytest.approx(0.8 * (0.2 + 0.4), abs=0.05)


def test_it_is_live_if_what_acts_is() -> None:
    model = TrainModel(None, METRO, clock=lambda: 0.0)
    rate = BrakeRateEstimate(1.0, 0.02, math.nan, 10.0, 0.0, 0.0, 50.0, False, 0.0, 0.01, 0.1)
    model.take(Output(1, rate, Status.VALID, 1, 0, None))
    (coasting,), (braking,) = (model.predict((5.0,), speed=10.0, command=u) for u in (0.0, -0.5))
    assert (coasting.live, coasting.reason) == (False, 'train file: no estimate yet')
    assert (braking.live, 'brake rate VALID' in braking.reason) == (False, True)


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        ({'horizons': (0.0,)}, '^horizon = 0 s'),
        ({'horizons': (5.0, 601.0)}, '^horizon = 601 s'),
        ({'speed': -1.0}, '^speed = '),
        ({'command': 0.5}, '^command = 0.5'),
        ({'force': math.nan}, '^force = nan'),
        ({'force': ((0.0, 1.0), (0.0, 2.0))}, '^force: its times must rise'),
        ({'force': ((-70.0, 1.0),)}, '^time of a force or command = -70'),
        ({'position': -500.0}, '^position = '),
    ],
)
def test_an_argument_that_cannot_be_is_named(arguments: dict[str, Any], reason: str) -> None:
    given: dict[str, Any] = {'horizons': (5.0,), 'speed': 10.0, **arguments}
    with pytest.raises(InputError, match=reason):
        TrainModel(None, METRO).predict(given.pop('horizons'), **given)


def test_a_way_that_leads_off_the_line_is_named() -> None:
    model = TrainModel(None, METRO)
    on, off = model.predict((5.0, 20.0), speed=20.0, position=22600.0)
    assert on.reason == 'train file: no estimate yet'
    assert off.reason == 'train file: no estimate yet; beyond the end of the line at 22846 m'


def test_one_time_gives_one_answer() -> None:
    model = TrainModel(None, METRO)
    assert model.predict(10.0, speed=5.0) == model.predict((10.0,), speed=5.0)[0]


@pytest.mark.parametrize('wrong', [(), None, 'soon', {}])
def test_a_wrong_time_is_named(wrong: Any) -> None:
    with pytest.raises(InputError, match='horizon = '):
        TrainModel(None, METRO).predict(wrong, speed=5.0)


@pytest.mark.parametrize('wrong', [(), None, (1.0, 2.0), ((0.0, 1.0, 2.0),)])
def test_a_wrong_plan_is_named(wrong: Any) -> None:
    with pytest.raises(InputError, match='force = '):
        TrainModel(None, METRO).predict(10.0, speed=5.0, force=wrong)
    with pytest.raises(InputError, match=r'command = 0\.5'):
        TrainModel(None, METRO).predict(10.0, speed=5.0, command=0.5)
