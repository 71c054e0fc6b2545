# SPDX-License-Identifier: Apache-2.0
"""Random processes of the simulator, both AR(1): gusts over time and map errors over distance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainid_ros.settings import check_settings, setting


@dataclass(frozen=True, slots=True)
class GustModel:
    """Gust resistance [N/kN]: AR(1) process ``r(t + dt) = rho r(t) + noise`` with rho = exp(-dt / tau)."""

    std: float = setting(0.1, 'standard deviation of the gust resistance', 'N/kN', 0.0, 10.0)
    time_constant: float = setting(5.0, 'correlation time of the gust resistance', 's', 0.01, 1e4)


class Gust:
    """Gust resistance, sampled in equal time steps; ``value`` is the current one [N/kN]."""

    def __init__(self, model: GustModel, dt: float, rng: np.random.Generator) -> None:
        """Start from the stationary distribution.

        Args:
            model: Standard deviation and correlation time.
            dt: Time step [s].
            rng: Random generator; the process takes ownership.

        Raises:
            InputError: A setting is out of range.

        """
        check_settings(model)
        self._rho = math.exp(-dt / model.time_constant)
        self._noise_std = model.std * math.sqrt(1.0 - self._rho**2)
        self._rng = rng
        self.value = model.std * float(rng.standard_normal())

    def step(self) -> float:
        """Advance by one step and return the resistance [N/kN]."""
        self.value = self._rho * self.value + self._noise_std * float(self._rng.standard_normal())
        return self.value


def ar1_path(count: int, std: float, rho: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a stationary AR(1) sequence, shape (count,), with correlation rho between adjacent values."""
    noise = rng.standard_normal(count)
    path = np.empty(count)
    value = float(noise[0])
    noise_std = math.sqrt(1.0 - rho * rho)
    for i in range(count):
        value = value if i == 0 else rho * value + noise_std * float(noise[i])
        path[i] = std * value
    return path
