# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS: the speed model by recursive least squares with auxiliary model and variable forgetting.

After Yuan et al. 2017. (n) is an equation of the paper; [n] marks the same step in the code. State: z = [x_a, theta]
with the auxiliary output x_a [m/s] and theta = [a1, a2, b1, d0], their covariance P, and the running mean m of the
errors. A sample has the measured speed y of variance R, the specific force u, and s sample periods since the last one.

    [1]  theta = theta(0), P = P(0) from the train file; x_a = y
    for each sample of a train that moves without braking:
    [2]      phi = s [x_a^2, x_a, u, 1]                                                   (4), with x_a for y
    [3]      f = 1 + s (2 a1 x_a + a2 - 1)                                                derivative of (2) by x_a
    [4]      P = F P F' + Q,  F = [[f, phi'], [0, I]]: the true gradient of x_a by theta
    [5]      x_a = x_a + phi' (theta - [0, 1, 0, 0])                                      (2), (7)
    [6]      eps = y - x_a                                                                (7)
    [7]      S = P_xx + R; if |eps| > max(gate sqrt(S), floor): next sample
    [8]      m = m + share (eps / sqrt(S) - m), with the error limited to three standard deviations
    [9]      chi2 = m^2 (2 - share) / share
    [10]     lambda = 1 if chi2 <= threshold, else max(1 - (chi2 - threshold) / sigma, low)   (6)
    [11]     if lambda < 1, for r = [a1, a2, d0] given b1:
                 P_r^-1 = lambda P_r^-1 + (1 - lambda) P_r(0)^-1                          (7): P / lambda
    [12]     K = P e / (P_xx + R),  e = [1, 0, 0, 0, 0]                                   (7)
    [13]     z = z + K eps                                                                (7)
    [14]     P = P - K e' P                                                               (7)
    [15] at each stop: P_b1b1 = P_b1b1 + variance of a change of load
    [16] after standstill, braking or outliers in a row: x_a = y, uncorrelated with theta

The same in plain numpy is ``test/speed_model/reference_am_vff_rls.py``. The differences from (7) as printed:

* (7) uses eps with theta(n), which is not known yet; [6] uses theta(n-1).
* (7) uses phi(n) as the gradient of x_a(n) by theta, which neglects that x_a(n-1) depends on theta too. The true
  gradient obeys psi(n) = phi(n) + f psi(n-1), f = 2 a1 x + a2 = 1 - 1e-4; propagating the joint covariance of x_a and
  theta propagates it, and a measurement corrects both. Without it the loop of x_a error and d0 error is almost
  undamped, so (7) must forget fast or it drifts.
* lambda is computed by (6) from the running mean of the errors instead of each error. Under white noise (6) forgets all
  the time (lambda = 1 - 1/sigma on average) and does not detect a change that moves the speed by half a standard
  deviation. The errors of a correct model are uncorrelated; after a change they have the same sign.
* Only the resistance is forgotten, not the mass, and forgetting ends at the prior in every direction.
* P has the units of the parameters and is a consistent covariance: speed noise, gusts, map errors and the delay of the
  reported force are estimated, see :mod:`speed_model_estimator`; slow changes of the weather are a drift of d0.
* Gradient and other known resistance act on the speed separately from u, so d0 is the Davis a without the gradient.
* A step may have any duration, outliers are gated, theta is frozen at standstill and while the brake acts.

With lambda = 1 and a drift of d0 this is the extended Kalman filter.

Theta follows from forward Euler of (1), x(n) = a1 x(n-1)^2 + a2 x(n-1) + b1 u(n-1) + d0 (2):

    a1 = -T k c,   a2 = 1 - T k b,   b1 = T k,   d0 = -T k a

with the Davis resistance a + b v + c v^2 [N/kN] and the acceleration coefficient k [m/s^2 per N/kN]. Resistance and
gradient are forces per actual weight, so their k is k0 = g0 / (1000 (1 + gamma)), which depends on the rotating masses
only. The reported traction is per weighed or assumed weight and has a gain error: b1 = T k0 kappa with the force scale
kappa = (1 + gamma) / mass_factor, the same as in the resistance estimators.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol, TypeAlias

from trainid_ros.estimators.settings import SpeedModelConfig, prior_variances
from trainid_ros.interface.state import State, declare, definite
from trainid_ros.interface.vectors import i64, vec
from trainid_ros.stream.samples import SAMPLE_PERIOD

Theta: TypeAlias = tuple[float, float, float, float]
"""a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""
Symmetric: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""Upper triangle of a symmetric 4x4 matrix, row by row."""


def to_speed_model(davis: tuple[float, float, float], k: float) -> Theta:
    """Map Davis a [N/kN], b [N/kN per m/s], c [N/kN per (m/s)^2] and k [m/s^2 per N/kN] to (a1, a2, b1, d0)."""
    a, b, c = davis
    scale = SAMPLE_PERIOD * k
    # Eq. (2).
    return -scale * c, 1.0 - scale * b, scale, -scale * a


def to_physical(theta: Theta, k: float) -> tuple[float, float, float, float]:
    """Map (a1, a2, b1 > 0, d0) to Davis (a, b, c) and the force scale [1]; k = k0 [m/s^2 per N/kN]."""
    a1, a2, b1, d0 = theta
    scale = SAMPLE_PERIOD * k
    return -d0 / scale, (1.0 - a2) / scale, -a1 / scale, b1 / scale


def prior(
    davis: tuple[float, float, float], k: float, config: SpeedModelConfig, mass_std: float
) -> tuple[Theta, Symmetric]:
    """Return theta(0) and its covariance; ``mass_std`` is the relative std of mass and force together [1].

    The Davis parameters are in N/kN with v in m/s; k = k0 [m/s^2 per N/kN].
    """
    a, b, c = prior_variances(davis, config)
    scale = (SAMPLE_PERIOD * k) ** 2
    # Forgetting divides by the variance of b1, so it is not zero.
    of_b1 = scale * max(mass_std, 1e-4) ** 2
    return to_speed_model(davis, k), (scale * c, 0.0, 0.0, 0.0, scale * b, 0.0, 0.0, of_b1, 0.0, scale * a)


def full(S: Symmetric) -> tuple[float, ...]:
    """Return all 16 elements, row by row."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = S
    return s11, s12, s13, s14, s12, s22, s23, s24, s13, s23, s33, s34, s14, s24, s34, s44


def resistance_variance(S: Symmetric, v: float, k: float) -> float:
    """Return the variance of w(v) [(N/kN)^2] at v [m/s] from the covariance S of theta; k = k0 [m/s^2 per N/kN]."""
    s11, s12, _, s14, s22, _, s24, _, _, s44 = S
    # w = -(a1 v^2 + (a2 - 1) v + d0) / (T k)
    square = v * v
    total = square * (s11 * square + 2.0 * (s12 * v + s14)) + v * (s22 * v + 2.0 * s24) + s44
    return total / (SAMPLE_PERIOD * k) ** 2


class Learned:
    """Result of one measurement update.

    Attributes:
        predicted: Predicted speed [m/s].
        error: Measured less predicted speed [m/s].
        limit: Errors beyond this are rejected [m/s]; the state is then only predicted.
        forgetting: Forgetting factor [1].
        variance: Variance of the error as computed by the algorithm [(m/s)^2]; 0 if it computes none.
        rejected: Whether the measurement was rejected.
    """

    def __init__(self, predicted: float, error: float, limit: float, forgetting: float, variance: float = 0.0) -> None:
        self.predicted, self.error, self.limit = predicted, error, limit
        self.forgetting, self.variance, self.rejected = forgetting, variance, abs(error) > limit


class Method(Protocol):
    """An algorithm on (y, u), independent of samples."""

    def start(self, variance: float) -> None:
        """Go to the state before the first measurement; ``variance`` is that of measured speed [(m/s)^2]."""

    def is_usable(self) -> bool:
        """Return whether all numbers are finite, b1 > 0 and the variances of theta > 0."""

    def speed(self) -> float:
        """Return x [m/s]."""

    def theta(self) -> Theta:
        """Return a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""

    def covariance(self, variance: float) -> Symmetric:
        """Return the covariance of theta; ``variance`` is that of measured speed [(m/s)^2]."""

    def update(self, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with y [m/s] of a variance [(m/s)^2] after the force u [N/kN] over ``scale`` sample periods [1]."""

    def coast(self, u: float, scale: float) -> None:
        """Predict over ``scale`` sample periods with the force u [N/kN], without a measurement."""

    def reinit_speed(self, y: float, variance: float) -> None:
        """Restart x from a measured speed y [m/s] with a variance [(m/s)^2]; theta is unchanged."""

    def shift(self, change: float) -> None:
        """Add to x the change of speed by gradient and other known resistance over a step [m/s]."""

    def inflate_load_variance(self, share: float) -> None:
        """Add a ``share`` [1] of the load variance to b1, for a change of load at a stop."""


# Places of x_a and of the parameters in the joint state, and their number.
_X: Final = 0
_A1: Final = 1
_A2: Final = 2
_B1: Final = 3
_D0: Final = 4
_SIZE: Final = 5
_RESISTANCE: Final = (_A1, _A2, _D0)
# Limit of one error in the running mean, in standard deviations.
_MAX_ERROR: Final = 3.0


@dataclass(frozen=True)
class Tuning:
    """Parameters of the kernel."""

    noise: float  # Variance that x gains in a sample period in addition to what the estimator adds [(m/s)^2]
    drift: float  # Variance that d0 gains in a sample period [(m/s)^2]
    load: float  # Variance that b1 gains at a stop without weighing [(m/s per N/kN)^2]
    share: float  # Weight of one error in the running mean [1]
    threshold: float  # Chi-square of the mean error above which lambda falls below 1 [1]
    scale: float  # sigma of (6): chi-square above the threshold for lambda = 0 [1]
    low: float  # Smallest forgetting factor [1]
    gate: float  # Errors beyond this many standard deviations are rejected [1]
    gate_floor: float  # Errors below this are never rejected [m/s]


class AuxiliaryModel:
    """Joint mean and covariance of the auxiliary output x_a and theta.

    Attributes:
        z: x_a, a1, a2, b1, d0, shape (5,).
        P: Their covariance, shape (5, 5), row by row.
        mean_error: Running mean of the errors, in standard deviations [1].
    """

    STATE: ClassVar[State] = declare('z', definite('P'), 'mean_error')

    def __init__(self, theta0: Theta, P0: Symmetric, tuning: Tuning) -> None:
        self.tuning, self._theta0, self._P0, self._prior = tuning, theta0, P0, prior_variances_given_b1(P0)
        self.z = vec[float]([0.0] * _SIZE)
        self.P = vec[float]([0.0] * (_SIZE * _SIZE))
        self._gradient = vec[float]([0.0] * _SIZE)  # derivatives of x_a(n) with respect to x_a(n-1) and theta
        # P and a vector while it is multiplied by the inverse.
        self._remainder, self._rest = vec[float]([0.0] * (_SIZE * _SIZE)), vec[float]([0.0] * _SIZE)
        self.mean_error = 0.0

    def start(self, variance: float) -> None:
        """Go to the prior; ``variance`` is that of x [(m/s)^2]."""
        n: i64 = _SIZE
        z: tuple[float, ...] = (0.0, *self._theta0)
        columns = full(self._P0)
        # [1]
        for i in range(n):
            self.z[i] = z[i]
            self.P[i] = self.P[n * i] = 0.0
            for j in range(1, n):
                if i > 0:
                    self.P[n * i + j] = columns[4 * (i - 1) + j - 1]
        self.P[0] = variance
        self.mean_error = 0.0

    def speed(self) -> float:
        """Return x [m/s]."""
        return self.z[_X]

    def theta(self) -> Theta:
        """Return theta."""
        z = self.z
        return z[_A1], z[_A2], z[_B1], z[_D0]

    def covariance(self, variance: float) -> Symmetric:  # noqa: ARG002 - P has the units of theta already
        """Return the covariance of theta."""
        P = self.P
        return P[6], P[7], P[8], P[9], P[12], P[13], P[14], P[18], P[19], P[24]

    def _mirror(self) -> None:
        """Set the covariances of theta with x to those of x with theta."""
        n: i64 = _SIZE
        P = self.P
        for i in range(1, n):
            P[n * i] = P[i]

    def is_usable(self) -> bool:
        """Return whether all numbers are finite, b1 > 0 and the variances of theta > 0."""
        n: i64 = _SIZE
        z, P = self.z, self.P
        total = self.mean_error
        for i in range(n):
            total += z[i]
            for j in range(i, n):
                total += P[n * i + j]
        if math.isnan(total) or math.isinf(total):
            return False
        return z[_B1] > 0.0 and P[6] > 0.0 and P[12] > 0.0 and P[18] > 0.0 and P[24] > 0.0

    def squared_norm(self, x: float, a1: float, a2: float, b1: float, d0: float) -> float:
        """Return c' P^-1 c for the covariances c of x, a1, a2, b1, d0 with another quantity: what they say of it."""
        n: i64 = _SIZE
        left, rest, total = self._remainder, self._rest, 0.0
        rest[_X], rest[_A1], rest[_A2], rest[_B1], rest[_D0] = x, a1, a2, b1, d0
        for k in range(n * n):
            left[k] = self.P[k]
        # Gaussian elimination: left loses the part of P that the elements before determine.
        for k in range(n):
            r = 1.0 / max(left[n * k + k], 1e-300)
            total += rest[k] * rest[k] * r
            for i in range(k + 1, n):
                share = left[n * k + i] * r
                rest[i] -= share * rest[k]
                for j in range(i, n):
                    left[n * i + j] -= share * left[n * k + j]
        return total

    def update(self, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update by one step of (7) in its computable order; the arguments are those of :class:`Method`."""
        tuning = self.tuning
        # [2]-[5] Eq. (7): x_a = phi' theta(n-1), with its covariance.
        self.coast(u, scale)
        predicted = self.z[_X]
        # [6] Eq. (7), with theta(n-1).
        eps = y - predicted
        # [7]
        s = self.P[0] + variance
        std = math.sqrt(s)
        limit = max(tuning.gate * std, tuning.gate_floor)
        if not -limit <= eps <= limit:
            return Learned(predicted, eps, limit, 1.0, s)
        # [8]
        mean, lam = running_mean(self.mean_error, eps / std, tuning.share), 1.0
        # [9] The variance of ``mean`` is share / (2 - share) if the errors are white.
        chi2 = mean * mean * (2.0 - tuning.share) / tuning.share
        if chi2 > tuning.threshold:
            # [10] Eq. (6) with chi2 - threshold instead of the squared error, [11]
            lam = max(1.0 - (chi2 - tuning.threshold) / tuning.scale, tuning.low)
            self.forget(lam)
        self.mean_error = mean
        # [12]-[14] Eq. (7): theta(n) = theta(n-1) + K eps, x_a(n) = phi' theta(n) and P(n).
        self.correct(eps, variance)
        return Learned(predicted, eps, limit, lam, s)

    def coast(self, u: float, scale: float) -> None:
        """Propagate over ``scale`` sample periods, x(n) = phi(n)' theta, and the covariance with its gradient."""
        n: i64 = _SIZE
        z, P, g = self.z, self.P, self._gradient
        x = z[_X]
        # [2] phi, eq. (4), and [3] before it f.
        g[_A2], g[_B1], g[_D0] = scale * x, scale * u, scale
        g[_A1] = g[_A2] * x
        g[_X] = 1.0 + scale * (2.0 * z[_A1] * x + z[_A2] - 1.0)
        P[24] += self.tuning.drift * scale
        # [4] var(x): f^2 var(x) + 2 f phi'p + phi'S phi, with p = cov(x, theta) and S = cov(theta)
        before = g[_X] * P[0]
        for j in range(1, n):
            before += P[j] * g[j]
        # cov(x, theta): f p + S phi
        after = 0.0
        for j in range(1, n):
            q = g[_X] * P[j]
            for i in range(1, n):
                q += P[n * i + j] * g[i]
            P[j] = q
            after += q * g[j]
        self._mirror()
        P[0] = g[_X] * before + after + self.tuning.noise * scale
        # [5] Eq. (2) for a step of ``scale`` sample periods.
        z[_X] = x + z[_A1] * g[_A1] + (z[_A2] - 1.0) * g[_A2] + z[_B1] * g[_B1] + z[_D0] * scale

    def correct(self, error: float, variance: float) -> None:
        """Update with a measurement of x: innovation ``error`` [m/s], noise variance [(m/s)^2]."""
        n: i64 = _SIZE
        z, P = self.z, self.P
        r = 1.0 / (P[0] + variance)
        for i in range(n):
            # [12]-[14] K = P e / (e'P e + variance), z += K eps, P -= K e'P, e = (1, 0, 0, 0, 0)
            K = P[i] * r
            z[i] += K * error
            for j in range(i, n):
                if i > 0:
                    P[n * i + j] -= K * P[j]
                    P[n * j + i] = P[n * i + j]
        for i in range(n):
            P[i] *= variance * r
        self._mirror()

    def reinit_speed(self, y: float, variance: float) -> None:
        """Restart x from a measured speed y [m/s] with a variance [(m/s)^2], uncorrelated with theta."""
        n: i64 = _SIZE
        # [16]
        self.z[_X] = y
        self.P[0] = variance
        for i in range(1, n):
            self.P[i] = 0.0
        self._mirror()

    def shift(self, change: float) -> None:
        """Add a change of speed [m/s] to x."""
        self.z[_X] += change

    def inflate_speed_variance(self, variance: float) -> None:
        """Add to the variance of x [(m/s)^2], for forces that are not reported."""
        self.P[0] += variance

    def add_input(self, mean: float, variance: float, covariance: Theta) -> None:
        """Add to x a correlated input: its mean [m/s], what it adds to var(x) and to the covariances of x and theta."""
        P = self.P
        self.z[_X] += mean
        P[0] += variance
        P[1] += covariance[0]
        P[2] += covariance[1]
        P[3] += covariance[2]
        P[4] += covariance[3]
        self._mirror()

    def inflate_load_variance(self, share: float) -> None:
        """Add a share of the load variance to the variance of b1."""
        # [15]
        self.P[18] += share * self.tuning.load

    def idle(self, scale: float) -> None:
        """Let d0 drift over ``scale`` sample periods without measurements, up to its prior variance."""
        self.P[24] = max(self.P[24], min(self.P[24] + self.tuning.drift * scale, self._P0[9]))

    def forget(self, factor: float) -> None:
        """Reduce the information on the resistance by ``factor``, never below that of the prior.

        The mass changes at stops only, so b1 is kept: with c the column of b1, P - c c' / var(b1) is the covariance
        given b1. There the covariance of a1, a2, d0 is divided by lambda = ``factor``, then the prior is applied as
        three observations of weight 1 - lambda with zero innovation. A direction without excitation returns to its
        prior variance, so the covariance does not wind up.
        """
        n: i64 = _SIZE
        # [11]
        b1 = [self.P[n * i + _B1] for i in range(n)]
        r, wider, weight = 1.0 / b1[_B1], 1.0 / factor, 1.0 - factor
        given = [[self.P[n * i + j] - b1[i] * b1[j] * r for j in range(n)] for i in range(n)]
        for i in _RESISTANCE:
            for j in _RESISTANCE:
                given[i][j] *= wider
        for i, prior in zip(_RESISTANCE, self._prior, strict=True):
            column = list(given[i])
            k = weight / (prior + weight * column[i])
            order = (*_RESISTANCE, _X)
            for place, j in enumerate(order):
                for m in order[place:]:
                    given[j][m] = given[m][j] = given[j][m] - k * column[j] * column[m]
        for i in (_X, *_RESISTANCE):
            for j in (_X, *_RESISTANCE):
                self.P[n * i + j] = given[i][j] + b1[i] * b1[j] * r
        self.mean_error = 0.0


def prior_variances_given_b1(P0: Symmetric) -> tuple[float, float, float]:
    """Return the prior variances of a1, a2, d0 given b1, where forgetting ends; given b1 the prior is diagonal."""
    s11, _, s13, _, s22, s23, _, s33, s34, s44 = P0
    return s11 - s13 * s13 / s33, s22 - s23 * s23 / s33, s44 - s34 * s34 / s33


def running_mean(mean: float, z: float, share: float) -> float:
    """Return the running mean of errors in standard deviations [1] after one more error z of weight ``share``."""
    bounded = z if -_MAX_ERROR < z < _MAX_ERROR else math.copysign(_MAX_ERROR, z)
    return mean + share * (bounded - mean)
