# SPDX-License-Identifier: Apache-2.0
"""Measurement update of :mod:`trainid_ros.brake_rate.particles` for any linear measurement y = H x."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.brake_rate.particles import Correction

if TYPE_CHECKING:
    from trainid_ros.brake_rate.particles import Array


def correction(P: Array, H: Array, R: Array) -> Correction:
    """Return the update of a predicted covariance P, shape (n, n), with y = H x of noise covariance R."""
    PH = P @ H.T
    # Eq. (16).
    S = H @ PH + R
    if S.size == 1:  # one measurement needs no matrix algebra
        s = float(S[0, 0])
        return Correction(PH / s, P - PH @ (PH.T / s), np.array([[1.0 / math.sqrt(s)]]))
    W = np.linalg.inv(np.linalg.cholesky(S))
    # Eqs. (20), (21), in Joseph form.
    K = PH @ W.T @ W
    A = np.eye(len(P)) - K @ H
    return Correction(K, A @ P @ A.T + K @ R @ K.T, W)


def distance(W: Array, nu: Array) -> Array:
    """Return the squared Mahalanobis distance [1] of innovations, shape (...), from shape (m, ...)."""
    if len(W) == 1:
        scaled: Array = W[0, 0] * nu[0]
        return scaled * scaled
    whitened = np.tensordot(W, nu, axes=1)
    squares: Array = (whitened * whitened).sum(axis=0)
    return squares
