# SPDX-License-Identifier: Apache-2.0
"""The fits of the product: metro pieces with slip and outliers, consistency of standard deviations, CPU time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.days import assumed_train, samples_of
from benchmarks.yizhuang_day import DRY, yizhuang_day
from research.papers.xia2023_fits import NOISE, WHITE, in_time, record
from research.papers.xia2023_online import CONFIG, drive, samples, train_file
from research.peers.metro_stream import BEFORE, INERTIA, PERIOD, Raw, Scenario, curve_error, metro_stream
from trainid_lab.resistance.trajectory.levenberg import integrated_least_squares, levenberg
from trainid_lab.resistance.trajectory.stages import Coefficients, Stages, first_derivatives, second_derivatives
from trainid_lab.resistance.trajectory.two_window import TwoWindow
from trainid_lab.resistance.trajectory.window import RowNoise, WindowPrior, fit_rows
from trainid_ros.interface.results import Reason
from trainid_ros.resistance.davis_fit import DavisFitConfig, PieceCollector, Trajectory, fit_davis
from trainid_ros.sim.scenario import simulate

SEGMENT: Final = 513
TROUBLES: Final[tuple[Scenario, ...]] = ('clean', 'slip', 'out5')
_ROWS: Final = 24 * SEGMENT
BAG_RUNS: Final = (1, 3, 9)
JUDGED_AT: Final = (5.0, 12.0, 20.0)


@dataclass(frozen=True, slots=True)
class SegmentErrors:
    """Errors of w over 5 to 22 m/s [N/kN]: of one segment of 100 s, and of 20 together."""

    scenario: str
    one: float
    twenty: float
    one_plain: float
    twenty_plain: float


def segments(seed: int, scenario: Scenario, count: int) -> Trajectory:
    """Return segments of 513 moving ticks, each with a free initial speed; short remainders are omitted."""
    raw = metro_stream(seed, scenario, _ROWS).raw
    starts = np.flatnonzero(raw.moving & ~np.concatenate(([False], raw.moving[:-1])))
    return _cut(raw, starts, count)


def _cut(raw: Raw, starts: NDArray[np.intp], count: int) -> Trajectory:
    """Fill segments with complete and partial rides up to their number of ticks."""
    moving = np.flatnonzero(raw.moving)[: count * SEGMENT]
    dt = np.full(moving.size, PERIOD)
    dt[0] = 0.0
    dt[np.isin(moving, starts)] = 0.0
    dt[::SEGMENT] = 0.0
    known = np.where(dt > 0.0, (raw.force - raw.gradient)[moving], 0.0)
    traction = np.where(dt > 0.0, raw.force[moving], 0.0)
    return Trajectory(raw.speed[moving], dt, known, traction, INERTIA)


def segment_errors(seed: int) -> list[SegmentErrors]:
    """Fit segments of three scenarios, robustly and by plain least squares."""
    plain = DavisFitConfig(huber=1e6, cut=1e6)
    out = []
    for scenario in TROUBLES:
        errors = []
        for config in (DavisFitConfig(), plain):
            for count in (1, 20):
                theta = fit_davis(segments(seed, scenario, count), config).theta
                errors.append(curve_error(theta, BEFORE))
        out.append(SegmentErrors(scenario, *errors))
    return out


@dataclass(frozen=True, slots=True)
class Consistency:
    """Errors of a batch fit of metro runs over their standard deviations and in N/kN: w at three speeds; NEES / 3."""

    runs: int
    z: tuple[float, ...]
    error: tuple[float, ...]
    nees: float


def consistency(seed: int) -> tuple[Consistency, ...]:
    """Simulate one, three and nine dry runs on the metro line and fit each bag."""
    return tuple(_consistency(seed, runs) for runs in BAG_RUNS)


def _consistency(seed: int, runs: int) -> Consistency:
    train, config = assumed_train(), DavisFitConfig()
    simulation = simulate(yizhuang_day(train, runs=runs), np.random.default_rng([seed, runs]))
    collector, rejected = PieceCollector(train, config.min_speed, config.shortest), Counter[Reason]()
    for sample in samples_of(simulation.records):
        collector.add(sample, rejected)
    fit = fit_davis(collector.trajectory(), config)
    e = fit.theta - np.array([DRY.a, DRY.b, DRY.c])
    errors = tuple(float(e @ v ** np.arange(3)) for v in JUDGED_AT)
    z = tuple(error / fit.resistance(v)[1] for error, v in zip(errors, JUDGED_AT, strict=True))
    return Consistency(runs, z, errors, float(e @ np.linalg.solve(fit.covariance, e)) / 3.0)


@dataclass(frozen=True, slots=True)
class Timing:
    """Median time of one call on one core [ms]."""

    name: str
    milliseconds: float


def timings() -> list[Timing]:
    """Measure the kernels and the fits."""
    rng = np.random.default_rng(5000)
    out = []
    for count in (20, 1200):
        given = record('full', 0, 'ode')
        stages = Stages(given.stages().lam[:count], given.stages().drive[:count])
        seen = given.speed[: count + 1] + NOISE * rng.standard_normal(count + 1)
        theta = np.array([0.79, 0.0229, 0.001493])
        v = stages.speeds(theta, float(given.speed[0]))
        coefficients = Coefficients.along(stages, theta, v)
        first = first_derivatives(coefficients, v)
        label = f'I = {count}: '
        out += [
            _timed(label + 'speeds (7)', partial(stages.speeds, theta, 20.0)),
            _timed(label + 'Jacobian', partial(first_derivatives, coefficients, v)),
            _timed(label + 'second derivatives', partial(second_derivatives, coefficients, v, first)),
            _timed(label + 'integrated least squares', partial(integrated_least_squares, stages, seen)),
            _timed(label + 'Levenberg', partial(levenberg, stages, seen), 5),
        ]
    long = in_time(record('full', 0, 'ode'), record('full', 0, 'ode').speed)
    speed, dt, known, traction = (np.tile(x, 2)[:2000] for x in (long.speed, long.dt, long.known, long.traction))
    twice = Trajectory(speed, dt, known, traction, long.inertia)
    estimator = TwoWindow(train_file(), CONFIG)
    drawn = samples(drive(5000, 'ode'))
    for sample in drawn[:200]:
        estimator.step(sample)
    rows = estimator.state.rows
    prior = WindowPrior((0.8, 0.02, 0.0015), (0.4, 0.004, 0.0008, 1e-9, 1e-9))
    noise = RowNoise(NOISE, 1e-4)
    one, twenty = segments(5000, 'clean', 1), segments(5000, 'clean', 20)
    feed = iter(drawn[200:])
    return [
        *out,
        _timed('window of 20 rows with prior', lambda: fit_rows(rows[-20:], noise, prior)),
        _timed('window of 60 rows with prior', lambda: fit_rows(rows, noise, prior)),
        _timed('two windows, a complete step', lambda: estimator.step(next(feed)), 50),
        _timed('batch fit in time, I = 2000', lambda: fit_davis(twice, WHITE), 10),
        _timed('batch fit of a segment of 100 s, robust', lambda: fit_davis(one, DavisFitConfig()), 10),
        _timed('batch fit of 20 segments, robust', lambda: fit_davis(twenty, DavisFitConfig()), 10),
    ]


def _timed(name: str, call: Callable[[], object], number: int = 20) -> Timing:
    blocks = []
    for _ in range(7):
        begun = time.thread_time()
        for _ in range(number):
            call()
        blocks.append((time.thread_time() - begun) / number)
    return Timing(name, 1e3 * float(np.min(blocks)))
