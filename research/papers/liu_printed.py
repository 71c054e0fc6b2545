# SPDX-License-Identifier: Apache-2.0
"""The recursions of Liu et al. 2018 exactly as printed, as matrices, for comparison with the kernels and claims."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]


def rls(theta: Array, P: Array, phi: Array, y: float, mu: float = 1.0) -> tuple[Array, Array]:
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


def mils(theta: Array, P: Array, Phi: Array, Y: Array) -> tuple[Array, Array]:
    """Return theta and P after one step of MILS, Phi of shape (3, p), Y of shape (p,)."""
    L = P @ Phi @ np.linalg.inv(np.eye(len(Y)) + Phi.T @ P @ Phi)
    return theta + L @ (Y - Phi.T @ theta), P - L @ Phi.T @ P


def rls_symmetric_gain(theta: Array, P: Array, phi: Array, y: float, mu: float) -> tuple[Array, Array]:
    """Return one step of RLS in the common form P -= (g/S) g', g = P phi, in which any asymmetry of P grows."""
    g = P @ phi
    S = mu + phi @ g
    return theta + g / S * (y - phi @ theta), (P - np.outer(g / S, g)) / mu
