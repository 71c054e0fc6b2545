# SPDX-License-Identifier: Apache-2.0
"""Resistance, and the brake actuator: exact dead time and lag."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.train.forces import (
    MAX_CHANGES,
    BrakeCommandChange,
    CommandHistory,
    G,
    acceleration,
    davis,
    lag_integral,
    lag_response,
    required_force,
    specific_force,
    specific_inertia,
)
from trainid_ros.train.train_file import Davis


def history(*changes: tuple[int, float]) -> CommandHistory:
    out = CommandHistory()
    for stamp_ns, target in changes:
        out.push(BrakeCommandChange(stamp_ns, target))
    return out


def test_a_command_applies_from_its_stamp_on() -> None:
    commands = history((10, -1.0), (20, -0.5))
    assert [commands.value(t) for t in (9, 10, 19, 20, 10**12)] == [0.0, -1.0, -1.0, -0.5, -0.5]


def test_segments_cover_the_interval_without_gap() -> None:
    second = 1_000_000_000
    commands = history((second, -1.0), (3 * second, -0.5), (4 * second, 0.0))
    assert commands.segments(0, 5 * second) == [(1.0, 0.0), (2.0, -1.0), (1.0, -0.5), (1.0, 0.0)]
    assert commands.segments(second, 3 * second) == [(2.0, -1.0)]
    assert commands.segments(3 * second, 3 * second) == []
    assert CommandHistory().segments(0, second) == [(1.0, 0.0)]


def test_repeats_are_dropped_and_equal_stamps_replaced() -> None:
    assert len(history((10, -1.0), (20, -1.0)).changes) == 1
    assert history((10, -1.0), (20, -0.2), (20, -0.5)).changes[-1] == BrakeCommandChange(20, -0.5)
    assert len(history((10, -1.0), (20, -0.2), (20, -1.0)).changes) == 1


@pytest.mark.parametrize('target', [0.1, math.nan, -math.inf])
def test_an_invalid_target_acceleration_is_rejected(target: float) -> None:
    with pytest.raises(InputError, match='target_acceleration'):
        history((10, target))


def test_times_out_of_order_are_rejected() -> None:
    with pytest.raises(InputError, match='stamp_ns = 9 is earlier than the last one, 10'):
        history((10, -1.0), (9, -0.5))
    with pytest.raises(InputError, match='before its start'):
        history((10, -1.0)).segments(5, 4)


def test_pruning_keeps_every_value_from_the_given_time_on() -> None:
    commands, pruned = (history(*((10 * i, -0.1 * i) for i in range(1, 20))) for _ in range(2))
    pruned.prune(95)
    assert len(pruned.changes) == 11
    assert all(pruned.value(t) == commands.value(t) for t in range(95, 250))
    pruned.prune(0)
    assert len(pruned.changes) == 11


def test_the_history_is_bounded() -> None:
    commands = history(*((i, -0.1 * (1 + i % 2)) for i in range(MAX_CHANGES + 50)))
    assert len(commands.changes) == MAX_CHANGES
    assert commands.value(10**9) == -0.2


def test_lag_against_hand_calculation() -> None:
    # tau = 0.4 s, 0 -> -1 m/s^2: after 0.4 s the output is -(1 - 1/e).
    assert lag_response(0.0, -1.0, 0.4, 0.4) == pytest.approx(-(1 - math.exp(-1)), rel=1e-15)
    assert lag_response(-0.3, -1.0, 0.4, 0.0) == -0.3
    assert lag_response(-0.3, -1.0, 0.0, 0.1) == -1.0


def test_lag_integral_is_the_integral_of_the_response() -> None:
    # Simpson's rule on 200 intervals has an error of about (h/tau)^4/180 ~ 1e-12 of the integral.
    t = np.linspace(0.0, 1.3, 201)
    y = np.array([lag_response(-0.2, -1.0, 0.7, float(x)) for x in t])
    weights = np.ones(201)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    simpson = float(weights @ y) * (t[1] - t[0]) / 3.0
    assert lag_integral(-0.2, -1.0, 0.7, 1.3) == pytest.approx(simpson, rel=1e-10)
    assert lag_integral(-0.2, -1.0, 0.0, 1.3) == pytest.approx(-1.3)
    assert lag_integral(-0.2, -1.0, 0.7, 0.0) == 0.0


def test_resistance_and_acceleration_against_hand_calculation() -> None:
    assert davis(Davis(1.0, 0.03, 0.003), 20.0) == pytest.approx(1.0 + 0.6 + 1.2)
    assert davis(Davis(1.0, 0.03, 0.003), np.array([0.0, 10.0])) == pytest.approx([1.0, 1.6])
    # 200 t, 98.0665 kN: 50 N/kN; resistance takes 10 N/kN, the remaining 40 N/kN accelerate 1.08 times the mass.
    force = 0.05 * 200e3 * G
    assert specific_force(force, 200e3) == pytest.approx(50.0)
    assert acceleration(force, 200e3, 0.08, 10.0) == pytest.approx(0.04 * G / 1.08)
    assert specific_inertia(0.04 * G / 1.08, 0.08) == pytest.approx(40.0)
    assert required_force(0.04 * G / 1.08, 200e3, 0.08, 10.0) == pytest.approx(force, rel=1e-12)
