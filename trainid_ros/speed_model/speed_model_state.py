# SPDX-License-Identifier: Apache-2.0
"""What an estimator of the speed model estimates beside its algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.speed_model.nuisance_parameters import CurveError, Disturbance, ForceDelay
from trainid_ros.stream.known_force import SpeedNoise

# The range of speeds driven: memory of about half an hour, and its half-width in standard deviations.
_SPEED_SAMPLES: Final = 9000.0
_SPEED_WIDTH: Final = 1.5


@dataclass
class SpeedModelState:
    """State of an estimator of the speed model."""

    noise: SpeedNoise  # Noise of measured speed
    disturbance: Disturbance  # Strength of gusts and other unmodelled disturbances
    force_delay: ForceDelay  # Delay of the reported force
    curve: CurveError  # Error of the curve resistance
    forgetting: float = 1.0  # Last forgetting factor [1]
    predicted: float = 0.0  # Last predicted speed [m/s]
    error: float = 0.0  # Last prediction error [m/s]
    variance: float = 0.0  # Its predicted variance [(m/s)^2]
    slowest: float = 0.0  # Slowest speed used [m/s]
    fastest: float = -1.0  # Fastest speed used [m/s]; less than ``slowest`` if there is none yet
    speed_mean: float = 0.0  # Running mean of the speeds used [m/s]
    speed_variance: float = 0.0  # Their running variance [(m/s)^2]
    used: float = 0.0  # Number of samples used, up to the memory of these means
    rejected_in_a_row: int = 0  # Outliers in a row
    slow_in_a_row: int = 0  # Samples in a row below the minimum speed
    traction: float = 0.0  # Last known traction [N/kN]
    weighed: bool = False  # Whether the mass was weighed at the last sample
    fit: bool = False  # Whether the resistance is valid

    def drive(self, y: float) -> None:
        """Take a speed used [m/s] into the range and the running mean and variance of the speeds."""
        if self.fastest >= self.slowest:
            self.slowest, self.fastest = min(y, self.slowest), max(y, self.fastest)
        else:
            self.slowest = self.fastest = y
        share, off = 1.0 / min(self.used + 1.0, _SPEED_SAMPLES), y - self.speed_mean
        self.speed_mean += share * off
        self.speed_variance = (1.0 - share) * (self.speed_variance + share * (off * off))
        self.used = 1.0 / share

    def speeds_driven(self) -> tuple[float, float]:
        """Return slowest and fastest of the usual speeds [m/s]."""
        width = _SPEED_WIDTH * math.sqrt(self.speed_variance)
        return max(self.speed_mean - width, self.slowest), min(self.speed_mean + width, self.fastest)
