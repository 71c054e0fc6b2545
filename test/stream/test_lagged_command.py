# SPDX-License-Identifier: Apache-2.0
"""The lagged brake command and its integral."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.stream.brake_checks import LaggedCommand
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange

TAU = 0.7


def follow(lag: LaggedCommand, sample: Callable[..., Sample], first: int, count: int, command: float) -> None:
    for k in range(first, first + count):
        item = sample(k, brake_command=command)
        changes = (BrakeCommandChange(item.stamp_ns - 200_000_000, command),) if k == first else ()
        lag.follow(replace(item, brake_changes=changes), TAU, 60.0)


def test_it_is_the_response_to_a_step(sample: Callable[..., Sample]) -> None:
    lag = LaggedCommand()
    lag.begin()
    follow(lag, sample, 1, 15, -0.8)
    time_s = 15 * 0.2
    assert lag.lagged == pytest.approx(-0.8 * (1.0 - math.exp(-time_s / TAU)), rel=1e-9)
    assert lag.integral == pytest.approx(-0.8 * (time_s - TAU * (1.0 - math.exp(-time_s / TAU))), rel=1e-9)


def test_its_integral_is_known_at_earlier_times_and_goes_on(sample: Callable[..., Sample]) -> None:
    lag = LaggedCommand()
    lag.begin()
    follow(lag, sample, 1, 15, -0.8)
    at_2_s = -0.8 * (2.0 - TAU * (1.0 - math.exp(-2.0 / TAU)))
    assert lag.integral_at(2.0) == pytest.approx(at_2_s, rel=1e-9)
    assert lag.integral_at(-1.0) == 0.0
    assert lag.integral_at(4.0) == pytest.approx(lag.integral + lag.lagged, rel=1e-9)


def test_it_rests_once_released(sample: Callable[..., Sample]) -> None:
    lag = LaggedCommand()
    lag.begin()
    follow(lag, sample, 1, 15, -0.8)
    assert lag.rest_s == 0.0
    follow(lag, sample, 16, 50, 0.0)
    assert lag.rest_s == pytest.approx(10.0 - TAU * math.log(0.8 / 1e-3), abs=0.4)
