# SPDX-License-Identifier: Apache-2.0
"""Algorithm 1 of Xia et al. 2023 as printed: Newton's method with box bounds, Wolfe conditions and random restarts.

For comparison only. From random starts it rarely converges: H is indefinite over nearly all of the box, so that (24)
has no solution, and steps get stuck at the bounds. :mod:`levenberg` solves the same problem from any start.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from trainid_lab.resistance.trajectory.stages import Objective

_FINEST: Final = 1e-4

Triple: TypeAlias = tuple[float, float, float]


class Restart(Enum):
    """When parameters are redrawn: never, after small steps (section 3.3), after each step (step 11 as listed)."""

    NEVER = 'never'
    SMALL_STEP = 'small step'
    EVERY_STEP = 'every step'


class Stop(Enum):
    """Why the algorithm ended."""

    FITTED = 'fitted'
    ASCENT = 'ascent direction'
    NO_STEP = 'no step length'
    SINGULAR = 'singular Hessian'
    SMALL_STEP = 'small step'
    LIMIT = 'iterations'


@dataclass(frozen=True, slots=True)
class NewtonConfig:
    """Settings of Table 2, and those that it does not define."""

    most: int = 100  # N, maximum number of iterations
    low: Triple = (0.4, 0.0, 0.0)  # theta_min [N/kN, v in m/s]
    high: Triple = (3.0, 0.2, 0.01)  # theta_max [N/kN, v in m/s]
    c1: float = 0.1  # Sufficient-decrease constant of (24)
    c2: float = 0.9  # Curvature constant of (24)
    accepted: float = 0.05  # epsilon_1 of (25) [(m/s)^2]
    small: Triple = (1e-5, 1e-6, 1e-7)  # Delta theta_T, below which a step counts as stuck
    apart: Triple = (0.1, 0.002, 0.0001)  # Delta theta hat, the minimum difference of a random restart
    shrink: float = 0.5  # Factor from one step length to the next one tried
    restart: Restart = Restart.SMALL_STEP  # When to redraw the parameters


@dataclass(frozen=True, slots=True)
class NewtonOutcome:
    """Last parameters, their objective [(m/s)^2], number of iterations, and reason of termination."""

    theta: NDArray[np.float64]
    f: float
    iterations: int
    stop: Stop


def newton(
    evaluate: Callable[[NDArray[np.float64]], Objective],
    first: NDArray[np.float64],
    config: NewtonConfig,
    rng: np.random.Generator,
) -> NewtonOutcome:
    """Run Algorithm 1.

    Args:
        evaluate: (8), (11) and (16) at parameters of shape (3,).
        first: theta_1.
        config: Table 2.
        rng: Random generator of the restarts.

    """
    theta, now = first, evaluate(first)
    for n in range(1, config.most + 1):
        moved = _step(evaluate, theta, now, config)
        if isinstance(moved, Stop):
            if config.restart is Restart.NEVER:
                return NewtonOutcome(theta, now.f, n, moved)
            after, stuck = theta, True
        else:
            after, stuck = moved, bool(np.all(np.abs(moved - theta) < config.small))
        now = evaluate(after)
        # (25)
        if now.f < config.accepted:
            return NewtonOutcome(after, now.f, n, Stop.FITTED)
        if stuck and config.restart is Restart.NEVER:
            return NewtonOutcome(after, now.f, n, Stop.SMALL_STEP)
        theta = after
        if config.restart is Restart.EVERY_STEP or (stuck and config.restart is Restart.SMALL_STEP):
            theta = _draw(theta, config, rng)
            now = evaluate(theta)
    return NewtonOutcome(theta, now.f, config.most, Stop.LIMIT)


def _step(
    evaluate: Callable[[NDArray[np.float64]], Objective],
    theta: NDArray[np.float64],
    now: Objective,
    config: NewtonConfig,
) -> NDArray[np.float64] | Stop:
    """Return the result of step 10: the full step if it stays in the box, else one shortened to satisfy (24) too."""
    try:
        direction = np.linalg.solve(now.H, now.g)
    except np.linalg.LinAlgError:
        return Stop.SINGULAR
    # (10)
    full = theta - direction
    if _inside(full, config):
        return full
    slope = float(now.g @ direction)
    if slope <= 0.0:
        return Stop.ASCENT
    alpha = config.shrink
    while alpha > _FINEST:
        trial = theta - alpha * direction
        if _inside(trial, config):
            there = evaluate(trial)
            # (24)
            decreases = there.f <= now.f - config.c1 * alpha * slope
            if decreases and float(there.g @ direction) <= config.c2 * slope:
                return trial
        alpha *= config.shrink
    return Stop.NO_STEP


def _inside(theta: NDArray[np.float64], config: NewtonConfig) -> bool:
    return bool(np.all(theta >= config.low) and np.all(theta <= config.high))


def _draw(theta: NDArray[np.float64], config: NewtonConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return uniformly drawn parameters in the box, not near the last ones."""
    while True:
        drawn = rng.uniform(config.low, config.high)
        if np.all(np.abs(drawn - theta) > config.apart):
            return drawn
