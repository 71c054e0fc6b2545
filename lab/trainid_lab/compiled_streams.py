# SPDX-License-Identifier: Apache-2.0
"""The recursions of V-MILS and AM-VFF-RLS with their memory in arrays, which is what makes a compiled call short.

Turning tuples of floats into objects and back takes longer than the recursions themselves. Here only what is
measured goes in and what is asked comes out, one row at a time or a record at once. Without a compiler the same
functions run as they are, more slowly.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.estimators.compiled.jit import compiled
from trainid_ros.speed_model.am_vff_rls import learn

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from trainid_ros.resistance.robust import DavisPosterior
    from trainid_ros.speed_model.am_vff_rls import Tuning
    from trainid_ros.speed_model.method import Numbers

    Floats = NDArray[np.float64]


class VMilsStream:
    """Multi-innovation least squares with the soft gate, see :func:`multi_innovation.mils_step`."""

    def __init__(self, prior: DavisPosterior, p: int, outliers: float) -> None:
        self.__setstate__(np.array((*information_of(prior), *NOTHING, 0.0, outliers, *NOTHING * p)))

    def __getstate__(self) -> Floats:
        """Return what a copy needs: the numbers, not the code."""
        return self._memory

    def __setstate__(self, memory: Floats) -> None:
        """Go on from them."""
        self._memory = memory
        self._row, self._rows = compiled(mils_row), compiled(mils_rows)

    @property
    def posterior(self) -> DavisPosterior:
        """Return a, b, c and the upper triangle of their covariance."""
        return posterior_of(tuple(self._memory[:9].tolist()))

    def step(self, v: float, s: float, y: float, R: float, slow: float) -> float:
        """Take in one row; return its weight, 0 for an outlier."""
        return self._row(self._memory, v, s, y, R, slow)

    def run(self, rows: Floats) -> Floats:
        """Take in rows of v, mean of v^2, y, R and slow, shape (n, 5); return their weights, shape (n,)."""
        weights = np.empty(len(rows))
        self._rows(self._memory, np.ascontiguousarray(rows, dtype=np.float64), weights)
        return weights


def mils_row(memory: Floats, v: float, s: float, y: float, R: float, slow: float) -> float:
    """Take in one row; return its weight.

    Args:
        memory: The 18 numbers of a state, place of the oldest part, share of outliers, the p parts of 9 numbers each.
        v: Speed [m/s].
        s: Mean square of the speed.
        y: Observed resistance [N/kN].
        R: Its variance.
        slow: How many times R it counts in the mean of many.

    """
    m, p = memory, (memory.size - 20) // 9
    place = int(m[18])
    o = m[20 + 9 * place : 29 + 9 * place]
    state, newest, weight, _ = mils_step(
        (m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8],
         m[9], m[10], m[11], m[12], m[13], m[14], m[15], m[16], m[17]),
        (o[0], o[1], o[2], o[3], o[4], o[5], o[6], o[7], o[8]),
        v, s, y, R, slow, m[19], p,
    )  # fmt: skip
    for i in range(18):
        m[i] = state[i]
    for i in range(9):
        o[i] = newest[i]
    m[18] = (place + 1) % p
    return weight


def mils_rows(memory: Floats, rows: Floats, weights: Floats) -> None:
    """Take in rows; write their weights."""
    for k in range(rows.shape[0]):
        weights[k] = mils_row(memory, rows[k, 0], rows[k, 1], rows[k, 2], rows[k, 3], rows[k, 4])


class SpeedModelStream:
    """AM-VFF-RLS, see :func:`am_vff_rls.learn`."""

    def __init__(self, start: Numbers, tuning: Tuning) -> None:
        self.__setstate__((np.array(start), tuning))

    def __getstate__(self) -> tuple[Floats, Tuning]:
        """Return what a copy needs: the numbers, not the code."""
        return self._memory, self._tuning

    def __setstate__(self, state: tuple[Floats, Tuning]) -> None:
        """Go on from them."""
        self._memory, self._tuning = state
        self._row, self._rows = speed_kernels(self._tuning)

    @property
    def numbers(self) -> Numbers:
        """Return the state, as :func:`am_vff_rls.learn` takes it."""
        return tuple(self._memory.tolist())

    def step(self, y: float, u: float, scale: float, variance: float) -> float:
        """Take in a measurement; return its error [m/s]."""
        return self._row(self._memory, y, u, scale, variance)

    def run(self, rows: Floats) -> Floats:
        """Take in rows of y, u, scale and variance, shape (n, 4); return their errors [m/s], shape (n,)."""
        errors = np.empty(len(rows))
        self._rows(self._memory, np.ascontiguousarray(rows, dtype=np.float64), errors)
        return errors


@cache
def speed_kernels(
    tuning: Tuning,
) -> tuple[Callable[[Floats, float, float, float, float], float], Callable[[Floats, Floats, Floats], None]]:
    """Return what takes one measurement, and rows of them, into the 21 numbers of a state.

    The tuning is part of the code: handing it over with each call would take longer than the step.
    """

    def row(memory: Floats, y: float, u: float, scale: float, variance: float) -> float:
        m = memory
        learned = learn(
            (m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9], m[10],
             m[11], m[12], m[13], m[14], m[15], m[16], m[17], m[18], m[19], m[20]),
            y, u, scale, variance, tuning,
        )  # fmt: skip
        for i in range(21):
            m[i] = learned.numbers[i]
        return learned.error

    fast_row = compiled(row)

    def rows(memory: Floats, given: Floats, errors: Floats) -> None:
        for k in range(given.shape[0]):
            errors[k] = fast_row(memory, given[k, 0], given[k, 1], given[k, 2], given[k, 3])

    return fast_row, compiled(rows)
