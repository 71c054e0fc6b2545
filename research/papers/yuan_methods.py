# SPDX-License-Identifier: Apache-2.0
"""The algorithms for station lines: a common fleet prior, and the settings of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from research.papers.lockstep import ManyIntegral, ManyMethod, ManyRls, Track, drive_each, drive_many
from research.papers.station_lines import Lines, Noise
from trainid_lab.speed_model import integral_rls, rls
from trainid_lab.speed_model.speed_model_ekf import ekf_tuning
from trainid_ros.estimators.settings import AmVffRlsConfig, SpeedModelConfig
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Symmetric, Theta, Tuning, prior
from trainid_ros.train.forces import G

# Fleet prior: Davis parameters, their standard deviations, and a load of +-12 %.
_FLEET: Final = SpeedModelConfig(prior_share=0.0, prior_std_a=3.0, prior_std_b=0.03, prior_std_c=0.004)
_FLEET_MASS: Final = 0.12


def _fleet_prior(davis: tuple[float, float, float], k: float) -> tuple[Theta, Symmetric]:
    """Return theta(0) and its covariance without load weighing: the mass scales all of theta, as in (2)."""
    theta, P = prior(davis, k, _FLEET, _FLEET_MASS)
    a1, a2, b1, d0 = theta
    by_mass = np.array([a1, a2 - 1.0, b1, d0])
    alone = np.diag([P[0], P[4], 0.0, P[9]])
    covariance = alone + _FLEET_MASS**2 * np.outer(by_mass, by_mass)
    s11, s12, s13, s14, s22, s23, s24, s33, s34, s44 = covariance[np.triu_indices(4)].tolist()
    return theta, (s11, s12, s13, s14, s22, s23, s24, s33, s34, s44)


THETA0, P0 = _fleet_prior((2.0, 0.05, 0.0105), G / (1000.0 * 1.08))
LOAD: Final = (2e-4) ** 2
"""Variance of the change of b1 at a stop."""
# The gradient is unknown here, so d0 is a random walk; tuned on lines of seeds below 1000, as all settings.
_DRIFT_AM: Final = 1e-8
_DRIFT_EKF: Final = 3e-8
_DRIFT_INTEGRAL: Final = 1e-7
_WIDE: Final = 1e4
PRINTED: Final = 'AM-VFF-RLS (7), lambda >= .9'


@dataclass(frozen=True, slots=True)
class Named:
    """A method with its name in the tables; ``freeze``: theta is constant at standstill."""

    name: str
    method: ManyMethod
    freeze: bool

    def drive(self, lines: Lines, y: np.ndarray) -> Track:
        """Drive all lines."""
        return drive_many(self.method, y, lines.u, freeze=self.freeze)


@dataclass(frozen=True, slots=True)
class Auxiliary:
    """AM-VFF-RLS and, with ``ekf_tuning``, the EKF."""

    name: str
    tuning: Tuning
    variance: float
    P0: Symmetric

    def drive(self, lines: Lines, y: np.ndarray) -> Track:
        """Drive all lines."""
        return drive_each(lambda: AuxiliaryModel(THETA0, self.P0, self.tuning), y, lines.u, self.variance)


def am_tuning(drift: float = _DRIFT_AM, load: float = LOAD) -> Tuning:
    """Return the tuning of AM-VFF-RLS: the settings of the product except noise, drift and load of these lines."""
    config = AmVffRlsConfig()
    return Tuning(
        noise=0.0,
        drift=drift,
        load=load,
        share=1.0 / config.memory,
        threshold=config.threshold,
        scale=config.forgetting_scale,
        low=config.min_forgetting,
        gate=config.gate,
        gate_floor=config.gate_floor,
    )


def am_vff(variance: float) -> Auxiliary:
    """Return the product's AM-VFF-RLS."""
    return Auxiliary('AM-VFF-RLS', am_tuning(), variance, P0)


def ekf(variance: float) -> Auxiliary:
    """Return the product's EKF."""
    return Auxiliary('EKF', ekf_tuning(0.0, _DRIFT_EKF, LOAD, 4.0), variance, P0)


def integral(variance: float) -> Named:
    """Return the product's integral RLS."""
    tuning = integral_rls.Tuning(25, 1, 0.3, 4.0, 0.0, _DRIFT_INTEGRAL, LOAD)
    return Named('integral-RLS', ManyIntegral(THETA0, P0, tuning, variance), freeze=True)


def paper(name: str, variance: float, kappa: float, scale: float, low: float = 0.9) -> Named:
    """Return an algorithm of the paper with a diffuse prior; ``scale`` is sigma of (6) over the variance, 0: none."""
    tuning = rls.Tuning(kappa, scale * variance, low, 1e9)
    return Named(name, ManyRls(THETA0, scaled(P0, _WIDE / variance), tuning, variance), freeze=False)


def repaired(variance: float, scale: float) -> Named:
    """Return AM-VFF-RLS by (7) with kappa = 0.1, clamp, gate, freezing and the fleet's prior."""
    tuning = rls.Tuning(0.1, scale * variance, 0.9, 5.0)
    return Named('AM-VFF-RLS (7), repaired', ManyRls(THETA0, scaled(P0, 1.0 / variance), tuning, variance), freeze=True)


def scaled(S: Symmetric, factor: float) -> Symmetric:
    """Return a multiple of a matrix."""
    return tuple(factor * s for s in S)  # type: ignore[return-value]


# sigma of (6) over the speed variance with the least one-step error of 10 ... 25000, on lines of seeds 300 to 339:
# VFF-RLS, AM-VFF-RLS, AM-VFF-RLS repaired.
SCALES: Final = {
    'white .02': (250.0, 250.0, 75.0),
    'AR(1) .9, .02': (25.0, 75.0, 75.0),
    '0.1 km/h': (75.0, 75.0, 25.0),
    '10 % missing': (250.0, 250.0, 75.0),
    '5 % outliers': (750.0, 2500.0, 250.0),
}


def all_methods(noise: Noise) -> tuple[Named | Auxiliary, ...]:
    """Return all methods, with sigma tuned for a noise; the last are the product's."""
    variance = noise.declared**2
    vff, am, corrected = SCALES[noise.name]
    return (
        paper('RLS', variance, 1.0, 0.0),
        paper('VFF-RLS', variance, 1.0, vff),
        paper('AM-RLS', variance, 0.0, 0.0),
        paper(PRINTED, variance, 0.0, am),
        repaired(variance, corrected),
        integral(variance),
        ekf(variance),
        am_vff(variance),
    )


def oracle(lines: Lines, y: np.ndarray) -> Track:
    """Return the track with the true theta and the measured speed (true speed where it is missing)."""
    x = np.where(np.isnan(y), lines.x, y)
    none = np.full_like(x, np.nan)
    state = np.concatenate([x[:, None], lines.theta], axis=1)
    return Track(state, np.zeros((len(x) // 10 + 1, 10, x.shape[1])), x, y - lines.x, none, np.ones_like(x))
