# SPDX-License-Identifier: Apache-2.0
"""Random processes of the simulator: gusts over time and map errors over distance, both AR(1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainid_ros.core.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class GustModel:
    """Resistance that comes and goes: AR(1) with ``r(t + dt) = rho r(t) + ...``, rho = exp(-dt / tau)."""

    std: float = setting(0.1, 'standard deviation of the gust resistance', 'N/kN', 0.0, 10.0)
    time_constant: float = setting(5.0, 'correlation time of the gust resistance', 's', 0.01, 1e4)


class Gust:
    """The gust resistance, stepped in equal times."""

    def __init__(self, model: GustModel, dt: float, rng: np.random.Generator) -> None:
        """Start from the stationary distribution.

        Args:
            model: Strength and correlation time.
            dt: Time of one step [s].
            rng: Source of randomness, owned from here on.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self._rho = math.exp(-dt / model.time_constant)
        self._kick = model.std * math.sqrt(1.0 - self._rho**2)
        self._rng = rng
        self.value = model.std * float(rng.standard_normal())

    def step(self) -> float:
        """Go one step on and return the resistance [N/kN]."""
        self.value = self._rho * self.value + self._kick * float(self._rng.standard_normal())
        return self.value


def ar1_path(count: int, std: float, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a stationary AR(1) sequence, shape (count,), with correlation rho between neighbours."""
    noise = rng.standard_normal(count)
    path = np.empty(count)
    value = float(noise[0])
    kick = math.sqrt(1.0 - rho * rho)
    for i in range(count):
        value = value if i == 0 else rho * value + kick * float(noise[i])
        path[i] = std * value
    return path
