# SPDX-License-Identifier: Apache-2.0
"""Direction of travel and last stop, followed sample by sample."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from trainid_ros.stream.samples import STANDING

# Farther than odometer noise, shorter than any run between stops [m].
_TURNING_DISTANCE: Final = 5.0


@dataclass(slots=True)
class Travel:
    """What positions and speeds have shown so far."""

    direction: int = 1  # +1 or -1 as positions rise or fall, kept until the train has clearly moved
    turning_position: float = math.nan  # Position from which the next movement counts [m], NaN while unknown
    moving: bool = False  # Whether the train moved at the last sample
    stop_ns: int = 0  # When it last came to a stop [ns]; 0 if it has not, also where records begin at rest

    def follow(self, stamp_ns: int, speed: float, position: float) -> None:
        """Take in stamp [ns], speed [m/s] and position [m] of a sample."""
        moved = position - self.turning_position
        if math.isnan(moved):
            self.turning_position = position if math.isnan(self.turning_position) else self.turning_position
        elif abs(moved) > _TURNING_DISTANCE:
            self.direction = 1 if moved > 0.0 else -1
            self.turning_position = position
        if self.moving and speed < STANDING:
            self.stop_ns = stamp_ns
        self.moving = speed >= STANDING
