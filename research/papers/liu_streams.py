# SPDX-License-Identifier: Apache-2.0
"""All experiments of Liu et al. 2018 on one seed, among them the online claims on synthetic coasts.

The online claims are preprocessing, convergence, bad data, changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from research.papers import coasts as data
from research.papers.liu_errata import COUNT, STD, Errata, Record, errata, regressors
from research.papers.liu_table1 import WINDOWS, Batch, Shape, batch, seen_by, shape
from trainid_lab.resistance.least_squares import least_squares
from trainid_lab.resistance.regressions import Regression, begin, innovation_step, run, skip, strict_step
from trainid_lab.resistance.segments import Observations, Segments, Windows, difference
from trainid_lab.resistance.windowed import Residuals
from trainid_ros.setup.pipelines import RESISTANCE

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Theta = tuple[float, float, float]

CHANGES: Final = (0.5, 1.0, 2.0, 4.0)
LENGTHS: Final = (11, 25, 50, 100)
PREPARATIONS: Final = (
    'Fig. 2, 0.5 km/h, LS (paper)',
    'Fig. 2, 0.5 km/h, weights S_tt',
    *(f'Fig. 2, {change:g} km/h, LS' for change in CHANGES[1:]),
    *(f'{length} samples, 50 % overlap, LS' for length in LENGTHS),
    'differences (6), LS',
)
_BANDS: Final = ((20.0, 30.0), (70.0, 80.0))
_GOOD: Final = 0.1
_EARLY: Final = 70


@dataclass(frozen=True, slots=True)
class Prepared:
    """Curve errors of one seed by preparation [N/kN], the bound, and the bias of segments."""

    errors: tuple[float, ...]  # Curve errors by :data:`PREPARATIONS`
    bound: float  # Cramer-Rao bound from the raw speed
    residual: float  # Residual variance of Fig. 2 with LS [(N/kN)^2]
    bias: tuple[float, ...]  # Mean error of y at 20-30 and 70-80 km/h, Fig. 2, then fixed windows [N/kN]
    spread: tuple[float, ...]  # Standard deviation of the error of y, in the same order


def prepared(seed: int, plan: data.CoastPlan) -> Prepared:
    """Apply each preparation to the same coasts."""
    coasts = data.drive(plan, np.random.default_rng(seed))
    fig2 = seen_by(coasts, Segments(CHANGES[0]))
    fixed = [seen_by(coasts, Windows(length, length // 2)) for length in LENGTHS]
    differences = difference(coasts.speed, period=0.2, rotary_mass=data.GAMMA, speed_unit=data.KMH)
    plain = [fig2, *(seen_by(coasts, Segments(change)) for change in CHANGES[1:]), *fixed, differences]
    fits = [least_squares(seen.regressors(), seen.y) for seen in plain]
    weighted = least_squares(fig2.regressors(), fig2.y, fig2.weight)
    fits.insert(1, weighted)
    bands = [_band(seen, band, plan.truth) for seen in (fig2, fixed[0]) for band in _BANDS]
    return Prepared(
        errors=tuple(data.curve_error(fit.theta, plan.truth) for fit in fits),
        bound=data.curve_std(data.cramer_rao(coasts)),
        residual=fits[0].variance,
        bias=tuple(float(np.mean(error)) for error in bands),
        spread=tuple(float(np.std(error)) for error in bands),
    )


def _band(seen: Observations, band: tuple[float, float], truth: Theta) -> Array:
    inside = (band[0] <= seen.v) & (seen.v < band[1])
    return seen.y[inside] - data.resistance(truth, seen.v[inside])


@dataclass(frozen=True, slots=True)
class Settling:
    """Convergence of one recursion."""

    parameters: tuple[float, ...]  # Observations until a, b, c stay within 10 % of their last values
    curve: float  # Observations until the curve (rms over 20-80 km/h) stays within 10 % of its last value
    early: float  # Curve error after 70 observations [N/kN]
    end: float  # Curve error at the end [N/kN]


def settling(seed: int, truth: Theta, *, single: bool, penalty: float) -> Settling:
    """Return the convergence of RLS, regularised as printed if penalty > 0; ``single``: one coast 80 -> 20 km/h."""
    plan = data.CoastPlan(truth=truth)
    if single:
        plan = data.CoastPlan(truth=truth, coasts=1, samples=1500, slowest=80.0, fastest=80.0)
    seen = seen_by(data.drive(plan, np.random.default_rng(seed)), WINDOWS)
    if single:
        stop = int(np.argmax(seen.v < 20.0)) or len(seen.v)
        seen = Observations(seen.v[:stop], seen.y[:stop], seen.weight[:stop])
    path = _path(Record(seen.regressors(), seen.y), Regression(1, penalty, len(seen.y) if penalty else 0))
    last, grid = path[-1], regressors(data.GRID)
    curve = np.sqrt(np.mean(((path - last) @ grid.T) ** 2, axis=1) / np.mean((grid @ last) ** 2))
    parameters = np.abs(path - last) / np.abs(last)
    return Settling(
        tuple(_settled(parameters[:, i]) for i in range(3)),
        _settled(curve),
        data.curve_error(path[_EARLY - 1], truth),
        data.curve_error(last, truth),
    )


def _settled(away: Array) -> float:
    outside = np.flatnonzero(away > _GOOD)
    return float(outside[-1] + 2) if len(outside) else 1.0


def _path(rows: Record, regression: Regression) -> Array:
    state, path = begin(regression), []
    for phi, y in rows.pairs:
        state = innovation_step(state, phi, y, regression)
        path.append(state.theta)
    return np.array(path)


Fault = Literal['clean', '10 % both signs', '30 % both signs', '30 % one sign', '30 % one sign, bursts', '50 % missing']
FAULTS: Final[tuple[Fault, ...]] = (
    'clean',
    '10 % both signs',
    '30 % both signs',
    '30 % one sign',
    '30 % one sign, bursts',
    '50 % missing',
)
BY_FLAG: Final = ('LS = RLS = MILS', 'V-MILS p = 4, true flags', 'p = 1, true flags', 'V-MILS p = 4, gate 3 MAD')
_BURST: Final = 10


def spoiled(seed: int, fault: Fault) -> tuple[float, ...]:
    """Return the curve errors by :data:`BY_FLAG` over the bound of the good observations, one seed."""
    rng = np.random.default_rng(seed)
    v, y = data.white_observations(data.CoastPlan(), rng, STD)
    good, missing = _faults(fault, rng)
    signs = rng.choice([-1.0, 1.0], COUNT) if 'both' in fault else 1.0
    y = np.where(good | missing, y, y + signs * rng.uniform(4.0, 14.0, COUNT))
    rows = Record(regressors(v), y)
    seen = ~missing
    fit = least_squares(rows.Phi[good], y[good])
    bound = data.curve_std(STD**2 / fit.variance * fit.covariance)
    thetas = (
        least_squares(rows.Phi[seen], y[seen]).theta,
        run(strict_step, Regression(4), rows.pairs, good.tolist()).theta,
        run(strict_step, Regression(1), rows.pairs, good.tolist()).theta,
        _gated(rows, seen),
    )
    return tuple(data.curve_error(theta, data.PAPER) / bound for theta in thetas)


def _faults(fault: Fault, rng: np.random.Generator) -> tuple[Flags, Flags]:
    """Return masks of the good and of the missing observations."""
    none = np.zeros(COUNT, dtype=bool)
    if fault == 'clean':
        return ~none, none
    share = int(fault.split()[0]) / 100.0
    if 'bursts' in fault:
        starts = rng.random(COUNT) < -math.log(1.0 - share) / _BURST
        bad = np.convolve(starts, np.ones(_BURST))[:COUNT] > 0.0
    else:
        bad = rng.random(COUNT) < share
    return ~bad, bad if 'missing' in fault else none


def _gated(rows: Record, seen: Flags) -> Theta:
    """Run V-MILS with p = 4 as printed, skipping innovations beyond 3 robust standard deviations."""
    regression, residuals = Regression(4), Residuals()
    state = begin(regression)
    for (phi, y), there in zip(rows.pairs, seen.tolist(), strict=True):
        e = y - sum(f * x for f, x in zip(phi, state.theta, strict=True))
        bad = not there or residuals.is_outlier(e, 3.0)
        state = skip(state) if bad else strict_step(state, phi, y, regression)
        residuals = residuals.remember(e) if there else residuals
    return state.theta


JUMP: Final = 1.22
TRACKERS: Final = (
    ('RLS', Regression()),
    ('MILS p = 4', Regression(4)),
    ('RLS, mu = 0.995', Regression(forgetting=0.995)),
    ('RLS, mu = 0.99', Regression(forgetting=0.99)),
    ('MILS p = 4, mu = 0.99', Regression(4, forgetting=0.99)),
    ('RLS, mu = 0.95', Regression(forgetting=0.95)),
)
_JUMP_STD: Final = 0.57


def tracked(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return, by :data:`TRACKERS`, observations until 90 % of a jump of ``a`` is followed, and the error before it."""
    rng = np.random.default_rng(seed)
    a, b, c = data.PAPER
    parts = [data.white_observations(data.CoastPlan(truth=(x, b, c)), rng, _JUMP_STD) for x in (a, a + JUMP)]
    v, y = (np.concatenate(column) for column in zip(*parts, strict=True))
    rows, grid = Record(regressors(v), y), regressors(data.GRID)
    delays, errors = [], []
    for _, regression in TRACKERS:
        path = _path(rows, regression)
        moved = (path[COUNT:] - np.array(data.PAPER)) @ grid.mean(axis=0)
        found = np.flatnonzero(moved >= 0.9 * JUMP)
        delays.append(float(found[0] + 1) if len(found) else math.inf)
        errors.append(data.curve_error(path[COUNT - 1], data.PAPER))
    return tuple(delays), tuple(errors)


TRUTHS: Final = (('eq. (8)', data.PAPER), ('large a', data.LARGE_A))
PLANS: Final = (
    ('no gusts', data.CoastPlan()),
    ('gusts 0.3 N/kN', data.CoastPlan(gust_std=0.3)),
    ('gusts, map error 0.3 permille', data.CoastPlan(gust_std=0.3, grade_std=0.3)),
)
SETTLINGS: Final = tuple(
    (truth, single, penalty) for truth in (0, 1) for single in (False, True) for penalty in (0, 50)
)
"""Truth, one coast or 24, penalty."""
STREAMS: Final = ('RLS', 'MILS', 'V-MILS-printed')


@dataclass(frozen=True, slots=True)
class Trial:
    """Results of one seed."""

    errata: Errata  # Errors of the equations
    shape: Shape  # Table 1 and 2
    full: tuple[Batch, ...]  # Batch estimators on the full record, by :data:`TRUTHS`
    narrow: tuple[Batch, ...]  # The same on four short coasts
    prepared: tuple[Prepared, ...]  # Preparations, by :data:`PLANS`
    settled: tuple[Settling, ...]  # Convergence, by :data:`SETTLINGS`
    spoiled: tuple[tuple[float, ...], ...]  # Errors with bad data over the bound, by fault and estimator
    delays: tuple[float, ...]  # Observations until a jump is followed
    before: tuple[float, ...]  # Curve errors before the jump [N/kN]
    # Squared error over covariance, per parameter, of the streaming estimators, by :data:`STREAMS`.
    nees: tuple[float, ...]


def trial(seed: int) -> Trial:
    """Run all experiments on one seed."""
    delays, before = tracked(seed)
    return Trial(
        errata=errata(seed),
        shape=shape(seed),
        full=tuple(batch(seed, truth, narrow=False) for _, truth in TRUTHS),
        narrow=tuple(batch(seed, truth, narrow=True) for _, truth in TRUTHS),
        prepared=tuple(prepared(seed, plan) for _, plan in PLANS),
        settled=tuple(
            settling(seed, TRUTHS[truth][1], single=single, penalty=penalty) for truth, single, penalty in SETTLINGS
        ),
        spoiled=tuple(spoiled(seed, fault) for fault in FAULTS),
        delays=delays,
        before=before,
        nees=tuple(nees(seed, name) for name in STREAMS),
    )


def nees(seed: int, name: str) -> float:
    """Return the squared error of a streaming estimator over its covariance, per parameter, in gusts."""
    generator = np.random.default_rng(seed)
    coasts = data.drive(data.CoastPlan(gust_std=0.3), generator)
    estimator = RESISTANCE.make(RESISTANCE.choose(name), data.train_file(), generator)
    for sample in data.samples(coasts):
        estimator.step(sample)
    estimate, truth = estimator.estimate(15.0), data.in_si(data.PAPER)
    error = np.array([estimate.a - truth.a, estimate.b - truth.b, estimate.c - truth.c])
    P = np.array(estimate.covariance).reshape(3, 3)
    return float(error @ np.linalg.solve(P, error)) / 3.0
