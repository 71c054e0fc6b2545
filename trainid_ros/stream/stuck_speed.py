# SPDX-License-Identifier: Apache-2.0
"""Detect a stuck speed sensor: a speed constant to the last bit although traction or brake must change it.

Estimators would otherwise learn a brake without effect, or a resistance as large as the traction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.results import Reason, Rejection
from trainid_ros.scalars import is_finite
from trainid_ros.stream.samples import Sample
from trainid_ros.train.davis import davis

# A slower train may be at rest, where a constant speed is no fault [m/s].
_MIN_SPEED: Final = 0.5
# More than any quantum, and more than the train file's error of the resistance adds up to while cruising [m/s].
_MAX_MISSING: Final = 0.5


@dataclass(slots=True)
class StuckSpeed:
    """Checks the speed sample by sample.

    Attributes:
        known: Known part of the force balance.
        speed: Last measured speed [m/s].
        missing: Expected change of speed since the measured speed last changed [m/s].

    """

    known: KnownForce
    speed: float = math.nan
    missing: float = 0.0

    def reject(self, sample: Sample) -> Rejection | None:
        """Return why the speed of a sample is rejected, or None if it is accepted."""
        if sample.speed != self.speed or sample.speed < _MIN_SPEED or math.isnan(sample.dt):
            self.speed, self.missing = sample.speed, 0.0
            return None
        expected = self._acceleration(sample) * sample.dt
        if is_finite(expected):
            self.missing += expected
        if abs(self.missing) <= _MAX_MISSING:
            return None
        return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, self.missing, _MAX_MISSING)

    def _acceleration(self, sample: Sample) -> float:
        """Return the acceleration expected from the brake command, or from traction less resistance [m/s^2]."""
        if sample.brake_command < 0.0:
            return sample.brake_command
        resistance = davis(self.known.train_file.resistance, sample.speed) + self.known.track(sample)
        return (self.known.traction(max(sample.force_mean, 0.0), sample) - resistance) / self.known.inertia
