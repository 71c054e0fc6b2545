# SPDX-License-Identifier: Apache-2.0
"""Normal distributions of n parameters theta, their update by y = phi' theta + noise, and the long-run variance.

There are two forms: mean and covariance P; and the information [P^-1 | P^-1 theta], shape (n, n + 1), in which
independent observations add.

An observation is good with probability 1 - eps; otherwise it is uniformly distributed over a width of
``OUTLIER_WIDTH`` standard deviations. Its weight is the posterior probability that it is good. A hard gate cannot
recover from a wrong estimate; this one scores how well an estimate predicts, outliers included.

The noise of neighbouring observations is correlated (gusts, map errors, overlapping windows). Sums of innovations over
batches longer than the correlation time include that: if the predicted variances are correct, the expected squared
sum over a batch equals the sum of the variances. Any excess is unmodelled error: :class:`Inflation` is the factor on
the published covariance, :class:`SlowNoise` the one on the noise variance in the mean of many observations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.state import State, declare, definite
from trainid_ros.interface.vectors import append, i64, vec

if TYPE_CHECKING:
    from collections.abc import Sequence

Array = NDArray[np.float64]

OUTLIER_WIDTH: Final = 40.0  # range of outliers [standard deviations]
_ROOT_2PI: Final = math.sqrt(2.0 * math.pi)
# Beyond 37 standard deviations the density of a good observation underflows.
_MAX_NIS: Final = 1400.0
_MIN_WEIGHT: Final = 1e-9


def weigh(nu: float, S: float, R: float, eps: float) -> tuple[float, float]:
    """Return the weight of an observation and the logarithm of its likelihood.

    Args:
        nu: Innovation [N/kN].
        S: Its variance if the observation is good [(N/kN)^2].
        R: Variance of the observation noise, which sets the width of the outlier density [(N/kN)^2].
        eps: Share of outliers [1].
    """
    nis = nu * nu / S
    good = (1.0 - eps) / (_ROOT_2PI * math.sqrt(S)) * math.exp(-0.5 * nis) if nis < _MAX_NIS else 0.0
    likelihood = good + eps / (OUTLIER_WIDTH * math.sqrt(R)) + 1e-300
    return good / likelihood, math.log(likelihood)


def gate(eps: float) -> float:
    """Return the innovation, in standard deviations, at which an observation is good with probability 1/2."""
    return math.sqrt(2.0 * math.log((1.0 - eps) * OUTLIER_WIDTH / (eps * _ROOT_2PI))) if eps > 0.0 else math.inf


class Normal:
    """Normal distribution of n parameters.

    Attributes:
        mean: theta, n numbers.
        covariance: P, n^2 numbers, row by row.
    """

    STATE: ClassVar[State] = declare('mean', definite('covariance'))

    def __init__(self, mean: vec[float], covariance: vec[float]) -> None:
        self.mean, self.covariance = mean, covariance

    @property
    def theta(self) -> Array:
        """The mean as an array, shape (n,)."""
        return np.array(list(self.mean))

    @property
    def P(self) -> Array:
        """The covariance as an array, shape (n, n)."""
        return np.array(list(self.covariance)).reshape(len(self.mean), len(self.mean))

    def predict(self, phi: vec[float]) -> tuple[float, float]:
        """Return mean and variance of phi' theta, in the unit of y and its square, for n regressors."""
        return dot(phi, self.mean), max(dot(phi, _times(self.covariance, phi)), 0.0)


def normal(theta: Array, P: Array) -> Normal:
    """Return the distribution with a mean of shape (n,) and a covariance of shape (n, n)."""
    return Normal(vec[float](theta.tolist()), vec[float](P.ravel().tolist()))


def independent(theta: Sequence[float], variances: Sequence[float]) -> Normal:
    """Return the distribution of independent parameters with these means and variances."""
    return normal(np.array(theta, dtype=np.float64), np.diag(np.array(variances, dtype=np.float64)))


def dot(x: vec[float], y: vec[float]) -> float:
    """Return x' y."""
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


def _times(P: vec[float], x: vec[float]) -> vec[float]:
    """Return P x."""
    n, product = len(x), vec[float]()
    k: i64 = 0
    for _ in range(n):
        total = 0.0
        for j in range(n):
            total += P[k] * x[j]
            k += 1
        product = append(product, total)
    return product


def inflated(item: Normal, variances: Array, limits: Array | None = None) -> Normal:
    """Return the distribution after independent random steps of the parameters.

    Args:
        item: Distribution before the steps.
        variances: Variances of the steps, shape (n,).
        limits: Upper limits of the variances afterwards, shape (n,); limiting keeps the correlations.
    """
    P = item.P + np.diag(variances)
    if limits is not None:
        r = np.minimum(1.0, np.sqrt(limits / np.diag(P)))
        P = r[:, None] * P * r
    return normal(item.theta, P)


def soft_update(
    item: Normal, phi: vec[float], y: float, R: float, slow: float, eps: float
) -> tuple[Normal, float, float]:
    """Return the distribution after one observation, the weight of the observation and its log likelihood.

    Args:
        item: Distribution before the observation.
        phi: Regressor, n numbers.
        y: Observation.
        R: Variance of its noise.
        slow: Factor on R in the mean of many observations with correlated noise; 1 if the noise is white.
        eps: Share of outliers, 0 for plain least squares.
    """
    g = _times(item.covariance, phi)
    variance = dot(phi, g)
    nu = y - dot(phi, item.mean)
    weight, log_likelihood = weigh(nu, variance + R, R, eps)
    if weight < _MIN_WEIGHT:
        return item, weight, log_likelihood
    # [11] eqs. (9)-(11): theta += K nu, P -= g g' / (phi' P phi + slow R / weight); the weight divides the variance
    gain = 1.0 / (variance + slow * R / weight)
    theta, P = item.mean[:], item.covariance[:]
    k: i64 = 0
    for i in range(len(phi)):
        theta[i] += gain * nu * g[i]
        for j in range(len(phi)):
            P[k] -= gain * (g[i] * g[j])
            k += 1
    return Normal(theta, P), weight, log_likelihood


def mixed(items: list[Normal], weights: list[float], stated: list[float] | None = None) -> Normal:
    """Return mean and covariance of a mixture.

    Args:
        items: Its parts.
        weights: Their weights, which need not sum to one.
        stated: Other weights for the covariance, which is about the mean by the first ones.
    """
    n, total, spread = len(items[0].mean), math.fsum(weights), weights if stated is None else stated
    all_spread = math.fsum(spread)
    theta, apart, P = vec[float]([0.0] * n), vec[float]([0.0] * n), vec[float]([0.0] * (n * n))
    for item, weight in zip(items, weights, strict=True):
        for i in range(n):
            theta[i] += weight / total * item.mean[i]
    for item, weight in zip(items, spread, strict=True):
        share = weight / all_spread
        k: i64 = 0
        for i in range(n):
            apart[i] = item.mean[i] - theta[i]
        for i in range(n):
            for j in range(n):
                P[k] += share * (item.covariance[k] + apart[i] * apart[j])
                k += 1
    return Normal(theta, P)


def information_of(item: Normal) -> vec[float]:
    """Return [P^-1 | P^-1 theta], n rows of n + 1 numbers."""
    inverse, information = _inverse(item.covariance, len(item.mean)), vec[float]()
    k: i64 = 0
    vector = _times(inverse, item.mean)
    for i in range(len(vector)):
        for _ in range(len(vector)):
            information = append(information, inverse[k])
            k += 1
        information = append(information, vector[i])
    return information


def normal_of(information: vec[float], n: i64) -> Normal:
    """Return the distribution of n parameters with an information [P^-1 | P^-1 theta]."""
    inverse, vector = vec[float](), vec[float]()
    k: i64 = 0
    for _ in range(n):
        for _ in range(n):
            inverse = append(inverse, information[k])
            k += 1
        vector = append(vector, information[k])
        k += 1
    P = _inverse(inverse, n)
    return Normal(_times(P, vector), P)


def information_in(phi: vec[float], y: float, variance: float, weight: float = 1.0) -> vec[float]:
    """Return the information of one observation, phi [phi', y] weight / variance, n rows of n + 1 numbers."""
    information = vec[float]()
    for i in range(len(phi)):
        for j in range(len(phi)):
            information = append(information, phi[i] * phi[j] / variance * weight)
        information = append(information, phi[i] * y / variance * weight)
    return information


def _inverse(S: vec[float], n: i64) -> vec[float]:
    """Return the inverse of a covariance or information matrix of n rows, by Gauss-Jordan elimination in place.

    The matrix is scaled to a unit diagonal first, since the parameters differ by orders of magnitude; positive definite
    ones need no pivoting.
    """
    scale, A = vec[float](), S[:]
    for i in range(n):
        scale = append(scale, 1.0 / math.sqrt(S[i * n + i]))
    for i in range(n):
        for j in range(n):
            A[i * n + j] *= scale[i] * scale[j]
    for k in range(n):
        pivot = 1.0 / A[k * n + k]
        A[k * n + k] = 1.0
        for j in range(n):
            A[k * n + j] *= pivot
        for i in range(n):
            factor = A[i * n + k]
            if i != k:
                A[i * n + k] = 0.0
                for j in range(n):
                    A[i * n + j] -= factor * A[k * n + j]
    inverse = A[:]
    for i in range(n):
        for j in range(n):
            inverse[i * n + j] = 0.5 * scale[i] * (A[i * n + j] + A[j * n + i]) * scale[j]
    return inverse


# Driving time of a batch [s], several times the correlation time of gusts.
_BATCH_S: Final = 48.0
# One batch determines a variance only to a factor 1.4, so several are averaged and each ratio is limited.
_INFLATION_MEMORY: Final = 8.0
_MAX_INFLATION: Final = 9.0
# Observations in a batch of the slow noise, and how many batches are averaged, fewer at first.
_BATCH: Final = 20
_SLOW_MEMORY: Final = 25.0
_FIRST_SLOW_MEMORY: Final = 12.0
# The ratio of one batch is limited, since a parameter step is not noise. Steps still count until they are detected;
# otherwise gusts that look like steps would never be learned.
_MAX_SLOW_RATIO: Final = 6.0


@dataclass(slots=True)
class Inflation:
    """Mean ratio of squared innovation sums to predicted variances, and the current batch."""

    ratio: float = 1.0  # Mean ratio, 1 if the model is consistent
    total: float = 0.0  # Sum of the innovations of the batch, in any unit or normalised by their standard deviations
    variance: float = 0.0  # Sum of their predicted variances, in the square of that unit
    length: float = 0.0  # Driving time of the batch so far [s]

    @property
    def factor(self) -> float:
        """Factor on the covariance of the parameters [1], at least 1."""
        return max(1.0, self.ratio)

    def foreseen(self, duration_s: float) -> float:
        """Return the mean factor after a driving time [s] that the model describes [1]."""
        # The ratio of a batch is chi-square of one degree of freedom: mean 1, variance 2.
        kept = math.exp(-duration_s / (_BATCH_S * _INFLATION_MEMORY))
        excess, variance = (self.ratio - 1.0) * kept, 2.0 / (2.0 * _INFLATION_MEMORY - 1.0) * (1.0 - kept * kept)
        # E max(0, x) of a normal x
        z = excess / math.sqrt(variance)
        above = 0.5 * (1.0 + math.erf(z / math.sqrt(2.0)))
        return 1.0 + excess * above + math.sqrt(variance / (2.0 * math.pi)) * math.exp(-0.5 * z * z)

    def add(self, nu: float, variance: float, dt: float) -> None:
        """Add one innovation times its outlier weight, its variance in the mean of many, and its driving time [s]."""
        self.total += nu
        self.variance += variance
        self.length += dt
        if self.length < _BATCH_S - 0.5 * dt:
            return
        found = min(self.total * self.total / self.variance, _MAX_INFLATION)
        self.ratio += (found - self.ratio) / _INFLATION_MEMORY
        self.total = self.variance = self.length = 0.0


@dataclass(slots=True)
class SlowNoise:
    """Learned factor on the noise variance in the mean of many observations, and the current batch."""

    factor: float = 1.0  # factor on the noise variance [1]
    total: float = 0.0  # sum of the innovations of the batch [N/kN]
    variance: float = 0.0  # expected variance of that sum [(N/kN)^2]
    known: float = 0.0  # share of the noise in it [(N/kN)^2]
    count: int = 0  # innovations in the batch
    memory: float = _FIRST_SLOW_MEMORY  # batches that the factor remembers

    def add(self, nu: float, prediction: float, variance: float, bounds: tuple[float, float]) -> None:
        """Add one innovation.

        Args:
            nu: Innovation times its outlier weight [N/kN].
            prediction: Variance of its prediction due to the parameter uncertainty [(N/kN)^2].
            variance: Variance of its noise in the mean of many, including the factor [(N/kN)^2].
            bounds: Limits of the factor [1].
        """
        self.total += nu
        self.variance += prediction + variance
        self.known += variance
        self.count += 1
        if self.count < _BATCH:
            return
        ratio = min(self.total * self.total / self.variance, _MAX_SLOW_RATIO)
        # If the parameter uncertainty dominates the variance, the batch carries little information on the noise.
        gain = self.known / self.variance / self.memory
        self.memory = min(self.memory + 1.0, _SLOW_MEMORY)
        self.factor = min(max(self.factor * (1.0 + gain * (ratio - 1.0)), bounds[0]), bounds[1])
        self.total = self.variance = self.known = 0.0
        self.count = 0
