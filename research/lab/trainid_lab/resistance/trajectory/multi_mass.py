# SPDX-License-Identifier: Apache-2.0
"""Additional resistance of a train of several masses on a line, eq. (5) of Xia et al. 2023.

The paper divides G(s) [kN] by 1000 once more in (7); here it is specific, ``w_add = sum m_j/M (i(s_j) + alpha/r(s_j))``
in N/kN. Sampling it at the start of a stage, as in (7), is inaccurate if the line changes within the stage, so
:meth:`MultiMassLine.means` gives the exact mean over each stage from the integrals of gradient and curvature.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.train.train_file import Line, Pairs

CURVE_COEFFICIENT: Final = 600.0
"""alpha of (5) [N/kN times m]."""


@dataclass(frozen=True, slots=True)
class Cars:
    """Masses of a train."""

    mass: NDArray[np.float64]  # Mass of each car [any common unit], shape (J,), head first
    offset: NDArray[np.float64]  # Distance of each car's centroid behind the head [m], shape (J,)

    @classmethod
    def of_lengths(cls, mass: NDArray[np.float64], length: NDArray[np.float64]) -> Cars:
        """Return consecutive cars of given masses [any common unit] and lengths [m], their centroids in the middle."""
        if len(mass) != len(length) or not np.all(mass > 0.0) or not np.all(length > 0.0):
            raise InputError(f'cars: {len(mass)} masses and {len(length)} lengths must be equal in number and > 0')
        return cls(mass, np.cumsum(length) - 0.5 * length)


class MultiMassLine:
    """Line under all cars; positions are those of the head [m], in increasing order."""

    def __init__(self, line: Line, cars: Cars, curve_coefficient: float = CURVE_COEFFICIENT) -> None:
        self._share = cars.mass / cars.mass.sum()
        self._offset = cars.offset
        self._gradient = _Steps(line.gradient)
        self._curve = _Steps(tuple((x, curve_coefficient / r if r > 0.0 else 0.0) for x, r in line.curve))

    def at(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return w_add [N/kN] with the head at each position, shape (n,)."""
        under = positions[:, None] - self._offset
        w: NDArray[np.float64] = (self._gradient.values(under) + self._curve.values(under)) @ self._share
        return w

    def means(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean of w_add [N/kN] between neighbouring positions, shape (n - 1,)."""
        under = positions[:, None] - self._offset
        work = (self._gradient.integrals(under) + self._curve.integrals(under)) @ self._share
        w: NDArray[np.float64] = np.diff(work) / np.diff(positions)
        return w


class _Steps:
    """Piecewise-constant function of position; its first and last values extend outside."""

    def __init__(self, pairs: Pairs) -> None:
        knots = pairs or ((0.0, 0.0),)
        self._x = np.array([x for x, _ in knots])
        self._value = np.array([value for _, value in knots])
        areas = [value * (following - x) for (x, value), (following, _) in pairwise(knots)]
        self._sum = np.concatenate(([0.0], np.cumsum(areas)))

    def _index(self, x: NDArray[np.float64]) -> NDArray[np.intp]:
        return np.maximum(np.searchsorted(self._x, x, side='right') - 1, 0)

    def values(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        values: NDArray[np.float64] = self._value[self._index(x)]
        return values

    def integrals(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        i = self._index(x)
        area: NDArray[np.float64] = self._sum[i] + self._value[i] * (x - self._x[i])
        return area
