# SPDX-License-Identifier: Apache-2.0
"""The gap on runs that the fit never saw, beside what noise alone would leave.

All parameters are fitted to the other runs; the run held out gets its best initial speed, no more. Products of
whitened columns are kept by run, so a fit without some runs is a subtraction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.discrepancy.explanation import Gap
from trainid_ros.discrepancy.noise import share_of_mean
from trainid_ros.discrepancy.regression import posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.discrepancy.hyper import Sizes
    from trainid_ros.discrepancy.model import Model

    Array = NDArray[np.float64]

_FOLDS: Final = 12
FEWEST: Final = 2
"""Runs that are needed to hold one out."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Speed gaps at all nodes, each from a fit to other runs, and their standard deviations [m/s], shape (m,)."""

    gap: Array
    std: Array


def hold_out(model: Model, sizes: Sizes) -> HeldOut | None:
    """Return the gaps of all runs, each held out in turn; None with fewer than :data:`FEWEST` runs."""
    runs = len(model.drive.runs)
    if runs < FEWEST:
        return None
    products = np.concatenate(list(model.products(model.columns, sizes.spread, model.whitener(sizes))))
    total = products.sum(axis=0)
    root = model.prior_factor(sizes.spread)
    gap, deviation = np.zeros(model.residual.size), np.zeros(model.residual.size)
    for fold in np.array_split(np.arange(runs), min(runs, _FOLDS)):
        seen = total - products[fold].sum(axis=0)
        model.add_odometry(seen)
        mean, covariance = posterior(seen, root)
        for run in fold.tolist():
            at = model.drive.node_run == run
            gap[at], deviation[at] = _gap(model, sizes, at, mean, covariance)
    return HeldOut(gap, deviation)


def _gap(model: Model, sizes: Sizes, at: NDArray[np.bool_], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the gap of one run with nuisances as estimated, less its own mean, and its std [m/s], shapes (m,)."""
    columns = model.nuisance_columns[at]
    expected = _noise(model, sizes, at) + columns @ covariance @ columns.T
    known = (model.drive.node_count[at] > 0.0).astype(float)
    centre = np.eye(known.size) - known[None, :] / max(known.sum(), 1.0)
    variance = np.einsum('ij,jk,ik->i', centre, expected, centre)
    return centre @ (model.residual[at] - columns @ mean), np.sqrt(np.maximum(variance, 0.0))


def gap_of(before: HeldOut | None, after: HeldOut | None, model: Model) -> Gap | None:
    """Return the RMS of both over all nodes that were measured, and that of the noise."""
    if before is None or after is None:
        return None
    known = model.drive.node_count > 0.0
    return Gap(_rms(before.gap[known]), _rms(after.gap[known]), _rms(after.std[known]), len(model.drive.runs))


def _noise(model: Model, sizes: Sizes, at: NDArray[np.bool_]) -> Array:
    """Return the covariance of the speed errors of one run: integrated gusts, sensor noise, payload and brake."""
    noise, spread = sizes.noise, sizes.spread
    t = model.drive.node_time[at] - model.drive.node_time[at][0]
    tau = noise.gust_time
    lesser = np.minimum(t[:, None], t[None, :])
    decay = np.exp(-t / tau)
    gust = 2.0 * lesser / tau - 1.0 + decay[:, None] + decay[None, :] - np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
    factors = model.factor_columns[at] * spread.of_run
    white = noise.speed**2 * share_of_mean(model.drive.node_count[at])
    scale = (noise.gust * tau / model.drive.inertia) ** 2
    return np.asarray(scale * gust + factors @ factors.T + np.diag(white))


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
