# SPDX-License-Identifier: Apache-2.0
"""Errors and ambiguities of Liu et al. 2018, each quantified for one seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from research.papers import coasts as data
from research.papers.liu_numerics import printed_mils, regularised_rls
from trainid_lab.resistance.least_squares import least_squares, ridge, unpacked
from trainid_lab.resistance.recursive import Vector, covariance
from trainid_lab.resistance.regressions import (
    Regression,
    RegressionState,
    begin,
    innovation_step,
    run,
    strict_step,
    use_counts,
)
from trainid_ros.train.forces import G

Array = NDArray[np.float64]
COUNT: Final = 1032
STD: Final = 0.75
PENALTY: Final = 50.0
LENGTHS: Final = (1, 2, 4, 6)
_EXACT_PENALTIES: Final = (1.0, 50.0, 5000.0)


@dataclass(frozen=True, slots=True)
class Errata:
    """Results of one seed; differences of parameters relative to those of (7) [1], of curves in N/kN."""

    halved: float  # Difference of the minimiser of the printed J (lambda/2) from the printed solution (7)
    ends: float  # Difference of (12)-(16) from (7) at t = N
    middle: float  # The same at t = N/2
    middle_half: float  # Difference of (12)-(16) from ridge regression with lambda/2 at t = N/2
    twice_double: float  # Difference of (12)-(16) from ridge regression with 2 lambda at t = 2N
    earlier: float  # Difference of (12)-(16) with P(t-1) in (12) from (7) at t = N
    earlier_peak: float  # Greatest |theta| of that recursion
    exact: float  # Difference of RLS from P(0) = I/lambda from (7), greatest over all t and three lambda
    bias_printed: float  # Curve error of (12)-(16) at t = N, large a
    bias_ls: float  # Curve error of LS, large a
    weighted: float  # Difference of MILS from weighted least squares, greatest over the curve (20-80 km/h) and p
    printed_mils: float  # The same of the MILS kernel from the printed matrices
    mils_ls: float  # Difference of the MILS curve from that of LS, rms, greatest over p
    trace: tuple[float, ...]  # tr P over that of LS, by p
    nees: tuple[float, ...]  # Squared error over sigma^2 P, per parameter, by p: 1 if P were a covariance
    diluted: tuple[float, ...]  # Relative difference of regularised MILS from ridge regression with lambda/p, by p
    used: float  # Difference of regularised V-MILS from ridge regression weighted by use, penalty lambda (steps)/N
    strict_steps: int  # Steps of V-MILS with p = 4 and 30 % missing
    strict_good: int  # Good observations in that record
    strict_unused: float  # Share of good observations never used
    a_kmh: float  # a of ridge regression with v in km/h
    a_ms: float  # a of ridge regression with the same lambda and v in m/s
    missing: float  # Error of RLS with half of the data missing over the bound of the remaining data


@dataclass(frozen=True, slots=True)
class Record:
    """Observations in white noise, in the forms for batch and recursive estimators."""

    Phi: Array
    y: Array

    @property
    def pairs(self) -> list[tuple[Vector, float]]:
        """Regressor and observation pairs, in order."""
        return [((f1, f2, f3), y) for (f1, f2, f3), y in zip(self.Phi.tolist(), self.y.tolist(), strict=True)]


def record(truth: tuple[float, float, float], seed: int, count: int = COUNT) -> Record:
    """Return observations of true parameters."""
    v, y = data.white_observations(data.CoastPlan(truth=truth), np.random.default_rng(seed), STD, count)
    return Record(regressors(v), y)


def regressors(v: Array) -> Array:
    """Return [1, v, v^2], shape (n, 3)."""
    return np.stack([np.ones_like(v), v, v * v], axis=1)


def errata(seed: int) -> Errata:
    """Compute all differences for one seed."""
    rows = record(data.PAPER, seed)
    solution = ridge(rows.Phi, rows.y, PENALTY).theta
    path = _regularised_path(record(data.PAPER, seed, 2 * COUNT), earlier=False)
    other = _regularised_path(rows, earlier=True)
    doubled = record(data.PAPER, seed, 2 * COUNT)
    first, half = Record(doubled.Phi[:COUNT], doubled.y[:COUNT]), COUNT // 2
    large = record(data.LARGE_A, seed)
    plain = least_squares(rows.Phi, rows.y).theta
    recursions = {p: run(innovation_step, Regression(p), rows.pairs) for p in LENGTHS}
    good = np.random.default_rng((seed, 1)).random(COUNT) > 0.3
    strict = run(strict_step, Regression(4), rows.pairs, good.tolist())
    uses = np.array(use_counts(tuple(good.tolist()), 4, strict=True))
    units = np.array([1.0, 3.6, 3.6**2])
    a_ms = float(ridge(rows.Phi / units, rows.y, PENALTY).theta[0])
    return Errata(
        halved=_difference(ridge(rows.Phi, rows.y, 0.5 * PENALTY).theta, solution),
        ends=_difference(path[COUNT - 1], ridge(first.Phi, first.y, PENALTY).theta),
        middle=_difference(path[half - 1], ridge(first.Phi[:half], first.y[:half], PENALTY).theta),
        middle_half=_difference(path[half - 1], ridge(first.Phi[:half], first.y[:half], 0.5 * PENALTY).theta),
        twice_double=_difference(path[-1], ridge(doubled.Phi, doubled.y, 2.0 * PENALTY).theta),
        earlier=_difference(other[-1], solution),
        earlier_peak=float(np.linalg.norm(other, axis=1).max()),
        exact=max(_exactness(rows, penalty) for penalty in _EXACT_PENALTIES),
        bias_printed=data.curve_error(_regularised_path(large, earlier=False)[-1], data.LARGE_A),
        bias_ls=data.curve_error(least_squares(large.Phi, large.y).theta, data.LARGE_A),
        weighted=max(_curve_difference(recursions[p].theta, _weighted(rows, p)) for p in LENGTHS),
        printed_mils=max(_curve_difference(recursions[p].theta, _printed_mils(rows, p)) for p in LENGTHS),
        mils_ls=max(data.curve_error(np.array(recursions[p].theta) - plain, (0.0, 0.0, 0.0)) for p in LENGTHS),
        trace=tuple(_trace(recursions[p]) / _trace(recursions[1]) for p in LENGTHS),
        nees=tuple(_nees(recursions[p]) for p in LENGTHS),
        diluted=tuple(_dilution(rows, p) for p in LENGTHS),
        used=_regularised_strict(rows, good),
        strict_steps=strict.steps,
        strict_good=int(good.sum()),
        strict_unused=float(np.mean(uses[good] == 0)),
        a_kmh=float(solution[0]),
        a_ms=a_ms,
        missing=_missing(rows, np.random.default_rng((seed, 2)).random(COUNT) > 0.5),
    )


def resistance_printed(true_w: float, gradient: float) -> float:
    """Return w by (5), -100 alpha - i, for a coasting train with resistance ``true_w`` [N/kN]; gradient [per mille]."""
    alpha = -(true_w + gradient) * G / (1000.0 * (1.0 + data.GAMMA))
    return -100.0 * alpha - gradient


def _difference(theta: Array, expected: Array) -> float:
    return float(np.max(np.abs(theta - expected) / np.abs(expected)))


def _curve_difference(theta: Array | tuple[float, ...], other: Array) -> float:
    return float(np.max(np.abs(regressors(data.GRID) @ (np.asarray(theta) - other))))


def _regularised_path(rows: Record, *, earlier: bool) -> Array:
    """Return the estimates of (12)-(16) after each observation, shape (n, 3)."""
    theta, P = np.full(3, 1e-6), 1e6 * np.eye(3)
    path = []
    for phi, y in zip(rows.Phi, rows.y, strict=True):
        theta, P = regularised_rls(theta, P, phi, float(y), COUNT, PENALTY, earlier=earlier)
        path.append(theta)
    return np.array(path)


def _exactness(rows: Record, penalty: float) -> float:
    """Return the greatest difference of a parameter between RLS from P(0) = I/lambda and (7), over all t."""
    regression = Regression(penalty=penalty)
    state, information, moment, worst = begin(regression), penalty * np.eye(3), np.zeros(3), 0.0
    for (phi, y), row in zip(rows.pairs, rows.Phi, strict=True):
        state = innovation_step(state, phi, y, regression)
        information, moment = information + np.outer(row, row), moment + y * row
        worst = max(worst, float(np.abs(np.linalg.solve(information, moment) - state.theta).max()))
    return worst


def _weighted(rows: Record, p: int) -> Array:
    counts = np.array(use_counts((True,) * len(rows.y), p, strict=False), dtype=float)
    return least_squares(rows.Phi, rows.y, counts).theta


def _printed_mils(rows: Record, p: int) -> Array:
    theta, P = np.full(3, 1e-6), 1e6 * np.eye(3)
    for t in range(1, len(rows.y) + 1):
        theta, P = printed_mils(theta, P, rows.Phi[max(0, t - p) : t].T, rows.y[max(0, t - p) : t])
    return theta


def _P(state: RegressionState) -> Array:
    return unpacked(covariance(state.UD))


def _trace(state: RegressionState) -> float:
    return float(np.trace(_P(state)))


def _nees(state: RegressionState) -> float:
    error, P = np.array(state.theta) - np.array(data.PAPER), _P(state)
    return float(error @ np.linalg.solve(STD**2 * P, error)) / 3.0


def _dilution(rows: Record, p: int) -> float:
    state = run(innovation_step, Regression(p, PENALTY, COUNT), rows.pairs)
    return _difference(np.array(state.theta), ridge(rows.Phi, rows.y, PENALTY / p).theta)


def _regularised_strict(rows: Record, good: NDArray[np.bool_]) -> float:
    state = run(strict_step, Regression(4, PENALTY, COUNT), rows.pairs, good.tolist())
    uses = np.array(use_counts(tuple(good.tolist()), 4, strict=True), dtype=float)
    return _difference(np.array(state.theta), ridge(rows.Phi, rows.y, PENALTY * state.steps / COUNT, uses).theta)


def _missing(rows: Record, kept: NDArray[np.bool_]) -> float:
    pairs = [pair for pair, keep in zip(rows.pairs, kept.tolist(), strict=True) if keep]
    theta = run(innovation_step, Regression(), pairs).theta
    fit = least_squares(rows.Phi[kept], rows.y[kept])
    bound = data.curve_std(STD**2 / fit.variance * fit.covariance)
    return data.curve_error(theta, data.PAPER) / bound
