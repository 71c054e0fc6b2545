# SPDX-License-Identifier: Apache-2.0
"""A linear state x with a parameter f that acts on a known input, x' = Phi x + f gamma + known, measured as y = H x.

f affects only the mean of x, so all particles share one covariance, see :mod:`trainid_ros.brake_rate.gsma`.
Arrays over N particles have the particles in the last axis.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainid_ros.brake_rate.motion_model import STATES, Errors, Start, Transition

Array = NDArray[np.float64]

# v of x = [v, a, b, e] is measured.
SPEED: Final = np.eye(1, STATES)
_IDENTITY: Final = np.eye(STATES)


class LinearStep(NamedTuple):
    """One step of the model."""

    Phi: Array  # Transition, shape (n, n)
    gamma: Array  # Effect of f = 1, shape (n,)
    known: Array  # Effect of all known inputs, shape (n,)
    Q: Array  # Covariance of the process noise, shape (n, n)

    def predict(self, x: Array, f: Array) -> Array:
        """Return the means of x after the step, eq. (14), from x, shape (n, N), and the rates f, shape (N,)."""
        after: Array = self.Phi @ x
        after += self.gamma[:, None] * f
        after += self.known[:, None]
        return after

    def predict_covariance(self, P: Array) -> Array:
        """Return the shared covariance after the step, eq. (14)."""
        after: Array = self.Phi.dot(P).dot(self.Phi.T) + self.Q
        return after


class Correction(NamedTuple):
    """Measurement update, the same for all particles."""

    K: Array  # Gain, eq. (20), shape (n, m)
    P: Array  # Covariance after the measurement, eq. (21), shape (n, n)
    W: Array  # Whitening matrix of innovations: W S W' = I with their covariance S, eq. (16), shape (m, m)


def speed_correction(P: Array, r: float) -> Correction:
    """Return the update of x = [v, ...] for v measured with variance r [(m/s)^2], without matrix algebra."""
    column = P[:, :1]
    s = float(P[0, 0]) + r
    K = column / s
    return Correction(K, P - K.dot(column.T), np.array([[1.0 / math.sqrt(s)]]))


def speed_step(interval: Transition) -> LinearStep:
    """Return the step of x = [v, a, b, e] over an interval."""
    Phi, gamma, known, Q = _IDENTITY.copy(), np.zeros(STATES), np.zeros(STATES), np.zeros((STATES, STATES))
    Phi[0] = (1.0, interval.reach, interval.dt, *interval.gain_e)
    Phi.flat[STATES + 1 :: STATES + 1] = (interval.decay, interval.rho, *interval.decay_e)
    gamma[0], gamma[1], known[0] = interval.gain_v, interval.gain_a, interval.known
    Q.flat[:: STATES + 1] = (interval.q_v, 0.0, interval.q_b, *interval.q_e)
    return LinearStep(Phi, gamma, known, Q)


def error_covariance(stds: Errors) -> Array:
    """Return the covariance of x with uncertainty in the errors only, shape (n, n)."""
    return np.diag([0.0, 0.0, 0.0, *np.square(stds)])


def started(P: Array, start: Start) -> Array:
    """Return the covariance of x after a restart of v, a and b, shape (n, n)."""
    after = np.zeros_like(P)
    after[3:, 3:] = P[3:, 3:] * np.outer(list(start.decay_e), list(start.decay_e))
    after.flat[:: len(P) + 1] += (*start.variances, *start.q_e)
    return after


def errors_of(values: Array) -> Errors:
    """Return eight numbers as a tuple of errors."""
    e: list[float] = values.tolist()
    return e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7]


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


def normalise(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return log-weights whose exponentials sum to one; equal weights if all are -inf."""
    peak = float(np.max(log_weights))
    if not np.isfinite(peak):
        return np.full(len(log_weights), -np.log(len(log_weights)))
    shifted = log_weights - peak
    normal: NDArray[np.float64] = shifted - np.log(np.sum(np.exp(shifted)))
    return normal


def systematic(weights: NDArray[np.float64], count: int, uniform: float) -> NDArray[np.intp]:
    """Return ``count`` ancestor indices, shape (count,), from one uniform draw in [0, 1).

    Unbiased, unlike keeping the largest weights. The index is clamped because the cumulated weights can
    end below one by rounding.
    """
    positions = (np.arange(count) + uniform) / count
    ancestors = np.searchsorted(np.cumsum(weights), positions, side='right')
    return np.minimum(ancestors, len(weights) - 1)


def normal_weights(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights that sum to one; equal weights if all log-weights are -inf."""
    peak = float(log_weights.max())
    if not math.isfinite(peak):
        return np.full(log_weights.shape, 1.0 / log_weights.size)
    weights: NDArray[np.float64] = np.exp(log_weights - peak)
    weights /= weights.sum()
    return weights


def effective_number(weights: NDArray[np.float64]) -> float:
    """Return 1 / sum of squared normalised weights [1]; Zheng et al. print it with unnormalised weights."""
    return 1.0 / float(weights.dot(weights))
