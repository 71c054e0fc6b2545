# SPDX-License-Identifier: Apache-2.0
"""The recursion of V-MILS with its memory in an array, which is what makes a compiled call short.

Turning tuples of floats into objects and back takes longer than the recursion itself. Here only what is
measured goes in and what is asked comes out, one row at a time or a record at once. Without a compiler the same
functions run as they are, more slowly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.estimators.compiled.jit import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.resistance.davis_posterior import DavisPosterior

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
