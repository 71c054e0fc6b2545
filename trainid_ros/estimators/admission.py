# SPDX-License-Identifier: Apache-2.0
"""Select the samples that inform the running resistance: moving, complete, and with the brake off.

The braking force is not known well enough to learn the resistance from: the brake rate is itself unknown.
"""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.results import Reason, Rejection
from trainid_ros.scalars import is_finite, seconds
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Sample

# Force noise while coasting stays above this [N/kN]; deliberate braking is far below.
_BRAKE_FORCE: Final = -1.5


class Admission:
    """Admits or rejects samples one by one.

    Attributes:
        known: Known part of the force balance.
        min_speed: Slowest speed admitted [m/s].
        braked_ns: Last stamp at which braking was requested [ns], 0 if never.

    """

    def __init__(self, known: KnownForce, min_speed: float) -> None:
        self.known = known
        self.min_speed = min_speed
        self.braked_ns = 0

    def reject(self, sample: Sample) -> Rejection | None:
        """Return why a sample cannot be used to learn the resistance, or None if it can."""
        brake_acts = self._brake_acts(sample)
        if (rejection := self._incomplete(sample)) is not None:
            return rejection
        if not sample.speed >= self.min_speed:
            return Rejection(sample.stamp_ns, Reason.STANDSTILL, sample.speed, self.min_speed)
        if brake_acts:
            return Rejection(sample.stamp_ns, Reason.BRAKING, self._since_braked(sample), self.known.settling)
        return None

    def _incomplete(self, sample: Sample) -> Rejection | None:
        """Return which input is missing or impossible, None if none is."""
        if math.isnan(sample.dt):
            return Rejection(sample.stamp_ns, Reason.GAP, sample.dt, math.nan)
        if (rejection := self.known.reject(sample)) is not None:
            return rejection
        if not is_finite(sample.brake_command):
            return Rejection(sample.stamp_ns, Reason.BRAKE_COMMAND_MISSING, sample.brake_command, math.nan)
        return None

    def _brake_acts(self, sample: Sample) -> bool:
        """Return True while the brake acts, is releasing, or is not known to be off."""
        force = self.known.traction(min(sample.force, sample.force_mean), sample)
        # Over a gap of the commands the brake may have acted unseen.
        unknown = sample.brake_gap or not sample.brake_command >= 0.0
        requested = unknown or sample.emergency or force < _BRAKE_FORCE
        for change in sample.brake_changes:
            requested = requested or change.target_acceleration < 0.0
        if requested:
            self.braked_ns = sample.stamp_ns
            return True
        if sample.stamp_ns < self.braked_ns:  # the stamps jumped back
            self.braked_ns = 0
        return self._since_braked(sample) < self.known.settling

    def _since_braked(self, sample: Sample) -> float:
        return math.inf if self.braked_ns == 0 else seconds(sample.stamp_ns - self.braked_ns)
