# SPDX-License-Identifier: Apache-2.0
"""Speed over distance, stage by stage: eqs. (7) to (23) of Xia et al. 2023, corrected.

``v_i^2 = v_{i-1}^2 + 2 lambda_i [1000 F_i/(M g) - w_add,i - a - b v_{i-1} - c v_{i-1}^2]`` with
``lambda_i = g ds_i / (1000 (1 + gamma))``. Differences from the paper: all resistances are specific (the paper
divides G [kN] by 1000 once more), v is in m/s for every printed theta, and F and w_add may be means over the stage
instead of their values at its start. Sampling them at the start is the only significant error of the scheme; holding
w(v) constant over a stage has a negligible effect.

Corrections of the objective (8), its gradient and its Hessian, (11)-(23): (14) needs dv/db on its right-hand side; the
sign of q in (18), lines 2-3, and in (19)-(23) is plus; (16) adds the curvature term; all forms of (8), (11) and (16)
have the mean over I. The derivatives are linear recursions with the same coefficients k, so each set is one bidiagonal
system.

The additional resistance (5) of a train of several masses: the paper divides G(s) [kN] by 1000 once more in (7); here
it is specific, ``w_add = sum m_j/M (i(s_j) + alpha/r(s_j))`` in N/kN. Sampling it at the start of a stage, as in (7),
is inaccurate if the line changes within the stage, so :meth:`MultiMassLine.means` gives the exact mean over each stage
from the integrals of gradient and curvature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.resistance.davis_fit import recur
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import Line, Pairs

STALL_SPEED: Final = 1.0
"""Lower limit of the modelled speed [m/s]: for parameters far from the truth (7) has no real root."""


def reach(steps: NDArray[np.float64], gamma: float) -> NDArray[np.float64]:
    """Return lambda [m^2/s^2 per N/kN] of stages of given lengths [m]; gamma is the share of rotating masses [1]."""
    lam: NDArray[np.float64] = steps * (G / (1000.0 * (1.0 + gamma)))
    return lam


@dataclass(frozen=True, slots=True)
class Stages:
    """Known quantities of I stages."""

    lam: NDArray[np.float64]  # lambda [m^2/s^2 per N/kN], shape (I,)
    drive: NDArray[np.float64]  # Traction minus additional resistance, 1000 F/(M g) - w_add [N/kN], shape (I,)

    def speeds(self, theta: NDArray[np.float64], start: float) -> NDArray[np.float64]:
        """Return v_0 to v_I of (7) [m/s], shape (I + 1,), from an initial speed; never below the stall speed."""
        a, b, c = (float(x) for x in theta)
        v, floor = start, STALL_SPEED * STALL_SPEED
        path, sqrt = [v], math.sqrt
        for lam, drive in zip(self.lam.tolist(), self.drive.tolist(), strict=True):
            # (7)
            square = v * v + 2.0 * lam * (drive - a - v * (b + c * v))
            v = sqrt(square) if square > floor else STALL_SPEED
            path.append(v)
        return np.array(path)


@dataclass(frozen=True, slots=True)
class Coefficients:
    """k, p, q, u below (13) and (18), each of shape (I,); zero in a stage that stalls."""

    k: NDArray[np.float64]
    p: NDArray[np.float64]
    q: NDArray[np.float64]
    u: NDArray[np.float64]

    @classmethod
    def along(cls, stages: Stages, theta: NDArray[np.float64], v: NDArray[np.float64]) -> Coefficients:
        """Return the coefficients along speeds v [m/s], shape (I + 1,)."""
        _, b, c = theta
        u = np.where(v[1:] > STALL_SPEED, 1.0 / v[1:], 0.0)
        # Brackets added that are missing in the text below (13).
        k = (v[:-1] - stages.lam * (b + 2.0 * c * v[:-1])) * u
        return cls(k=k, p=stages.lam * u, q=(1.0 - 2.0 * c * stages.lam) * u, u=u)


PAIRS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Order of second derivatives: aa, ab, ac, bb, bc, cc."""


@dataclass(frozen=True, slots=True)
class Objective:
    """Value f of (8) [(m/s)^2], gradient g, shape (3,), and Hessian H, shape (3, 3), for a, b, c."""

    f: float
    g: NDArray[np.float64]
    H: NDArray[np.float64]


def first_derivatives(coefficients: Coefficients, v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return dv_i/da, dv_i/db, dv_i/dc and dv_i/dv_0 of stages 1 to I, shape (4, I).

    (13)-(15): ``x_i = k_i x_{i-1} - p_i v_{i-1}^n`` with n = 0, 1, 2.
    """
    k, p, before = coefficients.k, coefficients.p, v[:-1]
    rows = np.zeros((4, k.size))
    rows[0] = -p
    rows[1] = rows[0] * before
    rows[2] = rows[1] * before
    rows[3, 0] = k[0]  # dv_0/dv_0 = 1
    return recur(k, rows)


def second_derivatives(
    coefficients: Coefficients, v: NDArray[np.float64], first: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the second derivatives of v_i by a, b, c in the order of :data:`PAIRS`, shape (6, I).

    (18)-(23): ``v_xy,i = k v_xy,i-1 + q v_x,i-1 v_y,i-1 - u v_x,i v_y,i - p E_xy``; the additional terms E_xy are the
    derivatives of ``b v + c v^2`` with respect to one parameter through v and to the other one explicitly.
    """
    now = first[:3]
    last = np.concatenate((np.zeros((3, 1)), now[:, :-1]), axis=1)
    powers = v[:-1] ** np.arange(3)[:, None]
    # d(v^n)/dx = n v^(n-1) v_x, for the parameter with regressor v^n.
    slope = np.vstack((np.zeros_like(powers[0]), powers[0], 2.0 * powers[1]))
    rows = [
        coefficients.q * last[x] * last[y]
        - coefficients.u * now[x] * now[y]
        - coefficients.p * (slope[y] * last[x] + slope[x] * last[y])
        for x, y in PAIRS
    ]
    return recur(coefficients.k, np.array(rows))


def objective(stages: Stages, measured: NDArray[np.float64], theta: NDArray[np.float64], start: float) -> Objective:
    """Return (8), (11) and (16) for speeds computed from a given initial speed.

    Args:
        stages: Known quantities of the stages.
        measured: v~_1 to v~_I [m/s], shape (I,).
        theta: a, b, c [N/kN, v in m/s], shape (3,).
        start: v_0 [m/s].

    """
    v = stages.speeds(theta, start)
    coefficients = Coefficients.along(stages, theta, v)
    first = first_derivatives(coefficients, v)
    second = second_derivatives(coefficients, v, first)
    return assemble(v[1:] - measured, first[:3], second)


def assemble(error: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]) -> Objective:
    """Return f (8), g (11) and H (16) from errors, shape (I,), and derivatives of the speeds, (3, I) and (6, I)."""
    count = error.size
    H = first @ first.T
    for (x, y), bend in zip(PAIRS, second @ error, strict=True):
        H[x, y] += bend
        H[y, x] = H[x, y]
    return Objective(float(error @ error) / count, 2.0 / count * (first @ error), 2.0 / count * H)


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
