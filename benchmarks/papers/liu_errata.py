# SPDX-License-Identifier: Apache-2.0
"""Errors and ambiguities of Liu et al. 2018, each shown by a number, for one seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from benchmarks.papers import coasts as data
from benchmarks.papers import liu_printed as printed
from trainid_ros.resistance.innovations import use_counts
from trainid_ros.resistance.least_squares import least_squares, ridge, unpacked
from trainid_ros.resistance.recursive import covariance
from trainid_ros.resistance.regressions import (
    Regression,
    RegressionState,
    begin,
    innovation_step,
    run,
    strict_step,
)
from trainid_ros.train.davis import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.resistance.recursive import Vector

    Array = NDArray[np.float64]

COUNT: Final = 1032
STD: Final = 0.75
PENALTY: Final = 50.0
LENGTHS: Final = (1, 2, 4, 6)
_EXACT_PENALTIES: Final = (1.0, 50.0, 5000.0)


@dataclass(frozen=True, slots=True)
class Errata:
    """What one seed shows; differences of parameters relative to those of (7), of curves in N/kN.

    Attributes:
        halved: Minimiser of the printed J (lambda/2) off the printed solution (7).
        ends: (12)-(16) off (7) at t = N.
        middle: The same at t = N/2.
        middle_half: (12)-(16) off ridge regression with lambda/2 at t = N/2.
        twice_double: (12)-(16) off ridge regression with 2 lambda at t = 2N.
        earlier: The same with P(t-1) in (12), off (7) at t = N.
        earlier_peak: Its greatest |theta| on the way.
        exact: RLS from P(0) = I/lambda off (7), greatest over all t and three lambda.
        bias_printed: Curve error of (12)-(16) at t = N, large a.
        bias_ls: Curve error of LS, large a.
        weighted: MILS off weighted least squares, greatest difference of the curve over 20-80 km/h and p.
        printed_mils: The kernel of MILS off the printed matrices, likewise.
        mils_ls: Curve of MILS off that of LS, rms, greatest over p.
        trace: tr P over that of LS, by p.
        nees: Squared error over sigma^2 P, per parameter, by p: 1 if P were a covariance.
        diluted: Regularised MILS off ridge regression with lambda/p, relative, by p.
        used: Regularised V-MILS off ridge regression weighted by use, penalty lambda (steps)/N.
        strict_steps: Steps of V-MILS with p = 4 and 30 % missing.
        strict_good: Good observations there.
        strict_unused: Share of good observations never used.
        a_kmh: a of ridge regression with v in km/h.
        a_ms: a of ridge regression with the same lambda and v in m/s.
        missing: Error of RLS with half of the data missing over that of the bound of the rest.

    """

    halved: float
    ends: float
    middle: float
    middle_half: float
    twice_double: float
    earlier: float
    earlier_peak: float
    exact: float
    bias_printed: float
    bias_ls: float
    weighted: float
    printed_mils: float
    mils_ls: float
    trace: tuple[float, ...]
    nees: tuple[float, ...]
    diluted: tuple[float, ...]
    used: float
    strict_steps: int
    strict_good: int
    strict_unused: float
    a_kmh: float
    a_ms: float
    missing: float


@dataclass(frozen=True, slots=True)
class Record:
    """Observations in white noise, in the forms that batch and recursion take."""

    Phi: Array
    y: Array

    @property
    def pairs(self) -> list[tuple[Vector, float]]:
        """Regressor and observation, one after another."""
        return [((f1, f2, f3), y) for (f1, f2, f3), y in zip(self.Phi.tolist(), self.y.tolist(), strict=True)]


def record(truth: tuple[float, float, float], seed: int, count: int = COUNT) -> Record:
    """Return observations of a truth."""
    v, y = data.white_observations(data.CoastPlan(truth=truth), np.random.default_rng(seed), STD, count)
    return Record(regressors(v), y)


def regressors(v: Array) -> Array:
    """Return [1, v, v^2], shape (n, 3)."""
    return np.stack([np.ones_like(v), v, v * v], axis=1)


def errata(seed: int) -> Errata:
    """Return what one seed shows."""
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
        halved=_off(ridge(rows.Phi, rows.y, 0.5 * PENALTY).theta, solution),
        ends=_off(path[COUNT - 1], ridge(first.Phi, first.y, PENALTY).theta),
        middle=_off(path[half - 1], ridge(first.Phi[:half], first.y[:half], PENALTY).theta),
        middle_half=_off(path[half - 1], ridge(first.Phi[:half], first.y[:half], 0.5 * PENALTY).theta),
        twice_double=_off(path[-1], ridge(doubled.Phi, doubled.y, 2.0 * PENALTY).theta),
        earlier=_off(other[-1], solution),
        earlier_peak=float(np.linalg.norm(other, axis=1).max()),
        exact=max(_exactness(rows, penalty) for penalty in _EXACT_PENALTIES),
        bias_printed=data.curve_error(_regularised_path(large, earlier=False)[-1], data.LARGE_A),
        bias_ls=data.curve_error(least_squares(large.Phi, large.y).theta, data.LARGE_A),
        weighted=max(_apart(recursions[p].theta, _weighted(rows, p)) for p in LENGTHS),
        printed_mils=max(_apart(recursions[p].theta, _printed_mils(rows, p)) for p in LENGTHS),
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
    """Return what (5), -100 alpha - i, makes of a coasting train with resistance ``true_w`` [N/kN]."""
    alpha = -(true_w + gradient) * G / (1000.0 * (1.0 + data.GAMMA))
    return -100.0 * alpha - gradient


def _off(theta: Array, expected: Array) -> float:
    return float(np.max(np.abs(theta - expected) / np.abs(expected)))


def _apart(theta: Array | tuple[float, ...], other: Array) -> float:
    return float(np.max(np.abs(regressors(data.GRID) @ (np.asarray(theta) - other))))


def _regularised_path(rows: Record, *, earlier: bool) -> Array:
    """Return the estimates of (12)-(16) after each observation, shape (n, 3)."""
    theta, P = np.full(3, 1e-6), 1e6 * np.eye(3)
    path = []
    for phi, y in zip(rows.Phi, rows.y, strict=True):
        theta, P = printed.regularised_rls(theta, P, phi, float(y), COUNT, PENALTY, earlier=earlier)
        path.append(theta)
    return np.array(path)


def _exactness(rows: Record, penalty: float) -> float:
    """Greatest difference of a parameter between RLS from P(0) = I/lambda and (7), over all t."""
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
        theta, P = printed.mils(theta, P, rows.Phi[max(0, t - p) : t].T, rows.y[max(0, t - p) : t])
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
    return _off(np.array(state.theta), ridge(rows.Phi, rows.y, PENALTY / p).theta)


def _regularised_strict(rows: Record, good: NDArray[np.bool_]) -> float:
    state = run(strict_step, Regression(4, PENALTY, COUNT), rows.pairs, good.tolist())
    uses = np.array(use_counts(tuple(good.tolist()), 4, strict=True), dtype=float)
    return _off(np.array(state.theta), ridge(rows.Phi, rows.y, PENALTY * state.steps / COUNT, uses).theta)


def _missing(rows: Record, kept: NDArray[np.bool_]) -> float:
    pairs = [pair for pair, keep in zip(rows.pairs, kept.tolist(), strict=True) if keep]
    theta = run(innovation_step, Regression(), pairs).theta
    fit = least_squares(rows.Phi[kept], rows.y[kept])
    bound = data.curve_std(STD**2 / fit.variance * fit.covariance)
    return data.curve_error(theta, data.PAPER) / bound
