# SPDX-License-Identifier: Apache-2.0
"""Train model of Zheng et al. 2015, eqs. (1)-(4), in exact discrete time: x = [D, v, a, a_z], linear in f.

    D' = v,  v' = a + d(t),  tau a' = -a + f (a_z - u),  a_z' = -lam a_z + 2 lam u.

u is the command a_Tar and a_z - u is u after a first-order Pade delay, exp(-Ts) ~ (lam - s)/(lam + s), lam = 2/T
(its initial response has the wrong sign, so the estimators on samples use the exact dead time instead). The printed A
and b are correct; in (1) the delay must be T, not tau. Not stated in the paper: Phi(f) = Phi0 + f Phi1 and
Gamma(f) = Gamma0 + f Gamma1 exactly, and a_z is a known function of the command, so f multiplies a known signal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainid_lab.brake_rate.particles import Array, LinearStep
from trainid_ros.interface.errors import InputError


@dataclass(frozen=True, slots=True)
class PadeModel:
    """Transition over one sample, x_k = (Phi0 + f Phi1) x_{k-1} + (Gamma0 + f Gamma1) u + E d."""

    Phi0: Array  # Shape (4, 4)
    Phi1: Array  # Shape (4, 4)
    Gamma0: Array  # Shape (4,)
    Gamma1: Array  # Shape (4,)
    E: Array  # Effect of d, held over the sample, shape (4,)

    def step(self, a_z: float, u: float, variance: float) -> LinearStep:
        """Return the step of [D, v, a] for known a_z and u [m/s^2]; ``variance`` is that of d [m^2/s^4]."""
        return LinearStep(
            Phi=self.Phi0[:3, :3],
            gamma=self.Phi1[:3, 3] * a_z + self.Gamma1[:3] * u,
            known=self.Phi0[:3, 3] * a_z + self.Gamma0[:3] * u,
            Q=variance * np.outer(self.E[:3], self.E[:3]),
        )

    def next_a_z(self, a_z: float, u: float) -> float:
        """Return a_z [m/s^2] one sample later."""
        return float(self.Phi0[3, 3] * a_z + self.Gamma0[3] * u)


def pade_model(dt: float, tau: float, lam: float) -> PadeModel:
    """Return the model for a sample of ``dt`` [s], a lag ``tau`` [s] and ``lam`` = 2 / dead time [1/s].

    Raises:
        InputError: A value is not positive, or lam tau = 1, where the closed form has a pole.

    """
    if not (dt > 0.0 and tau > 0.0 and lam > 0.0 and lam * tau != 1.0):
        raise InputError(f'dt = {dt:g} s, tau = {tau:g} s and lam = {lam:g} 1/s must be > 0, and lam tau must not be 1')
    # A mode exp(-r t), its integral and its double integral.
    lag, delay = _mode(1.0 / tau, dt), _mode(lam, dt)
    unit = (1.0, dt, 0.5 * dt * dt)
    c = 1.0 / (1.0 - lam * tau)
    Phi0, Phi1 = np.zeros((4, 4)), np.zeros((4, 4))
    Phi0[0, :3], Phi0[1, 1:3], Phi0[2, 2], Phi0[3, 3] = (1.0, dt, lag[2]), (1.0, lag[1]), lag[0], delay[0]
    # Rows D, v, a of the terms with f: the response of the lag to a decaying a_z, and to u including the a_z it causes.
    from_a_z = [c * (delay[i] - lag[i]) for i in (2, 1, 0)]
    from_u = [unit[i] - lag[i] - 2.0 * c * (delay[i] - lag[i]) for i in (2, 1, 0)]
    Phi1[:3, 3] = from_a_z
    Gamma0, Gamma1 = np.array([0.0, 0.0, 0.0, 2.0 * (1.0 - delay[0])]), np.array([*from_u, 0.0])
    return PadeModel(Phi0, Phi1, Gamma0, Gamma1, np.array([unit[2], unit[1], 0.0, 0.0]))


def _mode(rate: float, t: float) -> tuple[float, float, float]:
    once = -math.expm1(-rate * t) / rate
    return math.exp(-rate * t), once, (t - once) / rate
