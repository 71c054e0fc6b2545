# SPDX-License-Identifier: Apache-2.0
"""Detect a stuck speed sensor.

A speed is stuck that stays the same to the last bit although traction or brake must change it, or for longer than noisy
measurements do: two of them with noise sigma, in steps of q, are equal with probability q / (2 sqrt(pi) sigma).
Estimators would otherwise learn a brake without effect, or a resistance as large as the traction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite
from trainid_ros.state import State, declare
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import davis

# A slower train may be at rest, where a constant speed is no fault [m/s].
_MIN_SPEED: Final = 0.5
# More than any quantum, and more than the train file's error of the resistance adds up to while cruising [m/s].
_MAX_MISSING: Final = 0.5
# Density of the difference of two equal measurements, times sigma: 1 / (2 sqrt(pi)).
_EQUAL: Final = 0.2821
# Coarser steps hide the noise: then repeats say nothing [1].
_MOST_LIKELY: Final = 0.4
# A brake has followed a command after its dead time and this many time constants.
_FOLLOWED: Final = 2.0
# Probability of repeats that never happen, fewest of them, and speeds that show the noise before.
_NEVER: Final = 1e-9
_FEWEST: Final = 5
_SEEN: Final = 100


@dataclass(slots=True)
class StuckSpeedState:
    """State of the check."""

    speed: float = math.nan  # Last measured speed [m/s], NaN before the first
    missing: float = 0.0  # Expected change of speed since the measured speed last changed [m/s]
    repeats: int = 0  # Number of times that the last speed has come again
    most: int = 0  # Most repeats of a noisy speed, as known when it changed last; 0 if repeats say nothing
    changes: int = 0  # Number of changes in motion, up to those that show the noise
    braked_s: float = 0.0  # Time for which the brake has been applied [s]


class StuckSpeed:
    """Checks the speed sample by sample.

    Attributes:
        state: State of the check.
    """

    STATE: ClassVar[State] = declare('state')

    def __init__(self, known: KnownForce) -> None:
        self._known = known
        brake = known.train_file.brake
        self._followed_s = brake.delay + _FOLLOWED * brake.time_constant
        self.state = StuckSpeedState()

    def reject(self, sample: Sample, noise: SpeedNoise) -> Rejection | None:
        """Return why the speed of a sample is rejected, or None if it is accepted; ``noise`` is that until then."""
        state = self.state
        state.braked_s = state.braked_s + sample.dt if sample.brake_command < 0.0 and sample.dt > 0.0 else 0.0
        if sample.speed != state.speed or sample.speed < _MIN_SPEED or math.isnan(sample.dt):
            if sample.speed >= _MIN_SPEED and sample.speed != state.speed:
                state.changes = min(state.changes + 1, _SEEN)
                state.most = most_repeats(noise) if state.changes == _SEEN else 0
            state.speed, state.missing, state.repeats = sample.speed, 0.0, 0
            return None
        state.repeats += 1
        expected = self._acceleration(sample) * sample.dt
        if is_finite(expected):
            state.missing += expected
        if abs(state.missing) > _MAX_MISSING:
            return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, state.missing, _MAX_MISSING)
        if 0 < state.most < state.repeats:
            return Rejection(sample.stamp_ns, Reason.SPEED_STUCK, float(state.repeats), float(state.most))
        return None

    def _acceleration(self, sample: Sample) -> float:
        """Return the acceleration expected from the brake command, or from traction less resistance [m/s^2].

        It is NaN while the brake need not have followed the command yet.
        """
        if sample.brake_command < 0.0:
            return sample.brake_command if self.state.braked_s > self._followed_s else math.nan
        known = self._known
        resistance = davis(known.train_file.resistance, sample.speed) + known.track(sample)
        return (known.traction(max(sample.force_mean, 0.0), sample) - resistance) / known.inertia


def most_repeats(noise: SpeedNoise) -> int:
    """Return how often in a row a noisy speed may come again, 0 if any number is possible."""
    repeated = max(_EQUAL * noise.quantum / noise.std, 1.0 - noise.changed)
    if repeated >= _MOST_LIKELY or not noise.is_seen:
        return 0
    return max(_FEWEST, math.ceil(math.log(_NEVER) / math.log(repeated))) if repeated > 0.0 else _FEWEST
