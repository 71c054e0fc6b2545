# SPDX-License-Identifier: Apache-2.0
"""Longitudinal force balance of a train in specific form: newtons per kilonewton of its weight.

``1000 F / (M g) = w(v) + i + w_extra + 1000 (1 + gamma) (dv/dt) / g`` with the Davis resistance
``w(v) = a + b v + c v^2`` [N/kN, v in m/s], the gradient i [per mille, + uphill] and gamma the
rotating mass as a share of the mass [1].
"""

from __future__ import annotations

from typing import Any, Final, overload

import numpy as np
from numpy.typing import NDArray

from trainid_ros.train.train_file import Davis

G: Final = 9.80665
"""Standard gravity [m/s^2] (CODATA), used throughout the project."""


@overload
def davis(resistance: Davis, v: float) -> float: ...
@overload
def davis(resistance: Davis, v: NDArray[np.float64]) -> NDArray[np.float64]: ...
def davis(resistance: Davis, v: Any) -> Any:
    """Return the running resistance [N/kN] at a speed [m/s], or at each of an array of speeds."""
    return resistance.a + v * (resistance.b + resistance.c * v)


def specific_force(force: float, mass: float) -> float:
    """Return ``1000 F / (M g)`` [N/kN] of a force [N] on a mass [kg]."""
    return force * (1000.0 / (mass * G))


def specific_inertia(acceleration: float, rotary_mass: float) -> float:
    """Return ``1000 (1 + gamma) a / g`` [N/kN] of an acceleration [m/s^2]; ``rotary_mass`` is gamma [1]."""
    return acceleration * (1000.0 * (1.0 + rotary_mass) / G)


def acceleration(force: float, mass: float, rotary_mass: float, resistance: float) -> float:
    """Return the acceleration [m/s^2] of a mass [kg] under a force [N] and the total resistance [N/kN].

    ``resistance`` is the sum w(v) + i + w_extra, ``rotary_mass`` is gamma [1].
    """
    return (specific_force(force, mass) - resistance) * (G / (1000.0 * (1.0 + rotary_mass)))


def required_force(acceleration: float, mass: float, rotary_mass: float, resistance: float) -> float:
    """Return the force [N] that gives an acceleration [m/s^2]: the inverse of :func:`acceleration`."""
    return (specific_inertia(acceleration, rotary_mass) + resistance) * (mass * G / 1000.0)
