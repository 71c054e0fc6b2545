# SPDX-License-Identifier: Apache-2.0
"""Brakings of a bag, with all that is known of their motion but the brake: what dead time, lag and rate are fitted to.

A braking begins some seconds before the command leaves zero, with the brake released, and ends at standstill, some
seconds after the command has returned to zero, or when the train pulls again.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason
from trainid_ros.stream.known_force import KnownForce, SpeedNoise

if TYPE_CHECKING:
    from collections import Counter

    from numpy.typing import NDArray

    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

# Time of a braking before the command leaves zero, and after it has returned to it, for a slow release [s].
_LEAD_S: Final = 4.0
_TAIL_S: Final = 10.0
_LONGEST_S: Final = 240.0  # A longer braking is cut [s]
_FEWEST: Final = 6  # Samples of the shortest braking
_PULLING: Final = 1.0  # Traction above this is no noise [N/kN]


@dataclass(frozen=True, slots=True)
class Braking:
    """One braking of n samples; accelerations are means since the sample before [m/s^2], shape (n,)."""

    time: Array  # Time since the first sample of all [s]
    speed: Array  # Measured speed [m/s]
    position: Array  # Position [m], NaN if unknown
    track: Array  # Deceleration by gradient and effects
    rolling: Array  # Deceleration by a + b v
    air: Array  # Deceleration by c v^2
    traction: Array  # Acceleration by the reported traction
    share: Array  # Share of the brake force left by the effects of the train file [1]
    direction: int  # +1 while positions rise, -1 while they fall
    noise_std: float  # Noise of the measured speed, rounding included [m/s]
    changes: tuple[tuple[float, float], ...]  # Command from a time on [s, m/s^2]; before the first it is 0


class BrakingCollector:
    """Collector of the brakings of one bag."""

    def __init__(self, train_file: TrainFile) -> None:
        self.train_file, self.brakings = train_file, list[Braking]()
        self._known, config = KnownForce(train_file), BrakeRateConfig()
        self._min_speed, self._quiet_s = config.min_speed, max(self._known.settling, _LEAD_S)
        self._noise = SpeedNoise.declared(config.speed_std, robust=True)
        self._rows, self._lead = list[tuple[float, ...]](), deque[tuple[float, ...]]()
        self._changes = list[tuple[float, float]]()
        self._origin_ns, self._active_s, self._direction = 0, -math.inf, 1

    def monitor(self, sample: Sample) -> None:
        """Follow the command without adding the sample."""
        if sample.brake_command < 0.0:
            self._active_s = self._time(sample.stamp_ns)

    def add(self, sample: Sample, rejected: Counter[Reason]) -> None:
        """Add one sample, or count the reason for its rejection."""
        now, command = self._time(sample.stamp_ns), sample.brake_command
        active = command < 0.0 or any(change.target_acceleration < 0.0 for change in sample.brake_changes)
        rejection = self._known.reject(sample)
        is_uncertain = sample.brake_gap or sample.emergency or math.isnan(command)
        if rejection is not None or is_uncertain:
            rejected[Reason.BRAKE_UNCERTAIN if rejection is None else rejection.reason] += 1
        lost = rejection is not None or is_uncertain or not math.isfinite(sample.dt)
        is_quiet = now - self._active_s >= self._quiet_s
        self._active_s = now if active or lost else self._active_s
        if lost or sample.speed < self._min_speed:
            self.end_piece()
            return
        self._noise.add(sample.speed, sample.dt)
        self._direction, row = sample.direction, self._row(sample, now)
        if active and not self._rows:
            self._rows = list(self._lead) if is_quiet and len(self._lead) > 1 else []
            self._lead.clear()
        if self._rows:
            self._changes += [(self._time(one.stamp_ns), one.target_acceleration) for one in sample.brake_changes]
            since, pulls = now - self._active_s, row[-2] * self._known.inertia > _PULLING
            if since > _TAIL_S or (since > 0.0 and pulls) or now - self._rows[0][0] > _LONGEST_S:
                self.end_piece()
            else:
                self._rows.append(row)
        elif is_quiet and not active:
            self._lead.append(row)
            while now - self._lead[0][0] > _LEAD_S:
                self._lead.popleft()

    def _time(self, stamp_ns: int) -> float:
        self._origin_ns = self._origin_ns or stamp_ns
        return (stamp_ns - self._origin_ns) / NS_PER_S

    def _row(self, sample: Sample, now: float) -> tuple[float, ...]:
        known, v, w = self._known, sample.speed, self.train_file.resistance
        # Of the reported force, what brakes is the brake's, whose force follows from the command.
        traction = max(0.0, known.traction(sample.force_mean, sample))
        forces = (known.track(sample), w.a + w.b * v, w.c * v * v, traction)
        return (now, v, sample.position, *(force / known.inertia for force in forces), known.brake_share(sample))

    def end_piece(self) -> None:
        """End the current braking, and keep it unless it is too short."""
        rows, changes = self._rows, tuple(self._changes)
        self._rows, self._changes = [], []
        self._lead.clear()
        if len(rows) >= _FEWEST and changes:
            noise = math.hypot(self._noise.std, self._noise.quantum / math.sqrt(12.0))
            time, speed, position, *forces, share = np.array(rows).T.copy()
            track, rolling, air, traction = forces
            self.brakings.append(
                Braking(time, speed, position, track, rolling, air, traction, share, self._direction, noise, changes)
            )
