# SPDX-License-Identifier: Apache-2.0
"""Speed of the train some time ahead, for stated traction and brake commands, with its standard deviation.

    dv/dt = s F(t) / ((1 + gamma) M) - r(v) U(t) - k (a + i + b v + c v^2 + x(v) + z + y v^2)

in the notation of :mod:`stopping`; F is the force at the wheel rim as reported, s the force scale, and U follows the
commands after the dead time and the lag. The balance is integrated (midpoint rule) for the mean of all parameters, and
for each one standard deviation up and down, all at once: half the difference of the two is its share of the standard
deviation. Three shares are added: noise of the speed now, white noise of the motion, and the error of the map, which is
correlated over a length. Over the time t, with the time T in which the train runs this length, the latter is

    k std(i) T sqrt(2 (t / T - 1 + exp(-t / T))).

The train stands still where it is slowed down to zero; it does not roll back, and noise moves it only beyond the
impulse by which forces have held it since then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.client.stopping import DELAY, EXTRA_SPEEDS, GRADIENT, LAG, MAX_SPEED, NORMAL, A, C, StopPosterior

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.client.stopping import RateShape
    from trainid_ros.estimators.settings import BrakeRateConfig

    Array = NDArray[np.float64]
    Steps = Sequence[tuple[float, float]]

_STEP_S: Final = 0.5
"""Longest step of the integration [s]; the brake's lag is exact within it."""
_LONG_AGO_S: Final = 1e4  # no brake has a longer dead time [s]


@dataclass(frozen=True, slots=True)
class Plan:
    """What drives and brakes the train: values that hold from their time on [s from now], in rising times."""

    force: Steps  # Acceleration by the reported force [m/s^2], without the force scale; 0 before the first
    command: Steps  # Brake target [m/s^2, >= 0]; those given before now have times below 0
    applied: float  # Brake target before the first, which acts now with the lag [m/s^2, >= 0]


def predicted_speeds(
    speed: float, horizons: Sequence[float], plan: Plan, shape: RateShape, known: StopPosterior,
    scale: tuple[float, float], config: BrakeRateConfig,
) -> list[tuple[float, float, float]]:  # fmt: skip
    """Return mean and standard deviation of the speed [m/s], and the way [m], at times from now on [s, > 0].

    ``scale`` is the force scale and its standard deviation [1]; ``shape`` and what is ``known`` are as for a stop.
    """
    theta, scales = _members(known, scale)
    count = math.ceil(max(horizons) / _STEP_S)
    times = np.linspace(0.0, max(horizons), count + 1)
    dt = float(times[1])
    force = np.diff(_integral(plan.force, times, 0.0)) / dt
    brake = _brake(plan, times, theta)
    rates = np.array([(v, *shape.parts(v)) for v in shape.knots(MAX_SPEED)]).T
    v, run, held = np.full(len(scales), speed), np.zeros(len(scales)), 0.0
    speeds, runs, margins = [v], [0.0], [0.0]
    for k in range(count):
        drive = scales * force[k] if force[k] > 0.0 else force[k]
        middle = np.maximum(0.0, v + 0.5 * dt * (drive - _deceleration(shape, rates, theta, v, brake[k], run)))
        middle_run = run + 0.25 * dt * (v + middle)
        unbounded = v + dt * (drive - _deceleration(shape, rates, theta, middle, brake[k], middle_run))
        after = np.maximum(0.0, unbounded)
        held = max(0.0, held - float(unbounded[0])) if after[0] == 0.0 else 0.0
        run = run + 0.5 * dt * (v + after)
        v = after
        speeds.append(v)
        runs.append(float(run[0]))
        margins.append(held)
    members = np.array([[np.interp(t, times, column) for column in np.transpose(speeds)] for t in horizons])
    size = (len(scales) - 1) // 2
    shares = 0.5 * (members[:, 1 : 1 + size] - members[:, 1 + size :])
    passed, margin = (np.interp(horizons, times, x).tolist() for x in (runs, margins))
    moved = (_noise(t, run, shape.k, known, config) for t, run in zip(horizons, passed, strict=True))
    noise = [_beyond(held, std) for held, std in zip(margin, moved, strict=True)]
    stds = np.sqrt(np.sum(shares * shares, axis=1) + np.square(noise))
    return list(zip(members[:, 0].tolist(), stds.tolist(), passed, strict=True))


def _beyond(margin: float, std: float) -> float:
    """Return the rms of a speed by which noise exceeds the margin [m/s] that holds a train at rest; 0: it runs."""
    if margin == 0.0 or std == 0.0:
        return std
    z = margin / std
    return std * math.sqrt(max(0.0, (1.0 + z * z) * NORMAL.cdf(-z) - z * NORMAL.pdf(z)))


def _members(known: StopPosterior, scale: tuple[float, float]) -> tuple[Array, Array]:
    """Return parameters (9, n) and force scales (n,): the mean, then all one std up, then all one std down."""
    roots = np.zeros((10, 10))
    roots[range(9), range(9)] = np.sqrt(known.variances)
    roots[GRADIENT, GRADIENT] = 0.0  # the map has a share of its own
    values, vectors = np.linalg.eigh(np.reshape(known.davis, (3, 3)))
    roots[A : C + 1, A : C + 1] = vectors * np.sqrt(np.maximum(values, 0.0))
    roots[9, 9] = scale[1]
    mean = np.array([*known.mean, scale[0]])[:, None]
    members = np.hstack((mean, mean + roots, mean - roots))
    members[DELAY : LAG + 1] = np.maximum(members[DELAY : LAG + 1], 0.0)
    return members[:9], members[9]


def _integral(steps: Steps, times: Array, before: float) -> Array:
    """Return an integral over time, up to each time, of values that hold from their time on, and of one before them."""
    edges = [-_LONG_AGO_S, *(t for t, _ in steps), math.inf]
    values = [before, *(value for _, value in steps)]
    out = np.zeros_like(times)
    for value, start, end in zip(values, edges, edges[1:], strict=False):
        out += value * np.clip(times - start, 0.0, end - start)
    return out


def _brake(plan: Plan, times: Array, theta: Array) -> Array:
    """Return the mean brake target over each step, of each member, shape (steps, n) [m/s^2]."""
    dt, tau = float(times[1]), np.maximum(theta[LAG], 1e-3)
    decay = np.exp(-dt / tau)
    wanted = _integral(plan.command, times[:, None] - theta[DELAY], plan.applied)
    target, out, means = np.diff(wanted, axis=0) / dt, np.full(theta.shape[1], plan.applied), []
    for row in target:
        means.append(row + (out - row) * tau / dt * (1.0 - decay))
        out = row + (out - row) * decay
    return np.array(means)


def _deceleration(shape: RateShape, rates: Array, theta: Array, v: Array, brake: Array, run: Array) -> Array:
    """Return the deceleration of each member [m/s^2]; ``rates`` are knots of the speed, and s, p and m there."""
    f, e, h, a, b, c, i = theta[:DELAY]
    s, p, m = (np.interp(v, rates[0], part) for part in rates[1:])
    w = a + i + v * (b + v * c)
    if shape.resistances:
        w = w + np.interp(v, EXTRA_SPEEDS, shape.resistances)
    if shape.ahead:
        w = w + np.interp(run, shape.ahead, shape.at_place) + v * v * np.interp(run, shape.ahead, shape.by_square)
    out: Array = s * (f + e * p + h * m) * brake + shape.k * w
    return out


def _noise(t: float, run: float, k: float, known: StopPosterior, config: BrakeRateConfig) -> float:
    """Return the std that noise of speed and motion, and the error of the map on the way [m], add in a time [s]."""
    passed = run / config.disturbance_length
    by_map = k * math.sqrt(known.variances[GRADIENT]) * t
    if passed > 1e-3:
        by_map *= math.sqrt(2.0 * (passed - 1.0 + math.exp(-passed))) / passed
    return math.hypot(config.speed_std, config.acceleration_noise * math.sqrt(t), by_map)
