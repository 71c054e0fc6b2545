# SPDX-License-Identifier: Apache-2.0
"""Errors of the simulated speed that no model will explain, and the filter that whitens them.

Three things make simulated and measured speed part although the model is right: gusts, a resistance that comes and
goes as an Ornstein-Uhlenbeck process and whose response is its integral; noise of the measured speed; and an initial
speed that nobody knows. A Kalman filter on the state [speed error, gust] turns them into independent unit noise. It
is linear, so the columns of all candidates pass through it with the same gains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.discrepancy.nodes import Drive

    Array = NDArray[np.float64]

_DIFFUSE: Final = 1e2
"""Variance of an unknown initial speed error [(m/s)^2]."""
# Errors of neighbouring samples are not quite independent: quantised speeds repeat.
_SHARED: Final = 0.1


@dataclass(frozen=True, slots=True)
class Noise:
    """Sizes of what is random along a run.

    Attributes:
        speed: Noise of one measured speed [m/s].
        gust: Standard deviation of the gusts [N/kN].
        gust_time: Their correlation time [s].
        jitter: Unknown delay of each change of traction or brake [s]: forces are read a few times a second.

    """

    speed: float
    gust: float
    gust_time: float
    jitter: float


@dataclass(frozen=True, slots=True)
class Grid:
    """Nodes of all runs side by side, padded to the longest; N nodes by R runs.

    Attributes:
        index: Node at each place, the number of nodes where there is none, shape (N, R).
        dt: Time since the node before [s], shape (N, R).
        share: Variance of a node's error in those of one speed; infinite where nothing was measured, shape (N, R).
        change: Change of the force since the node before, as acceleration [m/s^2], shape (N, R).
        inertia: Specific force per acceleration [N/kN per m/s^2].
        nodes: Number of nodes of all runs.

    """

    index: NDArray[np.intp]
    dt: Array
    share: Array
    change: Array
    inertia: float
    nodes: int

    @classmethod
    def of(cls, drive: Drive) -> Grid:
        """Return the grid of a drive."""
        counts = np.unique(drive.node_run, return_counts=True)[1]
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        rows = np.arange(counts.max())[:, None]
        inside = rows < counts[None, :]
        index = np.where(inside, first[None, :] + rows, drive.node_time.size).astype(np.intp)
        time = np.append(drive.node_time, 0.0)[index]
        dt = np.zeros(index.shape)
        dt[1:] = np.where(inside[1:], time[1:] - time[:-1], 1.0)
        count = np.append(drive.node_count, 0.0)[index]
        share = np.where(count > 0.0, share_of_mean(count), np.inf)
        force = drive.joined('traction') + drive.joined('brake')
        first_force = np.append(force[drive.node_starts], 0.0)[index]
        change = np.zeros(index.shape)
        change[1:] = np.where(inside[1:], np.abs(first_force[1:] - first_force[:-1]) / drive.inertia, 0.0)
        return cls(index, dt, share, change, drive.inertia, drive.node_time.size)

    def part(self, runs: slice) -> Grid:
        """Return the grid of some of the runs."""
        longest = int((self.index[:, runs] < self.nodes).sum(axis=0).max())
        dt, share, change = (array[:longest, runs] for array in (self.dt, self.share, self.change))
        return Grid(self.index[:longest, runs], dt, share, change, self.inertia, self.nodes)

    def spread(self, columns: Array) -> Array:
        """Return columns of all nodes, shape (m, C), on the grid, shape (N, R, C)."""
        padded = np.concatenate([columns, np.zeros((1, columns.shape[1]))])
        return np.asarray(padded[self.index])


@dataclass(frozen=True, slots=True)
class Whitener:
    """Gains of the filter for one noise; see :meth:`apply`.

    Attributes:
        gain_v: Gain of the speed error, shape (N, R).
        gain_g: Gain of the gust, shape (N, R).
        scale: One over the standard deviation of the innovation, 0 where nothing was measured, shape (N, R).
        keep: How much of a gust is left one node on, shape (N, R).
        reach: Speed error one node on per gust now [m/s per N/kN], shape (N, R).
        log_det: Sum over all measurements of the log of the innovation's variance, by run, shape (R,).

    """

    gain_v: Array
    gain_g: Array
    scale: Array
    keep: Array
    reach: Array
    log_det: Array

    @classmethod
    def of(cls, grid: Grid, noise: Noise) -> Whitener:
        """Run the covariances of the filter once through the grid."""
        inside = np.where(grid.index < grid.nodes, 1.0, 0.0)
        gain_v, gain_g, scale, keep, reach, log_s = _gains(grid, noise)
        return cls(gain_v * inside, gain_g * inside, scale * inside, keep, reach, (log_s * inside).sum(axis=0))

    def part(self, runs: slice) -> Whitener:
        """Return the filter of some of the runs."""
        return Whitener(
            self.gain_v[:, runs],
            self.gain_g[:, runs],
            self.scale[:, runs],
            self.keep[:, runs],
            self.reach[:, runs],
            self.log_det[runs],
        )

    def apply(self, columns: Array) -> Array:
        """Return whitened columns, shape (N, R, C) to the same; zero where nothing was measured."""
        out = np.empty_like(columns)
        v, g = np.zeros(columns.shape[1:]), np.zeros(columns.shape[1:])
        gain_v, gain_g, scale = self.gain_v[..., None], self.gain_g[..., None], self.scale[..., None]
        keep, reach = self.keep[..., None], self.reach[..., None]
        for i in range(columns.shape[0]):
            if i:
                v = v + reach[i] * g
                g = keep[i] * g
            innovation = columns[i] - v
            out[i] = innovation * scale[i]
            v = v + gain_v[i] * innovation
            g = g + gain_g[i] * innovation
        return out


def share_of_mean(count: Array) -> Array:
    """Return the variance of means of so many neighbouring speeds in that of one, shapes alike."""
    return np.asarray(_SHARED + (1.0 - _SHARED) / np.maximum(count, 1.0))


def _gains(grid: Grid, noise: Noise) -> tuple[Array, ...]:
    """Return gains of speed error and gust, 1/sqrt(S), decay and reach of the gust, ln S; all of shape (N, R)."""
    dt, inertia, R = grid.dt, grid.inertia, noise.speed**2 * grid.share
    tau, variance = noise.gust_time, noise.gust**2
    e = np.exp(-dt / tau)
    reach = tau * (1.0 - e) / inertia
    # Exact discretisation of the gust and its integral, and the impulse that a late change of the force leaves.
    q_gg = variance * (1.0 - e * e)
    q_vg = variance * tau * (1.0 - e) ** 2 / inertia
    q_vv = variance * (tau / inertia) ** 2 * np.maximum(2.0 * dt / tau - 3.0 + 4.0 * e - e * e, 0.0)
    q_vv += np.square(noise.jitter * grid.change)
    N, runs = dt.shape
    gain_v, gain_g, scale, log_s = np.empty((4, N, runs))
    p_vv, p_vg, p_gg = np.full(runs, _DIFFUSE), np.zeros(runs), np.full(runs, variance)
    for i in range(N):
        if i:
            p_vv = p_vv + reach[i] * (2.0 * p_vg + reach[i] * p_gg) + q_vv[i]
            p_vg = e[i] * (p_vg + reach[i] * p_gg) + q_vg[i]
            p_gg = e[i] * e[i] * p_gg + q_gg[i]
        S = p_vv + R[i]
        inverse = 1.0 / S  # 0 where nothing was measured
        gain_v[i], gain_g[i], scale[i] = p_vv * inverse, p_vg * inverse, inverse
        log_s[i] = S
        p_gg = p_gg - gain_g[i] * p_vg
        p_vg = p_vg - gain_v[i] * p_vg
        p_vv = p_vv - gain_v[i] * p_vv
    return gain_v, gain_g, np.sqrt(scale), e, reach, np.log(np.where(np.isfinite(log_s), log_s, 1.0))
