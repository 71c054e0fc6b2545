# SPDX-License-Identifier: Apache-2.0
"""State of an estimator of the speed model as it is saved: numbers of the algorithm, and what is estimated beside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

from trainid_ros.interface.scalars import is_finite
from trainid_ros.speed_model.am_vff_rls import Numbers
from trainid_ros.speed_model.nuisance_parameters import CurveError, Disturbance, ForceDelay
from trainid_ros.state import check_not_negative, check_numbers, check_restored
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
    numbers: Numbers = ()  # State of the algorithm, set only when saved
    recent: Numbers = ()  # Last samples, set only when saved
    braked_ns: int = 0  # Last stamp at which the brake was commanded [ns], set only when saved

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

    def check(self) -> None:
        """Raise InputError, naming the field, if a saved state is invalid apart from that of the algorithm."""
        kind = 'SpeedModelState'
        # The algorithms as printed can diverge before they restart, so these values are only required to be finite.
        for name in ('forgetting', 'predicted', 'error', 'variance'):
            check_restored(is_finite(getattr(self, name)), kind, name)
        bounded = replace(self, numbers=(), forgetting=1.0, predicted=0.0, error=0.0, variance=0.0)
        check_numbers(bounded, may_be_nan=('dt',))  # dt of the noise is NaN after a gap
        check_restored(self.noise.is_valid(), kind, 'noise')
        check_restored(self.disturbance.is_valid(), kind, 'disturbance')
        check_restored(self.force_delay.variance >= 0.0, kind, 'force_delay')
        check_not_negative(kind, variance=self.variance, speed_variance=self.speed_variance, used=self.used)
        check_not_negative(kind, rejected_in_a_row=self.rejected_in_a_row, slow_in_a_row=self.slow_in_a_row)
