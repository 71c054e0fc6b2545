# SPDX-License-Identifier: Apache-2.0
"""Hand-written recursive least squares, the reference for all other estimators of a, b, c."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from research.peers.metro_stream import NOISE_SD, MetroStream

Item = tuple[Any, ...]

START: Final = (1.0, 0.0, 0.001)
"""Prior mean of a, b, c for all estimators [N/kN, v in m/s]."""
START_SD: Final = (1.0, 0.1, 0.003)
VARIANCE: Final = NOISE_SD**2
GATE: Final = 4.0
"""Limit of a gate, in standard deviations."""


class RowPeer:
    """An estimator of the regression form.

    Attributes:
        step: Processes one row, of what ``items`` returns: y and phi.

    """

    step: Any

    def items(self, stream: MetroStream) -> list[Item]:
        """Return the arguments of the steps, in order."""
        return list(zip(stream.rows.y.tolist(), list(stream.rows.phi), strict=True))

    @property
    def moments(self) -> tuple[Any, Any]:
        """Return a state that ends with a, b, c, and its covariance, None if the estimator provides none."""
        raise NotImplementedError

    @property
    def theta(self) -> NDArray[np.float64]:
        """Return a, b, c, shape (3,)."""
        return np.asarray(self.moments[0], dtype=np.float64).ravel()[-3:]

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Return the covariance of a, b, c, shape (3, 3), if the estimator provides one."""
        covariance = self.moments[1]
        return None if covariance is None else np.asarray(covariance, dtype=np.float64)[-3:, -3:]


def speeds_of(stream: MetroStream) -> list[Item]:
    """Return y and speed of each row."""
    return list(zip(stream.rows.y.tolist(), stream.rows.phi[:, 1].tolist(), strict=True))


def square(upper: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the symmetric matrix (3, 3) of an upper triangle."""
    full = np.zeros((3, 3))
    full[np.triu_indices(3)] = upper
    return full + np.triu(full, 1).T


class HandRls(RowPeer):
    """Recursive least squares in plain floats; optionally with a gate and a forgetting factor."""

    def __init__(self, gate: float = 1e9, forgetting: float = 1.0) -> None:
        self._limit = gate * gate
        self._lam = forgetting
        self._state = (*START, START_SD[0] ** 2, 0.0, 0.0, START_SD[1] ** 2, 0.0, START_SD[2] ** 2)

    def items(self, stream: MetroStream) -> list[Item]:
        return speeds_of(stream)

    def step(self, y: float, v: float) -> None:
        a, b, c, paa, pab, pac, pbb, pbc, pcc = self._state
        w = v * v
        ga, gb, gc = paa + v * pab + w * pac, pab + v * pbb + w * pbc, pac + v * pbc + w * pcc
        s = VARIANCE + ga + v * gb + w * gc
        e = y - (a + v * b + w * c)
        if e * e > self._limit * s:
            return
        k, m = e / s, 1.0 / self._lam
        self._state = (
            a + ga * k,
            b + gb * k,
            c + gc * k,
            (paa - ga * ga / s) * m,
            (pab - ga * gb / s) * m,
            (pac - ga * gc / s) * m,
            (pbb - gb * gb / s) * m,
            (pbc - gb * gc / s) * m,
            (pcc - gc * gc / s) * m,
        )

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._state[:3], square(self._state[3:])


class NumpyRls(RowPeer):
    """The same with numpy."""

    def __init__(self) -> None:
        self._theta = np.array(START)
        self._P = np.diag(np.square(START_SD))

    def step(self, y: float, phi: NDArray[np.float64]) -> None:
        g = self._P @ phi
        K = g / (VARIANCE + phi @ g)
        self._theta = self._theta + K * (y - phi @ self._theta)
        self._P = self._P - np.outer(K, g)

    @property
    def moments(self) -> tuple[Any, Any]:
        return self._theta, self._P
