# SPDX-License-Identifier: Apache-2.0
"""RLS, VFF-RLS, AM-RLS and AM-VFF-RLS as printed in Yuan et al. 2017, for comparison.

One recursion, algorithm (7), with two switches: phi of the measured speed (RLS, (5)) or of the auxiliary output
(AM), and forgetting (VFF, (6)) or lambda = 1. The computable order is

    eps(n) = y(n) - phi' theta(n-1),  then lambda, K, theta, P, and x_a(n) = phi' theta(n),

because (7) prints eps and theta, and lambda and K, as functions of each other. As printed, lambda turns negative when
eps^2 > sigma (1 + phi' P phi), and the estimate diverges. Optional corrections: a lower limit of lambda, an auxiliary
output corrected towards the measurement with the gain ``kappa`` (0: AM as printed, 1: no auxiliary model), a gate. P
is the covariance divided by the variance of measured speed (the paper calls it the error covariance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple, TypeAlias

from trainid_ros.estimators.settings import SpeedModelConfig
from trainid_ros.interface.errors import setting
from trainid_ros.interface.state import State, declare
from trainid_ros.speed_model.am_vff_rls import Learned, Symmetric, Theta
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator
from trainid_ros.train.train_file import TrainFile

Numbers: TypeAlias = tuple[float, ...]
"""State of an algorithm as it is saved: its speed x, then theta, then what else it stores."""
Recursion: TypeAlias = tuple[
    float, float, float, float, float,
    float, float, float, float, float, float, float, float, float, float,
]  # fmt: skip
"""x, a1, a2, b1, d0 and the upper triangle of P."""

NO_CLAMP: Final = -1e9
"""A lower limit that no forgetting factor reaches."""


@dataclass(frozen=True, slots=True)
class RlsConfig(SpeedModelConfig):
    """Settings of the algorithms of the paper and of the optional corrections."""

    kappa: float = setting(0.0, 'share of the measurement in x of phi: 0 auxiliary model, 1 measured', '1', 0.0, 1.0)
    forgetting_scale: float = setting(0.0, 'sigma of (6) over the speed variance; 0: no forgetting', '1', 0.0, 1e9)
    min_forgetting: float = setting(NO_CLAMP, 'smallest forgetting factor (printed: none)', '1', NO_CLAMP, 1.0)
    gate: float = setting(
        1e9, 'errors beyond this many standard deviations are rejected (printed: none)', '1', 1.0, 1e9
    )
    prior_scale: float = setting(1e4, 'P(0) is the prior of the train file times this', '1', 1e-9, 1e12)


RLS: Final = RlsConfig(kappa=1.0)
VFF_RLS: Final = RlsConfig(kappa=1.0, forgetting_scale=250.0)
AM_RLS: Final = RlsConfig()
AM_VFF_RLS: Final = RlsConfig(forgetting_scale=75.0)


class Tuning(NamedTuple):
    """Parameters of the kernel: see the settings; ``sigma`` is that of (6) [(m/s)^2], 0 without forgetting."""

    kappa: float
    sigma: float
    low: float
    gate: float


def regressor(x: float, u: float, scale: float) -> Theta:
    """Return phi of (4) for a step of ``scale`` sample periods, such that x(n) = phi' theta + (1 - scale) x(n-1).

    Args:
        x: Speed at the start of the step [m/s].
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period [1].

    """
    return scale * x * x, scale * x, scale * u, scale


def times(S: Symmetric, h: Theta) -> tuple[float, float, float, float, float]:
    """Return S h and h' S h."""
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = S
    h1, h2, h3, h4 = h
    w1 = s11 * h1 + s12 * h2 + s13 * h3 + s14 * h4
    w2 = s12 * h1 + s22 * h2 + s23 * h3 + s24 * h4
    w3 = s13 * h1 + s23 * h2 + s33 * h3 + s34 * h4
    w4 = s14 * h1 + s24 * h2 + s34 * h3 + s44 * h4
    return w1, w2, w3, w4, h1 * w1 + h2 * w2 + h3 * w3 + h4 * w4


def updated(
    theta: Theta, P: Symmetric, w: tuple[float, float, float, float, float], eps: float, noise: float, lam: float = 1.0
) -> tuple[Theta, Symmetric]:
    """Return theta(n) and P(n) after an error ``eps`` [m/s] of noise variance ``noise``, in the units of phi' P phi.

    ``w`` is P phi and phi' P phi. With noise = lam this is (5) and (7). Also for arrays of equal shape.
    """
    a1, a2, b1, d0 = theta
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = P
    w1, w2, w3, w4, g = w
    r, wider = 1.0 / (g + noise), 1.0 / lam
    k1, k2, k3, k4 = w1 * r, w2 * r, w3 * r, w4 * r
    return (a1 + k1 * eps, a2 + k2 * eps, b1 + k3 * eps, d0 + k4 * eps), (
        (s11 - k1 * w1) * wider, (s12 - k1 * w2) * wider, (s13 - k1 * w3) * wider, (s14 - k1 * w4) * wider,
        (s22 - k2 * w2) * wider, (s23 - k2 * w3) * wider, (s24 - k2 * w4) * wider,
        (s33 - k3 * w3) * wider, (s34 - k3 * w4) * wider, (s44 - k4 * w4) * wider,
    )  # fmt: skip


def output(theta: Theta, phi: Theta) -> float:
    """Return phi' theta [m/s]."""
    return phi[0] * theta[0] + phi[1] * theta[1] + phi[2] * theta[2] + phi[3] * theta[3]


def learn(numbers: Numbers, y: float, u: float, scale: float, std: float, tuning: Tuning) -> tuple[Numbers, Learned]:
    """Return the state after one step of (7), and its result.

    Args:
        numbers: x, theta and the upper triangle of P.
        y: Measured speed [m/s].
        u: Specific force over the step [N/kN].
        scale: Duration of the step over the sample period [1].
        std: Standard deviation of y [m/s], used for the gate only.
        tuning: Parameters of the kernel.

    """
    x, theta, P = numbers[0], numbers[1:5], numbers[5:]
    phi = regressor(x, u, scale)
    base = (1.0 - scale) * x
    predicted = output(theta, phi) + base  # type: ignore[arg-type]
    eps = y - predicted
    w = times(P, phi)  # type: ignore[arg-type]
    g = w[4]
    limit = tuning.gate * std * math.sqrt(1.0 + max(g, 0.0))
    if not abs(eps) <= limit:
        return (predicted, *numbers[1:]), Learned(predicted, eps, limit, 1.0)
    lam = 1.0
    if tuning.sigma > 0.0:
        # Eq. (6).
        lam = max(tuning.low, 1.0 - eps * eps / (tuning.sigma * (1.0 + g)))
    if lam == 0.0 or g + lam == 0.0:  # as printed, P is then infinite
        return (math.nan, *numbers[1:]), Learned(predicted, eps, limit, lam)
    # Eq. (7); with lam = 1, eq. (5).
    theta, P = updated(theta, P, w, eps, lam, lam)  # type: ignore[arg-type]
    x_a = output(theta, phi) + base
    return (x_a + tuning.kappa * (y - x_a), *theta, *P), Learned(predicted, eps, limit, lam)


class MethodNumbers:
    """State of a method as it is saved: x, theta and the upper triangle of P, then what else it stores."""

    STATE: ClassVar[State] = declare('_numbers')

    _numbers: Numbers

    def is_usable(self) -> bool:
        """Return whether all numbers are finite, b1 > 0 and the variances of theta > 0."""
        x = self._numbers
        return math.isfinite(sum(x)) and min(x[3], x[5], x[9], x[12], x[14]) > 0.0

    def speed(self) -> float:
        """Return x [m/s]."""
        return self._numbers[0]

    def theta(self) -> Theta:
        """Return a1 [s/m], a2 [1], b1 [m/s per N/kN], d0 [m/s]."""
        return self._numbers[1:5]  # type: ignore[return-value]


class Rls(MethodNumbers):
    """The kernel with its state; P(0) is in units of the initial variance of measured speed."""

    def __init__(self, theta0: Theta, P0: Symmetric, config: RlsConfig) -> None:
        self._config = config
        self._prior: Recursion = (0.0, *theta0, *P0)
        self._tuning = Tuning(config.kappa, 0.0, config.min_forgetting, config.gate)
        self._numbers = self._prior

    def start(self, variance: float) -> None:
        """Go to theta(0) and P(0); ``variance`` is that of measured speed [(m/s)^2]."""
        scale = self._config.prior_scale / variance
        self._numbers = (*self._prior[:5], *(scale * p for p in self._prior[5:]))

    def covariance(self, variance: float) -> Symmetric:
        """Return the covariance of theta: P times the ``variance`` of measured speed [(m/s)^2]."""
        return tuple(variance * p for p in self._numbers[5:])  # type: ignore[return-value]

    def update(self, y: float, u: float, scale: float, variance: float) -> Learned:
        """Update with a measured speed y [m/s] after the force u [N/kN]; see :class:`Method`."""
        tuning = self._tuning._replace(sigma=self._config.forgetting_scale * variance)
        self._numbers, learned = learn(self._numbers, y, u, scale, math.sqrt(variance), tuning)
        return learned

    def coast(self, u: float, scale: float) -> None:
        """Predict over ``scale`` sample periods with the force u [N/kN], without a measurement."""
        x = self._numbers[0]
        self._set_speed(output(self.theta(), regressor(x, u, scale)) + (1.0 - scale) * x)

    def reinit_speed(self, y: float, variance: float) -> None:  # noqa: ARG002 - x has no variance here
        """Restart x from a measured speed y [m/s]."""
        self._set_speed(y)

    def shift(self, change: float) -> None:
        """Add a change of speed [m/s] to x."""
        self._set_speed(self._numbers[0] + change)

    def _set_speed(self, x: float) -> None:
        self._numbers = (x, *self._numbers[1:])

    def inflate_load_variance(self, share: float) -> None:
        """Change nothing: the paper has no stops."""


def paper_rls(train_file: TrainFile, config: RlsConfig) -> SpeedModelEstimator:
    """Return an estimator of a1, a2, b1, d0 from aligned samples by an algorithm of the paper."""
    return SpeedModelEstimator(train_file, config, lambda theta0, P0: Rls(theta0, P0, config))
