# SPDX-License-Identifier: Apache-2.0
"""Truth of a drive: the values that estimates are scored against."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Truth:
    """True values on a grid of 0.2 s.

    Attributes:
        time_ns: Stamps of the grid [ns].
        speed: True speed [m/s].
        a, b, c: True Davis coefficients [N/kN of the true weight, v the true speed in m/s].
        mass: True mass [kg].
        brake_rate: True brake deceleration over that of a nominal brake with the same dead time and lag [1].
        braking: The brake acts at more than 0.1 m/s^2.
        moving: The train moves.
        traction: True tractive effort [N].
        force_scale: True over reported tractive effort, times reported over true mass [1].
        changes: Times of the steps of resistance [s].
        brake_changes: Times at which steps and ramps of the brake rate begin [s].
        force_delay: Delay of the reported force relative to its stamp [s].
        brake_delay_error: True minus stated dead time of the brake [s].
        wheel_ratio: Measured over true speed [1].
        curve: True curve resistance coefficient [N/kN m].
        gust_std, gust_time: Standard deviation [N/kN] and correlation time [s] of the gusts.
        map_std, map_length: Standard deviation [per mille] and correlation length [m] of the gradient error.
        stop_errors: Distance of each stop beyond its stopping point [m].

    """

    time_ns: NDArray[np.int64]
    speed: NDArray[np.float64]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    c: NDArray[np.float64]
    mass: NDArray[np.float64]
    brake_rate: NDArray[np.float64]
    braking: NDArray[np.bool_]
    moving: NDArray[np.bool_]
    traction: NDArray[np.float64]
    force_scale: NDArray[np.float64]
    changes: tuple[float, ...]
    brake_changes: tuple[float, ...]
    force_delay: float
    brake_delay_error: float
    wheel_ratio: float
    curve: float
    gust_std: float
    gust_time: float
    map_std: float
    map_length: float
    stop_errors: tuple[float, ...]

    def index_at(self, time_ns: int) -> int:
        """Return the index of the grid point at or before a time [ns], 0 before the drive."""
        return max(int(np.searchsorted(self.time_ns, time_ns, side='right')) - 1, 0)

    def davis_at(self, time_ns: int) -> tuple[float, float, float]:
        """Return the true a, b, c [N/kN, v in m/s] at a time [ns]."""
        i = self.index_at(time_ns)
        return float(self.a[i]), float(self.b[i]), float(self.c[i])

    def brake_rate_at(self, time_ns: int) -> float:
        """Return the true brake rate [1] at a time [ns]."""
        return float(self.brake_rate[self.index_at(time_ns)])
