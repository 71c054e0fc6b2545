# SPDX-License-Identifier: Apache-2.0
"""Particles of a brake rate f and of the train's motion x, in strata of a Markov chain: their motion and their moments.

Between two prunings all particles move by the same linear map, x = A [1, f, x0] with the states x0 of the last pruning.
So a step without pruning changes A, and of the particles only their speeds, whose spread is needed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.posterior import ERRORS, STATES
from trainid_ros.vectors import i64, vec

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Start, Transition

WIDTH: Final = 13
"""Number of columns of A, those of 1, f and x0."""
# Rows of x.
_V: Final = 0
_A: Final = 1
_E: Final = 3


def zeros(count: int) -> vec[float]:
    """Return an array of zeros, shape (count,)."""
    return vec[float]([0.0] * count)


class GroupCloud:
    """Particles with rates f and states x = [v, a, b, e]; the weights within a stratum are equal.

    Matrices are stored row by row. Particles of one stratum follow one another, in the order of f.

    Attributes:
        N: Number of particles.
        M: Number of strata.
        edges: Index of the first particle of each stratum, and N; shape (M + 1,).
        f: Brake rate of each particle [1], shape (N,).
        x: States x0 of the particles at the last pruning, shape (n, N).
        A: What has moved them since, shape (n, 2 + n).
        x_mean: Mean of x0 over all particles, shape (n,).
        weight: Weight of each stratum, shape (M,), with the sum one.
        mean: Mean of f in each stratum [1], shape (M,).
        variance: Variance of f in each stratum [1], shape (M,).
        slope: Regression of x0 on f in each stratum, shape (n, M).
        rate: Mean of f [1], eq. (19).
        rate_variance: Variance of f [1].
        v: Predicted speeds [m/s], shape (N,).

    """

    def __init__(self, sizes: list[int]) -> None:
        N, M, n = sum(sizes), len(sizes), STATES
        self.N: i64 = N
        self.M: i64 = M
        self.edges = vec[i64]([sum(sizes[:m]) for m in range(M + 1)])
        self.f, self.x, self.A, self.x_mean = zeros(N), zeros(n * N), zeros(n * WIDTH), zeros(n)
        self.weight, self.mean, self.variance, self.slope = zeros(M), zeros(M), zeros(M), zeros(n * M)
        self.rate = self.rate_variance = 0.0
        self.v = zeros(N)
        # The next states, and one row of them.
        self._next, self._row = zeros(n * N), zeros(N)
        self.stand_still()

    def start(self, f: list[float], weight: list[float]) -> None:
        """Start at rest from rates f [1], shape (N,), with the weights of the strata, shape (M,)."""
        for i in range(self.N):
            self.f[i] = f[int(i)]
        for k in range(STATES * self.N):
            self.x[k] = 0.0
        for j in range(STATES):
            self.x_mean[j] = 0.0
        for m in range(self.M):
            total = square = 0.0
            size = float(self.edges[m + 1] - self.edges[m])
            for i in range(self.edges[m], self.edges[m + 1]):
                total += self.f[i] / size
            for i in range(self.edges[m], self.edges[m + 1]):
                off = self.f[i] - total
                square += off * off / size
            self.weight[m], self.mean[m], self.variance[m] = weight[int(m)], total, square
            for j in range(STATES):
                self.slope[j * self.M + m] = 0.0
        self.stand_still()
        self.average()

    def stand_still(self) -> None:
        """Set A to the identity, x = x0."""
        for k in range(STATES * WIDTH):
            self.A[k] = 0.0
        for j in range(STATES):
            self.A[j * WIDTH + 2 + j] = 1.0

    def average(self) -> None:
        """Set mean and variance of f from those of the strata."""
        rate = spread = 0.0
        for m in range(self.M):
            rate += self.weight[m] * self.mean[m]
        for m in range(self.M):
            off = self.mean[m] - rate
            spread += self.weight[m] * (self.variance[m] + off * off)
        self.rate, self.rate_variance = rate, spread

    # Motion of all particles alike.

    def anchor(self, start: Start) -> None:
        """Restart v, a = f target and b; the errors decay by ``decay_e``."""
        A = self.A
        for k in range(_E * WIDTH):
            A[k] = 0.0
        A[_V * WIDTH], A[_A * WIDTH + 1] = start.speed, start.target
        for j in range(ERRORS):
            decay_e = start.decay_e[j]
            for k in range(WIDTH):
                A[(_E + j) * WIDTH + k] *= decay_e

    def recentre(self, shift: vec[float]) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old, shape (8,)."""
        for j in range(ERRORS):
            self.A[(_E + j) * WIDTH] -= shift[j]

    def predict(self, step: Transition) -> None:
        """Predict over an interval with constant f, eq. (14)."""
        A, a, b = self.A, WIDTH, 2 * WIDTH
        gain_e, decay_e = step.gain_e, step.decay_e
        for k in range(WIDTH):
            v = A[k] + step.reach * A[a + k] + step.dt * A[b + k]
            for j in range(ERRORS):
                v += gain_e[j] * A[(_E + j) * WIDTH + k]
                A[(_E + j) * WIDTH + k] *= decay_e[j]
            A[k], A[a + k], A[b + k] = v, step.decay * A[a + k], step.rho * A[b + k]
        A[0] += step.known
        A[1] += step.gain_v
        A[a + 1] += step.gain_a
        self._each(A, 0, self.v, 0)

    def follow(self, speed: float, K: vec[float]) -> None:
        """Update x with a measured speed that carries no information on f, by the gain K, shape (n,), eq. (21)."""
        A = self.A
        for k in range(WIDTH):
            nu = (speed if k == 0 else 0.0) - A[k]
            for j in range(STATES):
                A[j * WIDTH + k] += K[j] * nu

    def _each(self, row: vec[float], at: i64, out: vec[float], to: i64) -> None:
        """Write row [1, f, x0] of each particle; the row begins at ``at``, the output, shape (N,), at ``to``."""
        f, x, N = self.f, self.x, self.N
        known, gain = row[at], row[at + 1]
        for i in range(N):
            out[to + i] = known + gain * f[i]
        for j in range(STATES):
            share = row[at + 2 + j]
            if share != 0.0:
                for i in range(N):
                    out[to + i] += share * x[j * N + i]

    def separate(self) -> None:
        """Let each state except v depend on its own x0 only: settle if A mixes them, as a measured speed does."""
        for j in range(1, STATES):
            for k in range(STATES):
                if k != j and self.A[j * WIDTH + 2 + k] != 0.0:
                    self._settle()
                    return

    def _settle(self) -> None:
        """Move the particles by A, which then is the identity."""
        M = self.M
        means, slopes = zeros(STATES), zeros(int(STATES * M))
        for j in range(STATES):
            self._each(self.A, j * WIDTH, self._next, j * self.N)
            means[j] = self.expected(j)
            for m in range(M):
                slopes[j * M + m] = self.slope_of(j, m)
        self.x, self._next, self.x_mean, self.slope = self._next, self.x, means, slopes
        self.stand_still()

    def slope_of(self, j: i64, m: i64) -> float:
        """Return the regression of the j-th state on f in a stratum."""
        slope = self.A[j * WIDTH + 1]
        for k in range(STATES):
            slope += self.A[j * WIDTH + 2 + k] * self.slope[k * self.M + m]
        return slope

    # Moments of the states.

    def expected(self, j: i64) -> float:
        """Return the mean of the j-th state."""
        return self._expected(self.A, j * WIDTH)

    def _expected(self, row: vec[float], at: i64) -> float:
        mean = row[at] + row[at + 1] * self.rate
        for k in range(STATES):
            mean += row[at + 2 + k] * self.x_mean[k]
        return mean

    def speed_spread(self) -> float:
        """Return the variance of the predicted speeds [(m/s)^2]."""
        return self._spread(self.v, self.expected(_V))

    def spread(self, j: i64) -> float:
        """Return the variance of the j-th state over the particles."""
        self._each(self.A, j * WIDTH, self._row, 0)
        return self._spread(self._row, self.expected(j))

    def total(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance over the particles of f + share e [1]; share of shape (8,)."""
        row = zeros(WIDTH)
        row[1] = 1.0
        for j in range(ERRORS):
            if share[j] != 0.0:
                for k in range(WIDTH):
                    row[k] += share[j] * self.A[(_E + j) * WIDTH + k]
        mean = self._expected(row, 0)
        self._each(row, 0, self._row, 0)
        return mean, self._spread(self._row, mean)

    def _spread(self, values: vec[float], mean: float) -> float:
        """Return the variance of values of the particles, shape (N,)."""
        spread = 0.0
        for m in range(self.M):
            low, high = self.edges[m], self.edges[m + 1]
            squares = 0.0
            for i in range(low, high):
                off = values[i] - mean
                squares += off * off
            spread += self.weight[m] / float(high - low) * squares
        return spread

    # Drift.

    def widen(self, step: Transition, variance: float) -> None:
        """Add to the variance of f [1] the drift before the predicted step, by spreading the values."""
        total, rate, N, M = self.rate_variance, self.rate, self.N, self.M
        if total <= 0.0:
            return
        self._settle()
        ratio = math.sqrt(1.0 + variance / total)
        for i in range(N):
            wider = (ratio - 1.0) * (self.f[i] - rate)
            self.f[i] += wider
            self.x[_V * N + i] += step.gain_v * wider
            self.x[_A * N + i] += step.gain_a * wider
            self.v[i] = self.x[_V * N + i]
        for m in range(M):
            self.mean[m] = rate + ratio * (self.mean[m] - rate)
            self.variance[m] *= ratio * ratio
            self.slope[_V * M + m] += (ratio - 1.0) * step.gain_v
            self.slope[_A * M + m] += (ratio - 1.0) * step.gain_a
            for j in range(STATES):
                self.slope[j * M + m] /= ratio
