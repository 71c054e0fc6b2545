# SPDX-License-Identifier: Apache-2.0
"""AM-VFF-RLS: the speed model by recursive least squares with auxiliary model and variable forgetting.

After Yuan et al. 2017, model (2) and algorithm (7):

    x(n) = a1 x(n-1)^2 + a2 x(n-1) + b1 u(n-1) + d0

in the order that (7) can be computed in (its error and gain are printed as functions of each other), with

* the forgetting factor (6) clamped from below: unclamped it turns negative and the run is lost;
* the auxiliary output pulled towards the measurement by ``kappa``: a pure auxiliary model drifts away
  from a plant whose pole is 1 - 1e-4;
* the input u less gradient and other known resistance, so that d0 is the Davis a and not the gradient;
* the regressor scaled by dt/T, so that jitter and missing samples keep their meaning;
* theta, P and lambda frozen at standstill and while the brake acts (the reported force is then nominal).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.results import Reason, Refusal, SpeedModelEstimate
from trainid_ros.core.samples import SAMPLE_PERIOD, Sample
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import davis_prior
from trainid_ros.physics.resistance import G

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.physics.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class AmVffRlsConfig:
    """Settings of AM-VFF-RLS."""

    speed_std: float = setting(0.025, 'noise of measured speed, quantum included', 'm/s', 1e-4, 2.0)
    forgetting_scale: float = setting(200.0, 'sigma of (6) in units of the speed variance', '1', 1.0, 1e9)
    min_forgetting: float = setting(0.9, 'smallest forgetting factor', '1', 0.5, 1.0)
    kappa: float = setting(0.1, 'share of the measurement in the auxiliary output', '1', 0.0, 1.0)
    min_speed: float = setting(0.5, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    gate: float = setting(5.0, 'errors beyond this many standard deviations are refused', '1', 1.0, 100.0)
    gate_floor: float = setting(0.25, 'errors below this are never refused', 'm/s', 0.0, 10.0)
    readmit_after: int = setting(5, 'refused samples in a row after which the model is re-anchored', 'samples', 1, 1000)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their believed values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of the Davis a', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of the Davis b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of the Davis c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    prior_std_mass: float = setting(0.05, 'prior relative standard deviation of mass factor', '1', 1e-6, 1.0)
    settle_samples: int = setting(200, 'samples used before the model is fit to use', 'samples', 1, 100000)


@dataclass(frozen=True, slots=True)
class AmVffRlsState:
    """All that AM-VFF-RLS remembers; P is the covariance over the speed variance."""

    theta: tuple[float, ...]
    P: tuple[float, ...]
    x_a: float = 0.0
    forgetting: float = 1.0
    predicted: float = 0.0
    error: float = 0.0
    used: int = 0
    refused_in_a_row: int = 0
    braked_ns: int = 0


def to_speed_model(davis: tuple[float, float, float], c: float) -> tuple[float, float, float, float]:
    """Map Davis parameters and c [m/s^2 per N/kN] to (a1, a2, b1, d0) by forward Euler."""
    T = SAMPLE_PERIOD
    a, b, c2 = davis
    return -T * c * c2, 1.0 - T * c * b, T * c, -T * c * a


def to_physical(theta: tuple[float, ...]) -> tuple[float, float, float, float]:
    """Map (a1, a2, b1 > 0, d0) back to Davis (a, b, c) and c [m/s^2 per N/kN]."""
    a1, a2, b1, d0 = theta
    return -d0 / b1, (1.0 - a2) / b1, -a1 / b1, b1 / SAMPLE_PERIOD


class AmVffRls:
    """Estimate a1, a2, b1, d0 from aligned samples."""

    def __init__(self, train_file: TrainFile, config: AmVffRlsConfig) -> None:
        check_settings(config)
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis = train_file.resistance
        c = 1.0 / self._known.inertia
        self._theta0 = to_speed_model((davis.a, davis.b, davis.c), c)
        self._P0 = self._prior((davis.a, davis.b, davis.c), c)
        self._P0_inverse = np.linalg.inv(self._P0)
        self.reset()

    def _prior(self, davis: tuple[float, float, float], c: float) -> NDArray[np.float64]:
        """P(0): prior of the physical parameters through the map, over the speed variance."""
        config, T = self.config, SAMPLE_PERIOD
        a, b, c2 = davis
        physical = np.zeros((4, 4))
        floors = (config.prior_std_a, config.prior_std_b, config.prior_std_c)
        physical[:3, :3] = davis_prior(davis, config.prior_share, floors)
        physical[3, 3] = (config.prior_std_mass * c) ** 2
        # Rows a1, a2, b1, d0; columns a, b, c, acceleration coefficient.
        J = T * np.array([[0, 0, -c, -c2], [0, -c, 0, -b], [0, 0, 0, 1], [-c, 0, 0, -a]], dtype=float)
        P0: NDArray[np.float64] = J @ physical @ J.T / config.speed_std**2
        return P0

    def reset(self) -> None:
        """Go back to the prior."""
        self.state = AmVffRlsState(self._theta0, tuple(map(float, self._P0.ravel())))
        self._admission.braked_ns = 0

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, AmVffRlsState)
        sized = len(state.theta) == 4 and len(state.P) == 16
        check_restored(sized and bool(np.isfinite([*state.theta, *state.P]).all()), 'AmVffRlsState', 'theta or P')
        self.state = state
        self._admission.braked_ns = self.state.braked_ns

    @property
    def converged(self) -> bool:
        """True once enough samples were used."""
        return self.state.used >= self.config.settle_samples

    def step(self, sample: Sample) -> SpeedModelEstimate | Refusal:
        """One step of (7) in its computable order."""
        refusal = self._admission.refuse(sample)
        state = replace(self.state, braked_ns=self._admission.braked_ns)
        if refusal is not None:
            self.state = replace(state, x_a=sample.speed, predicted=sample.speed, error=0.0)
            return refusal
        y, theta, P = sample.speed, np.array(state.theta), np.array(state.P).reshape(4, 4)
        phi, base = self._regressor(state.x_a, sample)
        predicted = float(phi @ theta) + base
        g = float(phi @ P @ phi)
        eps = y - predicted
        limit = max(self.config.gate_floor, self.config.gate * self.config.speed_std * math.sqrt(1.0 + g))
        if abs(eps) > limit:
            self.state = self._skipped(state, predicted, eps, y)
            return Refusal(sample.stamp_ns, Reason.OUTLIER, eps, limit)
        lam = self._forgetting(eps, g, P)
        K = P @ phi / (g + lam)
        theta = theta + K * eps
        P = (P - np.outer(K, phi @ P)) / lam
        P = 0.5 * (P + P.T)
        x_a = float(phi @ theta) + base
        x_a += self.config.kappa * (y - x_a)
        if not (theta[2] > 0.0 and np.isfinite(theta).all() and np.isfinite(P).all() and math.isfinite(x_a)):
            self.state = replace(state, x_a=y)
            return Refusal(sample.stamp_ns, Reason.NUMERICAL, float(theta[2]), 0.0)
        self.state = AmVffRlsState(
            theta=tuple(map(float, theta)),
            P=tuple(map(float, P.ravel())),
            x_a=x_a,
            forgetting=lam,
            predicted=predicted,
            error=eps,
            used=state.used + 1,
            braked_ns=state.braked_ns,
        )
        return self.estimate(sample.speed)

    def _regressor(self, x: float, sample: Sample) -> tuple[NDArray[np.float64], float]:
        """Return phi of (7) scaled to the step taken, and the part of x that does not depend on theta."""
        u = self._known.traction(sample.force_mean, sample) - self._known.track(sample)
        scale = sample.dt / SAMPLE_PERIOD
        phi = scale * np.array([x * x, x, u, 1.0])
        return phi, (1.0 - scale) * x

    def _forgetting(self, eps: float, g: float, P: NDArray[np.float64]) -> float:
        """Eq. (6), clamped; no forgetting once P is as wide as the prior (it would only wind up)."""
        if float(np.sum(self._P0_inverse * P)) > len(P):
            return 1.0
        sigma = self.config.forgetting_scale * self.config.speed_std**2
        return max(self.config.min_forgetting, 1.0 - eps * eps / (sigma * (1.0 + g)))

    def _skipped(self, state: AmVffRlsState, predicted: float, eps: float, y: float) -> AmVffRlsState:
        """Coast on the model over a refused sample; after several in a row believe the measurement."""
        in_a_row = state.refused_in_a_row + 1
        anchored = in_a_row >= self.config.readmit_after
        return replace(
            state,
            x_a=y if anchored else predicted,
            predicted=predicted,
            error=eps,
            refused_in_a_row=0 if anchored else in_a_row,
        )

    def estimate(self, speed: float) -> SpeedModelEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the model and what it means physically."""
        state = self.state
        a1, a2, b1, d0 = state.theta
        a, b, c, acceleration = to_physical(state.theta)
        variance = self.config.speed_std**2
        return SpeedModelEstimate(
            a1=a1,
            a2=a2,
            b1=b1,
            d0=d0,
            covariance=tuple(variance * p for p in state.P),
            forgetting_factor=state.forgetting,
            predicted_speed=state.predicted,
            prediction_error=state.error,
            a=a,
            b=b,
            c=c,
            mass_factor=G / (1000.0 * acceleration),
        )
