# SPDX-License-Identifier: Apache-2.0
"""Algorithm 1: it descends if the problem is convex, stays in its box, and ends with a stated reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_lab.resistance.trajectory.newton import NewtonConfig, NewtonOutcome, Restart, Stop, newton
from trainid_lab.resistance.trajectory.stages import Objective

Evaluate: TypeAlias = Callable[[NDArray[np.float64]], Objective]

H = np.diag([2.0, 3000.0, 4e6])
CONFIG = replace(NewtonConfig(), accepted=1e-12, restart=Restart.NEVER)


def quadratic(at: NDArray[np.float64]) -> Evaluate:
    def evaluate(x: NDArray[np.float64]) -> Objective:
        return Objective(float(0.5 * (x - at) @ H @ (x - at)), H @ (x - at), H)

    return evaluate


def run(evaluate: Evaluate, config: NewtonConfig = CONFIG) -> NewtonOutcome:
    return newton(evaluate, np.array([2.0, 0.1, 0.005]), config, np.random.default_rng(0))


def test_a_quadratic_is_minimised_in_one_step() -> None:
    done = run(quadratic(np.array([1.0, 0.02, 0.001])))
    assert (done.stop, done.iterations) == (Stop.FITTED, 1)


def test_no_step_leaves_the_box() -> None:
    done = run(quadratic(np.array([0.1, 0.02, 0.001])))
    assert done.stop in (Stop.NO_STEP, Stop.SMALL_STEP)
    assert done.theta[0] >= CONFIG.low[0]


def test_an_ascent_direction_has_no_step_length() -> None:
    def evaluate(_: NDArray[np.float64]) -> Objective:
        return Objective(1.0, np.array([1.0, 0.0, 0.0]), np.diag([-1e-3, 1.0, 1.0]))

    assert run(evaluate).stop is Stop.ASCENT


@pytest.mark.parametrize('restart', [Restart.SMALL_STEP, Restart.EVERY_STEP])
def test_restarts_stay_in_the_box_and_reach_the_limit(restart: Restart) -> None:
    config = replace(CONFIG, restart=restart, most=20)
    done = run(quadratic(np.array([-5.0, 0.02, 0.001])), config)
    assert (done.stop, done.iterations) == (Stop.LIMIT, 20)
    assert np.all(done.theta >= config.low)
    assert np.all(done.theta <= config.high)
