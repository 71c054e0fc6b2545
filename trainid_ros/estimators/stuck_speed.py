# SPDX-License-Identifier: Apache-2.0
"""A speed that stands still to the last bit while traction or brake must change it: the sensor is stuck.

Estimators would believe it: a brake without effect, a resistance as large as the traction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.results import Reason, Rejection
from trainid_ros.train.davis import davis

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.estimators.known_force import KnownForce

# A train slower than this may stand, which is no fault.
_MIN_SPEED: Final = 0.5
# Beyond any quantum, and beyond what a wrongly believed resistance adds up to while a train cruises [m/s].
_MOST_UNSEEN: Final = 0.5


@dataclass(slots=True)
class StuckSpeed:
    """Watches sample by sample; ``unseen`` is the change of speed due since the speed last changed [m/s]."""

    known: KnownForce
    speed: float = math.nan
    unseen: float = 0.0

    def reject(self, sample: Sample) -> Rejection | None:
        """Return why the speed of a sample is not believed, or None if it is."""
        if sample.speed != self.speed or sample.speed < _MIN_SPEED or math.isnan(sample.dt):
            self.speed, self.unseen = sample.speed, 0.0
            return None
        due = self._acceleration(sample) * sample.dt
        if math.isfinite(due):
            self.unseen += due
        if abs(self.unseen) <= _MOST_UNSEEN:
            return None
        return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, self.unseen, _MOST_UNSEEN)

    def _acceleration(self, sample: Sample) -> float:
        """Return what traction less believed resistance, or the brake, should give [m/s^2]."""
        if sample.brake_command < 0.0:
            return sample.brake_command
        resistance = davis(self.known.train_file.resistance, sample.speed) + self.known.track(sample)
        return (self.known.traction(max(sample.force_mean, 0.0), sample) - resistance) / self.known.inertia
