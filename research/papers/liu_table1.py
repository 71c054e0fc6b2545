# SPDX-License-Identifier: Apache-2.0
"""Table 1 and 2 of Liu et al. 2018 on synthetic coasts: effect of the innovation length on residuals and parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from research.papers import coasts as data
from trainid_lab.resistance.least_squares import Prior, fit_with_prior, least_squares, ridge
from trainid_lab.resistance.regressions import Regression, innovation_step, run
from trainid_lab.resistance.segments import Cutter, Observations, Segments, Windows, observe

Array = NDArray[np.float64]
LENGTHS: Final = (1, 2, 4, 6)
PENALTY: Final = 50.0
PRINTED: Final = (
    # name, a, b, c, variance of the residuals
    ('LS', 0.515, 8.597e-2, 0.751e-3, 0.5632),
    ('RLS', 0.783, 8.511e-2, 0.758e-3, 0.5632),
    ('MILS p = 2', 0.932, 5.749e-2, 0.981e-3, 0.5623),
    ('MILS p = 4', 1.638, 3.591e-2, 1.422e-3, 0.5618),
    ('MILS p = 6', 2.194, 1.941e-2, 1.262e-3, 0.5613),
)
"""Table 1 of the paper; v in km/h."""
PLAIN_LS: Final = (23.74, -6.99e-1, 7.23e-3)
"""LS result of the paper without regularisation."""
FIG2: Final = Segments(0.5)
WINDOWS: Final = Windows(11, 5)
_PRIOR_STD: Final = (2.0, 0.09, 1e-3)


@dataclass(frozen=True, slots=True)
class Shape:
    """Residual variances of one seed by innovation length [(N/kN)^2], and a [N/kN]."""

    training: tuple[float, ...]  # Residual variance without regularisation, by p
    held_out: tuple[float, ...]  # The same on other coasts of the same train
    penalised: tuple[float, ...]  # Residual variance of the printed form, lambda = 50, by p
    a: tuple[float, ...]  # Estimate of a in the printed form, by p
    # Variance of predicted minus measured speed, as in Table 2 [(km/h)^2]: LS, then MILS with p = 4.
    velocity: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Batch:
    """Curve errors of batch estimators on fixed windows for one seed and truth [N/kN]."""

    errors: tuple[float, ...]  # LS, ridge with lambda = 50, non-negative LS, LS with a prior that is 20 % off
    negative: bool  # True if ridge with lambda = 1 gives a negative b or c


def shape(seed: int) -> Shape:
    """Return Table 1 of one seed, from segments of Fig. 2."""
    plan = data.CoastPlan()
    training, other = (data.drive(plan, np.random.default_rng((seed, k))) for k in range(2))
    seen, unseen = (seen_by(coasts, FIG2) for coasts in (training, other))
    plain = [fitted(seen, Regression(p)) for p in LENGTHS]
    shrunk = [fitted(seen, Regression(p, PENALTY, len(seen.y))) for p in LENGTHS]
    return Shape(
        training=tuple(residual_variance(theta, seen) for theta in plain),
        held_out=tuple(residual_variance(theta, unseen) for theta in plain),
        penalised=tuple(residual_variance(theta, seen) for theta in shrunk),
        a=tuple(float(theta[0]) for theta in shrunk),
        velocity=(_velocity(plain[0], other), _velocity(plain[2], other)),
    )


def batch(seed: int, truth: tuple[float, float, float], *, narrow: bool) -> Batch:
    """Run the batch estimators on fixed windows of the full record, or of four short coasts in gusts."""
    plan = data.CoastPlan(truth=truth)
    if narrow:
        plan = data.CoastPlan(truth=truth, coasts=4, samples=120, slowest=50.0, fastest=64.0, gust_std=0.3)
    rng = np.random.default_rng(seed)
    seen = seen_by(data.drive(plan, rng), WINDOWS)
    Phi, y = seen.regressors(), seen.y
    prior_mean = np.array(truth) * (1.0 + 0.2 * rng.choice([-1.0, 1.0], 3))
    prior = Prior(prior_mean, np.diag(np.square(_PRIOR_STD)) / least_squares(Phi, y).variance)
    estimates = (
        least_squares(Phi, y).theta,
        ridge(Phi, y, PENALTY).theta,
        nnls(Phi, y)[0],
        fit_with_prior(Phi, y, prior).theta,
    )
    negative = bool(np.any(ridge(Phi, y, 1.0).theta[1:] < 0.0))
    return Batch(tuple(data.curve_error(theta, truth) for theta in estimates), negative)


def dilution() -> tuple[float, float]:
    """Return a for p = 4 and p = 1 by a(p) = A p/(p + k), fitted to the printed a of p = 2 and p = 6 [N/kN]."""
    a2, a6 = PRINTED[2][1], PRINTED[4][1]
    # a2 (2 + k) = 2 A and a6 (6 + k) = 6 A
    k = (6.0 * a6 - 6.0 * a2) / (3.0 * a2 - a6)
    A = a2 * (2.0 + k) / 2.0
    return 4.0 * A / (4.0 + k), A / (1.0 + k)


def seen_by(coasts: data.Coasts, cutter: Cutter) -> Observations:
    """Return the observations extracted from coasts."""
    return observe(coasts.speed, cutter, period=0.2, rotary_mass=data.GAMMA, speed_unit=data.KMH)


def fitted(seen: Observations, regression: Regression) -> Array:
    """Return the parameters of a recursion over all observations, shape (3,)."""
    pairs = (((1.0, v, v * v), y) for v, y in zip(seen.v.tolist(), seen.y.tolist(), strict=True))
    return np.array(run(innovation_step, regression, pairs).theta)


def residual_variance(theta: Array, seen: Observations) -> float:
    """Return the mean squared residual."""
    return float(np.mean((seen.y - seen.regressors() @ theta) ** 2))


def _velocity(theta: Array, coasts: data.Coasts) -> float:
    """Return the variance of measured minus predicted speed [(km/h)^2], each coast from its first measured speed."""
    predicted = data.trajectories((theta[0], theta[1], theta[2]), coasts.speed[:, 0], np.zeros_like(coasts.speed))
    return float(np.var(coasts.speed - predicted))
