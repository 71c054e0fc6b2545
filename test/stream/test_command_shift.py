# SPDX-License-Identifier: Apache-2.0
"""Steps of the acceleration that come later or sooner than those of a nominal brake."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.stream.brake_application import BrakeApplication
from trainid_ros.stream.command_shift import BrakeTiming, CommandShift
from trainid_ros.train.brake import lag_response

TIMING = BrakeTiming(delay=0.6, lag=0.4, std=0.1)
PERIOD_S = 0.1


def braked(seconds: float = 300.0) -> tuple[list[float], list[float]]:
    """Return the force of a command that changes now and then, and that of the brake which follows it."""
    rng = np.random.default_rng(7)
    steps = np.repeat(rng.choice((0.0, -30.0, -60.0, -90.0), round(seconds / 5.0)), round(5.0 / PERIOD_S)).tolist()
    behind, force, forces = round(TIMING.delay / PERIOD_S), 0.0, []
    for k in range(len(steps)):
        force = lag_response(force, steps[max(k - behind, 0)], TIMING.lag, PERIOD_S)
        forces.append(force)
    return steps, forces


def followed(late_s: float) -> CommandShift:
    """Return the check after a drive whose command is late by so much, the speed for a negative time."""
    commands, forces = braked()
    shift, check = round(late_s / PERIOD_S), CommandShift()
    rng = np.random.default_rng(8)
    noise = rng.normal(0.0, 1.0, len(commands)).tolist()
    for k in range(max(0, shift), len(commands) + min(0, shift)):
        check.follow(PERIOD_S * (forces[k] + noise[k]), commands[k - shift], forces[k], PERIOD_S, TIMING)
    return check


@pytest.mark.parametrize(('late_s', 'later'), [(1.0, 'ato/brake_command'), (-1.5, 'ato/speed')])
def test_a_command_that_is_late_is_named_with_its_delay(late_s: float, later: str) -> None:
    check = followed(late_s)
    assert check.finding.startswith(f'{later} is about')
    assert check.delay == pytest.approx(-late_s, abs=0.2)


@pytest.mark.parametrize('late_s', [-0.4, 0.0, 0.4])
def test_what_the_stated_times_of_the_brake_explain_is_no_finding(late_s: float) -> None:
    check = followed(late_s)
    assert check.finding == ''
    assert check.edges > 0.0


def test_the_stated_uncertainty_of_the_times_widens_the_limit() -> None:
    check = CommandShift()
    for _ in range(10):
        check.follow(0.0, 0.0, 0.0, PERIOD_S, BrakeTiming(0.6, 0.4, 0.5))
    assert check.limit > 1.5


def test_after_a_pause_a_brake_that_acts_is_no_step() -> None:
    check = CommandShift()
    for _ in range(100):
        check.follow(0.0, 0.0, 0.0, PERIOD_S, TIMING)
    check.pause()
    for _ in range(100):
        check.follow(-60.0 * PERIOD_S, -60.0, -60.0, PERIOD_S, TIMING)
    assert check.edges == 0.0
    assert check.lagged == pytest.approx(-60.0)


@pytest.mark.parametrize('delay_s', [0.3, 0.9])
def test_the_impulse_of_an_application_does_not_depend_on_the_times_of_the_brake(delay_s: float) -> None:
    check, ended = CommandShift(), None
    commands = [0.0] * 30 + [-60.0] * 20 + [0.0] * 60
    behind, force = round(delay_s / PERIOD_S), 0.0
    for k, command in enumerate(commands):
        force = lag_response(force, commands[max(k - behind, 0)], TIMING.lag, PERIOD_S)
        check.follow(0.5 * force * PERIOD_S, command, 0.7 * force, PERIOD_S, TIMING)
        ended = ended or check.ended(moves=True)
    assert ended is not None
    assert ended.by_force / ended.by_command == pytest.approx(0.7, rel=0.1)
    assert ended.by_speed / ended.by_command == pytest.approx(0.5, rel=0.1)


def test_an_application_ends_where_the_train_stops_and_a_weak_one_says_nothing() -> None:
    check = CommandShift(application=BrakeApplication(-61.0, -30.0, -30.0))
    assert check.ended(moves=True) is None
    assert check.ended(moves=False) is not None
    assert check.ended(moves=False) is None
    check.application = BrakeApplication(-59.0, -30.0, -30.0)
    assert check.ended(moves=False) is None
    assert check.application.by_command == 0.0


def test_a_shift_found_before_is_suspected_until_steps_contradict_it() -> None:
    check = CommandShift(delay=-1.0)
    assert check.is_suspected
    commands, forces = braked()
    for command, force in zip(commands, forces, strict=True):
        check.follow(PERIOD_S * force, command, force, PERIOD_S, TIMING)
    assert not check.is_suspected
    assert math.isclose(check.delay, 0.0)
