# SPDX-License-Identifier: Apache-2.0
"""Gap on held-out runs, compared with the gap that noise alone would leave.

The base model, the nuisances and the amplitudes of all effects are fitted to the other runs; only the initial speed is
fitted to the run held out. The set of effects, their positions and the noise level come from all runs, but an effect
that shows in the held-out run only gets no amplitude from the others and does not reduce the gap there. Products of
whitened columns are kept by run, so leaving runs out is a subtraction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.explanation import Gap
from trainid_ros.explain.noise import share_of_mean
from trainid_ros.explain.regression import posterior
from trainid_ros.train.effects import EFFECTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.explain.marginal_likelihood import Hyperparameters
    from trainid_ros.explain.model import Model

    Array = NDArray[np.float64]

_FOLDS: Final = 12
"""Maximum number of fits."""
FEWEST: Final = 2
"""Minimum number of runs to hold one out."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Speed gaps at all nodes, each from a fit to other runs.

    Attributes:
        gap: Measured less simulated speed [m/s], shape (m,).
        std: Standard deviation expected of a correct model [m/s], shape (m,).

    """

    gap: Array
    std: Array


def hold_out(model: Model, hyper: Hyperparameters) -> HeldOut | None:
    """Return the gaps of all runs, each held out in turn; None with fewer than :data:`FEWEST` runs."""
    runs = len(model.dataset.runs)
    if runs < FEWEST:
        return None
    products = model.products_by_run(model.columns, hyper.spread, model.whitener(hyper))
    total = products.sum(axis=0)
    root, neutral = model.prior_factor(hyper.spread), _neutral(model)
    residual = model.columns @ neutral[:, 0]
    gap, deviation = np.zeros(model.residual.size), np.zeros(model.residual.size)
    for fold in np.array_split(np.arange(runs), min(runs, _FOLDS)):
        seen = total - products[fold].sum(axis=0)
        model.add_odometry(seen)
        mean, covariance = posterior(neutral.T @ seen @ neutral, root)
        for run in fold.tolist():
            at = model.dataset.node_run == run
            left = residual[at] - model.nuisance_columns[at] @ mean
            gap[at], deviation[at] = _centred(model, at, left, _noise(model, hyper, at, covariance))
    return HeldOut(gap, deviation)


def _neutral(model: Model) -> Array:
    """Return the transformation of columns that removes all effects from the residual, shape (1 + q + k, 1 + q + k).

    A fit to other runs then estimates their amplitudes from zero effect, with a wide prior centred there.
    """
    change = np.eye(model.columns.shape[1])
    for term, here in model.places():
        kind = EFFECTS[term.name]
        at = 1 + here.start + list(term.parameters).index(kind.amplitude)
        change[at, 0] = term.parameters[kind.amplitude] - kind.neutral
    return change


def _centred(model: Model, at: NDArray[np.bool_], left: Array, expected: Array) -> tuple[Array, Array]:
    """Return the residual of one run less its mean, and the std expected of it [m/s], shapes (m,)."""
    known = (model.dataset.node_count[at] > 0.0).astype(float)
    centre = np.eye(known.size) - known[None, :] / max(known.sum(), 1.0)
    variance = np.einsum('ij,jk,ik->i', centre, expected, centre)
    return centre @ left, np.sqrt(np.maximum(variance, 0.0))


def gap_of(before: HeldOut | None, after: HeldOut | None, model: Model) -> Gap | None:
    """Return the RMS gap without and with the effects over all measured nodes, and the noise floor; None if unknown."""
    if before is None or after is None:
        return None
    known = model.dataset.node_count > 0.0
    return Gap(_rms(before.gap[known]), _rms(after.gap[known]), _rms(after.std[known]), len(model.dataset.runs))


def _noise(model: Model, hyper: Hyperparameters, at: NDArray[np.bool_], covariance: Array) -> Array:
    """Return the covariance of the speed errors of one run that a correct model leaves [(m/s)^2].

    It covers integrated gusts, sensor noise, payload and brake, and the uncertainty of a, b, c and of the map as fitted
    to the other runs, but not the uncertainty of the effects.
    """
    base = model.without_terms
    columns = model.nuisance_columns[at][:, base]
    noise, spread = hyper.noise, hyper.spread
    t = model.dataset.node_time[at] - model.dataset.node_time[at][0]
    tau = noise.gust_time
    lesser = np.minimum(t[:, None], t[None, :])
    decay = np.exp(-t / tau)
    gust = 2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    factors = model.factor_columns[at] * spread.of_run
    white = noise.speed**2 * share_of_mean(model.dataset.node_count[at])
    scale = (noise.gust * tau / model.dataset.inertia) ** 2
    nuisances = columns @ covariance[np.ix_(base, base)] @ columns.T
    return np.asarray(scale * gust + factors @ factors.T + np.diag(white) + nuisances)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
