# SPDX-License-Identifier: Apache-2.0
"""The exact brake response compared with fine numerical integration, and with itself in two steps."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.brake_rate.motion_model import brake_step
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.forces import BrakeCommandChange, CommandHistory
from trainid_ros.train.train_file import Brake

START = 1_700_000_000 * NS_PER_S


def history(rng: np.random.Generator) -> CommandHistory:
    stamps = np.cumsum(rng.integers(20_000_000, 400_000_000, 30))
    changes = [BrakeCommandChange(START + int(s), -float(rng.uniform(0.0, 1.0))) for s in stamps]
    commands = CommandHistory()
    for change in changes:
        commands.push(change)
    return commands


def integrate(
    commands: CommandHistory, brake: Brake, start_ns: int, end_ns: int, *, initial: float, rate: float
) -> tuple[float, float]:
    """Return (a at the end, gain of v) by the midpoint rule in steps of 0.1 ms."""
    step = 100_000
    a, v = initial, 0.0
    h = step / NS_PER_S
    for t in range(start_ns, end_ns, step):
        u = rate * commands.value(t + step // 2 - round(brake.delay * NS_PER_S))
        middle = a + 0.5 * h * (u - a) / brake.time_constant
        v += h * middle
        a += h * (u - middle) / brake.time_constant
    return a, v


@pytest.mark.parametrize('seed', range(3))
def test_the_response_equals_fine_integration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    commands, brake = history(rng), Brake(1.0, 0.4, 0.63)
    start = START + 1_000_000_000 + int(rng.integers(0, 10**6)) * 1000
    initial, rate = -0.35, 0.8
    step = brake_step(commands, brake.delay, brake.time_constant, start, start + 700_000_000, initial)
    a, v = integrate(commands, brake, start, start + 700_000_000, initial=initial, rate=rate)
    # A change of command within a step of 0.1 ms changes a by about 1e-4 / 0.4 of its size at most.
    assert step.decay * initial + rate * step.gain_a == pytest.approx(a, abs=5e-4)
    assert step.reach * initial + rate * step.gain_v == pytest.approx(v, abs=5e-4)


def test_two_intervals_compose_to_one() -> None:
    commands, brake = history(np.random.default_rng(9)), Brake(1.0, 0.4, 0.6)
    edges = [START + 1_000_000_000, START + 1_313_131_313, START + 2_000_000_001]
    first, second, total = (
        brake_step(commands, brake.delay, brake.time_constant, edges[i], edges[k], 0.0)
        for i, k in ((0, 1), (1, 2), (0, 2))
    )
    a0, f = -0.2, 0.9
    a1 = first.decay * a0 + f * first.gain_a
    a2 = second.decay * a1 + f * second.gain_a
    v = first.reach * a0 + f * first.gain_v + second.reach * a1 + f * second.gain_v
    assert total.decay * a0 + f * total.gain_a == pytest.approx(a2, rel=1e-12)
    assert total.reach * a0 + f * total.gain_v == pytest.approx(v, rel=1e-12)


def test_the_dead_time_is_exact() -> None:
    commands = CommandHistory((BrakeCommandChange(START, -1.0),))
    brake = Brake(1.0, 0.4, 0.6)
    before = brake_step(commands, brake.delay, brake.time_constant, START, START + 600_000_000, 0.0)
    assert (before.gain_a, before.gain_v) == (0.0, 0.0)
    after = brake_step(commands, brake.delay, brake.time_constant, START, START + 1_000_000_000, -0.5)
    assert after.gain_a == pytest.approx(np.exp(-1.0) - 1.0, rel=1e-12)
    assert after.end_target == pytest.approx(-0.5 * np.exp(-2.5) + after.gain_a, rel=1e-12)
    assert after.gain_v == pytest.approx(-(0.4 - 0.4 * (1.0 - np.exp(-1.0))), rel=1e-12)


def test_a_brake_without_lag_follows_at_once() -> None:
    commands = CommandHistory((BrakeCommandChange(START, -1.0),))
    step = brake_step(commands, 0.0, 0.0, START, START + NS_PER_S // 2, -0.7)
    assert (step.decay, step.reach, step.gain_a, step.gain_v) == (0.0, 0.0, -1.0, -0.5)
