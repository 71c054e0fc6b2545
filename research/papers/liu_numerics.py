# SPDX-License-Identifier: Apache-2.0
"""Rounding and forgetting in the recursions of Liu et al. 2018, as printed (matrices) and on factors of P."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from research.papers import coasts as data
from trainid_lab.resistance.least_squares import add, solve, unpacked
from trainid_lab.resistance.recursive import Factors, Vector, covariance, forget, rls, shrink, start
from trainid_lab.resistance.regressions import mils

Array = NDArray[Any]
Pair = tuple[Vector, float]
_P0: Final = 1e6
LONG: Final = 100_000
MU: Final = 0.99
_STD: Final = 0.75
_MILS: Final = 6


def printed_rls(theta: Array, P: Array, phi: Array, y: float, mu: float = 1.0) -> tuple[Array, Array]:
    """Return theta and P after one step of eqs. (9)-(11); mu < 1 adds exponential forgetting."""
    L = P @ phi / (mu + phi @ P @ phi)
    return theta + L * (y - phi @ theta), (np.eye(3, dtype=P.dtype) - np.outer(L, phi)) @ P / P.dtype.type(mu)


def regularised_rls(
    theta: Array, P: Array, phi: Array, y: float, N: int, penalty: float, *, earlier: bool = False
) -> tuple[Array, Array]:
    """Return theta and P after one step of (12)-(16); ``earlier``: P(t-1) for P(t) in (12), as Fig. 5 may be read."""
    eye = np.eye(3)
    Q = N / penalty * P @ np.linalg.inv(N / penalty * eye + P)
    L = Q @ phi / (1.0 + phi @ Q @ phi)
    after = (eye - np.outer(L, phi)) @ Q
    shrinking = P if earlier else after
    return theta + L * (y - phi @ theta) - penalty / N * shrinking @ theta, after


def printed_mils(theta: Array, P: Array, Phi: Array, Y: Array) -> tuple[Array, Array]:
    """Return theta and P after one step of MILS, Phi of shape (3, p), Y of shape (p,)."""
    L = P @ Phi @ np.linalg.inv(np.eye(len(Y)) + Phi.T @ P @ Phi)
    return theta + L @ (Y - Phi.T @ theta), P - L @ Phi.T @ P


def rls_symmetric_gain(theta: Array, P: Array, phi: Array, y: float, mu: float) -> tuple[Array, Array]:
    """Return one step of RLS in the common form P -= (g/S) g', g = P phi, in which any asymmetry of P grows."""
    g = P @ phi
    S = mu + phi @ g
    return theta + g / S * (y - phi @ theta), (P - np.outer(g / S, g)) / mu


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a recursion."""

    steps: int  # Number of steps
    indefinite: float  # First step after which P has a negative eigenvalue, inf if none
    broken: float  # First step after which a number is not finite, inf if none
    asymmetry: float  # Greatest relative asymmetry of the last P
    error: float  # Curve error over 20-80 km/h at the end [N/kN]


def excited(seed: int, count: int) -> Iterator[Pair]:
    """Yield observations at speeds uniform in 20-80 km/h."""
    rng = np.random.default_rng(seed)
    return _observed(rng.uniform(20.0, 80.0, count), rng)


def steady(seed: int, count: int) -> Iterator[Pair]:
    """Yield observations at 60 km/h with a standard deviation of 0.05 km/h."""
    rng = np.random.default_rng(seed)
    return _observed(60.0 + 0.05 * rng.standard_normal(count), rng)


def constant(seed: int, count: int) -> Iterator[Pair]:
    """Yield observations at exactly 60 km/h."""
    return _observed(np.full(count, 60.0), np.random.default_rng(seed))


def _observed(v: NDArray[np.float64], rng: np.random.Generator) -> Iterator[Pair]:
    y = data.resistance(data.PAPER, v) + _STD * rng.standard_normal(len(v))
    for speed, value in zip(v.tolist(), y.tolist(), strict=True):
        yield (1.0, speed, speed * speed), value


def as_printed(
    pairs: Iterator[Pair], *, mu: float = 1.0, dtype: type = np.float64, symmetric_gain: bool = False
) -> Outcome:
    """Run the printed matrix form, from P(0) = 1e6 I with v in km/h."""
    theta: Array = np.full(3, 1.0 / _P0, dtype)
    P: Array = _P0 * np.eye(3, dtype=dtype)
    step: Callable[..., tuple[Array, Array]] = rls_symmetric_gain if symmetric_gain else printed_rls
    indefinite, t = math.inf, 0
    with np.errstate(all='ignore'):
        for t, (phi, y) in enumerate(pairs, 1):
            theta, P = step(theta, P, np.array(phi, dtype), dtype(y), dtype(mu))
            if not (np.isfinite(theta).all() and np.isfinite(P).all()):
                return Outcome(t, min(indefinite, t), t, math.nan, math.inf)
            if indefinite == math.inf and (t < 100 or t % 100 == 0) and _least(P) < 0.0:
                indefinite = t
    asymmetry = float(np.abs(P - P.T).max() / np.abs(P).max())
    return Outcome(t, indefinite, math.inf, asymmetry, data.curve_error(theta.astype(float), data.PAPER))


def factored(pairs: Iterator[Pair], *, mu: float = 1.0) -> Outcome:
    """Run the factored kernel from the same initial values."""
    theta, UD = start(_P0, 1.0 / _P0)
    indefinite, t = math.inf, 0
    for t, (phi, y) in enumerate(pairs, 1):
        theta, UD = rls(theta, forget(UD, mu) if mu < 1.0 else UD, phi, y)
        if not all(map(math.isfinite, (*theta, *UD))):
            return Outcome(t, indefinite, t, math.nan, math.inf)
        if min(UD[3:]) < 0.0:
            indefinite = min(indefinite, t)
    return Outcome(t, indefinite, math.inf, 0.0, data.curve_error(theta, data.PAPER))


def _least(P: Array) -> float:
    """Return the least eigenvalue of the symmetric part, scaled to a unit diagonal to be independent of units."""
    diagonal = np.diag(P)
    if (diagonal <= 0.0).any():
        return -1.0
    scale = 1.0 / np.sqrt(diagonal)
    scaled = 0.5 * (P + P.T) * np.outer(scale, scale)
    # Tolerance for the rounding error of the eigenvalues themselves.
    return float(np.linalg.eigvalsh(scaled).min()) + 8.0 * float(np.finfo(P.dtype).eps)


def conditions(seed: int) -> tuple[float, float]:
    """Return the condition number of sum phi phi' with v in km/h, and with v normalised to zero mean and unit std."""
    v, _ = data.white_observations(data.CoastPlan(), np.random.default_rng(seed), _STD)
    u = (v - v.mean()) / v.std()
    bases = (np.stack([np.ones_like(x), x, x * x], axis=1) for x in (v, u))
    km_h, normalised = (float(np.linalg.cond(Phi.T @ Phi)) for Phi in bases)
    return km_h, normalised


def costs(seed: int, count: int = 5000) -> tuple[tuple[str, float], ...]:
    """Return the CPU time per observation of each recursion [us]."""
    pairs = list(excited(seed, count))
    stack = tuple(phi for phi, _ in pairs[:_MILS])
    values = tuple(y for _, y in pairs[:_MILS])

    def regularised(theta: Vector, UD: Factors, phi: Vector, y: float) -> tuple[Vector, Factors]:
        return rls(*shrink(theta, UD, 0.05), phi, y)

    def many(theta: Vector, UD: Factors, phi: Vector, y: float) -> tuple[Vector, Factors]:
        return mils(theta, UD, (*stack[1:], phi), (*values[1:], y))

    return (
        ('LS, solved each time', _time_ls(pairs)),
        ('RLS', _time(rls, pairs)),
        ('regularised RLS as printed', _time(regularised, pairs)),
        (f'MILS p = {_MILS}', _time(many, pairs)),
        ('RLS, printed matrices in numpy', _time_printed(pairs)),
    )


def _time(step: Callable[[Vector, Factors, Vector, float], tuple[Vector, Factors]], pairs: list[Pair]) -> float:
    theta, UD = start(_P0)
    before = time.process_time()
    for phi, y in pairs:
        theta, UD = step(theta, UD, phi, y)
    return 1e6 * (time.process_time() - before) / len(pairs)


def _time_ls(pairs: list[Pair]) -> float:
    M, m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    before = time.process_time()
    for phi, y in pairs:
        M, m = add(M, m, phi, y)
        solve(M, m)
    return 1e6 * (time.process_time() - before) / len(pairs)


def _time_printed(pairs: list[Pair]) -> float:
    rows = [(np.array(phi), y) for phi, y in pairs]
    theta, P = np.zeros(3), unpacked(covariance(start(_P0)[1]))
    before = time.process_time()
    for phi, y in rows:
        theta, P = printed_rls(theta, P, phi, y)
    return 1e6 * (time.process_time() - before) / len(rows)
