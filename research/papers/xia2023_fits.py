# SPDX-License-Identifier: Apache-2.0
"""Fits of full records of Xia et al. 2023: random starts without noise (Table 3), white noise (section 4.2.2).

Their equations and methods are here as printed, including errors, for comparison with the corrected ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from research.papers import highspeed_line as data
from research.papers.highspeed_line import INERTIA
from trainid_lab.resistance.trajectory.levenberg import integrated_least_squares, levenberg
from trainid_lab.resistance.trajectory.newton import NewtonConfig, Restart, newton
from trainid_lab.resistance.trajectory.stages import (
    PAIRS,
    Coefficients,
    Objective,
    Stages,
    assemble,
    first_derivatives,
    objective,
)
from trainid_ros.resistance.davis_fit import DavisFitConfig, Trajectory, fit_davis, recur

# Theta, final value of (8) if it decides, and iterations, from a start.
Fitted = tuple[NDArray[np.float64], float | None, int]
Fit = Callable[[NDArray[np.float64]], Fitted]


def printed_objective(
    stages: Stages, measured: NDArray[np.float64], theta: NDArray[np.float64], start: float
) -> Objective:
    """Return (8), (11), (16) with dv/da on the right of (14) and the flipped sign of q in (18)-(23)."""
    v = stages.speeds(theta, start)
    coefficients = Coefficients.along(stages, theta, v)
    first = first_derivatives(coefficients, v)[:3]
    last = np.concatenate((np.zeros((3, 1)), first[:, :-1]), axis=1)
    first[1] = coefficients.k * last[0] - coefficients.p * v[:-1]  # (14) as printed
    last[1, 1:] = first[1, :-1]
    powers = v[:-1] ** np.arange(3)[:, None]
    slope = np.vstack((np.zeros_like(powers[0]), powers[0], 2.0 * powers[1]))
    rows = [
        -coefficients.q * last[x] * last[y]
        - coefficients.u * first[x] * first[y]
        - coefficients.p * (slope[y] * last[x] + slope[x] * last[y])
        for x, y in PAIRS
    ]
    return assemble(v[1:] - measured, first, recur(coefficients.k, np.array(rows)))


def full_steps(
    stages: Stages, measured: NDArray[np.float64], theta: NDArray[np.float64], accepted: float, most: int = 50
) -> tuple[NDArray[np.float64], float, int]:
    """Run Gauss-Newton with full steps, no box, v_0 as measured, ended by (25); explains the published iterations."""
    f = np.inf
    for n in range(most):
        v = stages.speeds(theta, float(measured[0]))
        error = measured[1:] - v[1:]
        f = float(error @ error) / error.size
        if f < accepted or not np.max(v) < 1e3:
            return theta, f, n
        first = first_derivatives(Coefficients.along(stages, theta, v), v)[:3]
        scale = np.array([1.0, 0.02, 0.001])
        theta = theta + scale * np.linalg.lstsq(first.T * scale, error)[0]
        theta = np.clip(theta, -1e3, 1e3)
    return theta, f, most


def differenced_least_squares(stages: Stages, measured: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return a, b, c of (2): resistance from speed differences."""
    slope = np.diff(measured * measured) / (2.0 * spacing)  # dv/dt = v dv/ds
    y = stages.drive - INERTIA * slope
    phi = measured[:-1, None] ** np.arange(3)
    return np.asarray(np.linalg.lstsq(phi, y)[0])


KINDS: Final = ('cruise', 'full')
CASES: Final = (
    (0.79, 0.0229, 0.001493),
    (0.2955, 0.0242, 0.00159),
    (1.0501, 0.0253, 0.00140),
    (0.3488, 0.0596, 0.00112),
)
NOISE: Final = 0.18
DISTANCE: Final = 120e3
DRAWS: Final = 4
WHITE: Final = DavisFitConfig(
    speed_std=NOISE, disturbance_std=1e-3, learn_noise=False, force_skew=1e-9, force_error=1e-9, force_jitter=0.0,
    huber=1e6, cut=1e6,
)  # fmt: skip
"""Settings of the batch fit for white noise only."""
_LINE_SEED: Final = 5000
_STARTS: Final = 50
_ALGORITHM_STARTS: Final = 20
_RESTARTED: Final = 3


@cache
def record(kind: str, case: int, source: str) -> data.Record:
    """Return a record of 120 km; source is 'scheme' (7) or 'ode'."""
    rng = np.random.default_rng(_LINE_SEED)
    line, cruise, full = data.make_line(rng), data.cruise_plan(rng), data.full_plan(rng)
    drive = data.drive_scheme if source == 'scheme' else data.drive_ode
    return drive(line, cruise if kind == 'cruise' else full, lambda _: CASES[case], DISTANCE)


def in_time(record: data.Record, measured: NDArray[np.float64]) -> Trajectory:
    """Return a record in the form of the product: intervals, speeds and means in time."""
    first = np.zeros(1)
    return Trajectory(
        speed=measured,
        dt=np.concatenate((first, np.diff(record.time))),
        known=np.concatenate((first, record.time_mean - record.load_time_mean)),
        traction=np.concatenate((first, record.time_mean)),
        inertia=data.INERTIA,
    )


@dataclass(frozen=True, slots=True)
class Tally:
    """Runs of one method: solved, total, iterations of solved runs, greatest error of a [N/kN], time per run [ms]."""

    method: str
    solved: int
    runs: int
    iterations: tuple[int, ...]
    error_a: float
    milliseconds: float


def noise_free(task: int) -> tuple[str, list[Tally]]:
    """Run all methods on one case of one record, generated by (7); tasks 0 to 7."""
    kind, case = KINDS[task // 4], task % 4
    rng = np.random.default_rng(5000 + task)
    given, truth = record(kind, case, 'scheme'), np.array(CASES[case])
    stages, speed = given.stages(), given.speed
    config = replace(NewtonConfig(), accepted=1e-5)
    starts = rng.uniform(config.low, config.high, (_STARTS, 3))

    def tally(method: str, fit: Fit, count: int) -> Tally:
        """Fit from some starts; without a final value of (8) a fit is solved if it is exact to 1e-9."""
        runs = []
        for start in starts[:count]:
            begun = time.thread_time()
            theta, f, iterations = fit(start)
            milliseconds = 1e3 * (time.thread_time() - begun)
            good = bool(np.max(np.abs(theta - truth)) < 1e-9) if f is None else f < 1e-5
            runs.append((good, iterations, abs(theta[0] - truth[0]), milliseconds))
        solved = [run for run in runs if run[0]]
        error_a = max((run[2] for run in solved), default=float('nan'))
        spent = float(np.median([run[3] for run in runs]))
        return Tally(method, len(solved), len(runs), tuple(run[1] for run in solved), error_a, spent)

    def ours(start: NDArray[np.float64]) -> Fitted:
        fit = levenberg(stages, speed, np.array([*start, speed[0]]))
        return fit.theta, None, fit.iterations

    def algorithm(evaluate: Callable[..., Objective], restart: Restart) -> Fit:
        def fit(start: NDArray[np.float64]) -> Fitted:
            done = newton(partial(at_measured, evaluate, stages, speed), start, replace(config, restart=restart), rng)
            return done.theta, done.f, done.iterations

        return fit

    printed = partial(algorithm, printed_objective)
    right = partial(algorithm, objective)
    return kind, [
        tally('Levenberg, v0 free (ours)', ours, _STARTS),
        tally('integrated least squares (ours)', lambda _: (integrated_least_squares(stages, speed)[:3], None, 0), 1),
        tally(
            'Gauss-Newton, full steps, no box', lambda start: full_steps(stages, speed, start, 1e-5), _ALGORITHM_STARTS
        ),
        tally('Algorithm 1, printed derivatives, no restart', printed(Restart.NEVER), _ALGORITHM_STARTS),
        tally('Algorithm 1, right derivatives, no restart', right(Restart.NEVER), _ALGORITHM_STARTS),
        tally('Algorithm 1, printed derivatives, restarts of 3.3', printed(Restart.SMALL_STEP), 1),
        tally('Algorithm 1, right derivatives, restarts of 3.3', right(Restart.SMALL_STEP), _RESTARTED),
        tally('Algorithm 1, right derivatives, restarts as listed', right(Restart.EVERY_STEP), _RESTARTED),
    ]


def at_measured(
    evaluate: Callable[..., Objective], stages: Stages, speed: NDArray[np.float64], theta: NDArray[np.float64]
) -> Objective:
    """Return value and derivatives with v_0 as measured."""
    return evaluate(stages, speed[1:], theta, float(speed[0]))


@dataclass(frozen=True, slots=True)
class Draw:
    """One fit of one noisy record: error of theta, squared error over the bound, mean square error of w."""

    kind: str
    method: str
    error: tuple[float, float, float]
    nees: float
    w_square: float


@cache
def bound(kind: str) -> NDArray[np.float64]:
    """Return the Cramer-Rao bound of a, b, c with v_0 free, shape (3, 3)."""
    given, theta = record(kind, 0, 'scheme'), np.array(CASES[0])
    stages = given.stages()
    v = stages.speeds(theta, float(given.speed[0]))
    J = np.zeros((4, v.size))
    J[:, 1:] = first_derivatives(Coefficients.along(stages, theta, v), v)
    J[3, 0] = 1.0
    scale = np.array([1.0, 0.02, 0.001, 1.0])
    R = np.asarray(np.linalg.qr((J * scale[:, None]).T, mode='r'))
    factor = scale[:, None] * np.linalg.inv(R)
    return np.asarray((factor @ factor.T)[:3, :3] * NOISE**2)


def grid(kind: str) -> NDArray[np.float64]:
    """Return the speeds at which w is evaluated: from 270 km/h to the highest [m/s]."""
    return np.linspace(270.0 / 3.6, float(record(kind, 0, 'scheme').speed.max()), 40)


def mean_squares(seed: int) -> tuple[float, float]:
    """Return (8) in noise on the full record [(m/s)^2]: largest of 50 random starts, and minimum, of the fit."""
    rng, box = np.random.default_rng(seed), NewtonConfig()
    given = record('full', 0, 'scheme')
    stages, seen = given.stages(), given.speed + NOISE * rng.standard_normal(given.speed.size)
    starts = rng.uniform(box.low, box.high, (_STARTS, 3))

    def square(theta: NDArray[np.float64], v0: float) -> float:
        return float(np.mean((stages.speeds(theta, v0)[1:] - seen[1:]) ** 2))

    fit = levenberg(stages, seen)
    return max(square(start, float(seen[0])) for start in starts), square(fit.theta, fit.start)


def noisy(seed: int) -> list[Draw]:
    """Fit both records in white noise, with a few noise draws each."""
    rng, draws = np.random.default_rng(seed), []
    truth, box = np.array(CASES[0]), NewtonConfig()
    for kind in KINDS:
        given = record(kind, 0, 'scheme')
        stages = given.stages()
        phi = grid(kind)[:, None] ** np.arange(3)
        precision = np.linalg.inv(bound(kind))
        for _ in range(DRAWS):
            seen = given.speed + NOISE * rng.standard_normal(given.speed.size)
            start = rng.uniform(box.low, box.high)
            linear = integrated_least_squares(stages, seen)
            real = record(kind, 0, 'ode')
            early, f, _ = full_steps(stages, seen, start, 0.05)
            fits = {
                'Levenberg, v0 free (ours)': levenberg(stages, seen).theta,
                'integrated least squares (ours)': linear[:3],
                'batch fit in time, data of (3) (trainid fit)': fit_davis(
                    in_time(real, seen - given.speed + real.speed), WHITE
                ).theta,
                'v0 as measured (the paper)': levenberg(
                    stages, seen, np.array([*linear[:3], seen[0]]), free_start=False
                ).theta,
                'differenced speed, eq. (2)': differenced_least_squares(stages, seen, data.SPACING),
            }
            if f < 0.05:
                fits['Gauss-Newton ended at f < 0.05'] = early
            for method, theta in fits.items():
                e = theta - truth
                w = phi @ e
                draws.append(
                    Draw(kind, method, (e[0], e[1], e[2]), float(e @ precision @ e) / 3.0, float(w @ w / w.size))
                )
    return draws
