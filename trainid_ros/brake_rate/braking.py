# SPDX-License-Identifier: Apache-2.0
"""Brakings of a bag, with all that is known of their motion but the brake: what dead time, lag and rate are fitted to.

A braking begins some seconds before the command leaves zero, with the brake released, and ends at standstill, some
seconds after the command has returned to zero, or when the train pulls again. The train file's brake decides nothing
else, since it may be wrong.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.known_force import KnownForce, SpeedNoise
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

# Time of a braking before the command leaves zero, and after it has returned to it [s]; the latter covers a release
# that is some seconds later than the train file says.
_LEAD_S: Final = 4.0
_TAIL_S: Final = 10.0
# Longest braking [s]: a longer one goes on without its first response, and is cut.
_LONGEST_S: Final = 240.0
# Fewest samples of a braking.
_FEWEST: Final = 6
# Traction above this ends a braking whose command has returned to zero [N/kN]; less is noise.
_PULLING: Final = 1.0


@dataclass(frozen=True, slots=True)
class Braking:
    """One braking of n samples; accelerations are means since the previous sample [m/s^2], those of row 0 unused."""

    bag: int  # Number of the bag
    time: Array  # Time since the first sample of the bag [s], shape (n,)
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
    """Collects the brakings of one bag into ``runs``; ``origin_ns`` is the stamp at which times are zero."""

    def __init__(self, train_file: TrainFile, bag: int = 0, origin_ns: int = 0) -> None:
        self.origin_ns, self.runs = origin_ns, list[Braking]()
        self._known, self._bag, config = KnownForce(train_file), bag, BrakeRateConfig()
        self._min_speed = config.min_speed
        self._quiet_s = max(self._known.settling, _LEAD_S)
        self._noise = SpeedNoise.declared(config.speed_std, robust=True)
        self._rows, self._lead = list[tuple[float, ...]](), deque[tuple[float, ...]]()
        self._changes, self._active_s, self._last_ns, self._direction = list[tuple[float, float]](), -math.inf, 0, 1

    def add(self, sample: Sample) -> None:
        """Add one sample."""
        self.origin_ns = self.origin_ns or sample.stamp_ns
        now = (sample.stamp_ns - self.origin_ns) / NS_PER_S
        known = (sample.dt, sample.force_mean, sample.gradient_mean, sample.brake_command)
        active = any(change.target_acceleration < 0.0 for change in sample.brake_changes) or sample.brake_command < 0.0
        usable = all(map(math.isfinite, known)) and not (sample.brake_gap or sample.emergency)
        if not usable or sample.speed < self._min_speed:
            self.end_run()
            self._active_s = now if active or not usable else self._active_s
            return
        self._noise.add(sample.speed, sample.dt)
        is_quiet = now - self._active_s >= self._quiet_s
        row = self._row(sample, now)
        pulls = row[-2] * self._known.inertia > _PULLING
        if active and not self._rows:
            self._rows = list(self._lead) if is_quiet and len(self._lead) > 1 else []
            self._lead.clear()
        if self._rows:
            after = [c for c in sample.brake_changes if not self._changes or c.stamp_ns > self._last_ns]
            self._changes += [((c.stamp_ns - self.origin_ns) / NS_PER_S, c.target_acceleration) for c in after]
            self._last_ns, self._direction = sample.stamp_ns, sample.direction
            since_release = 0.0 if active else now - self._active_s
            if since_release > _TAIL_S or (since_release > 0.0 and pulls) or now - self._rows[0][0] > _LONGEST_S:
                self.end_run()
            else:
                self._rows.append(row)
        elif is_quiet and not active:
            self._lead.append(row)
            while now - self._lead[0][0] > _LEAD_S:
                self._lead.popleft()
        if active:
            self._active_s = now

    def start_over(self) -> None:
        """End the current braking and forget the history of the drive, as after a jump of the stamps."""
        self.end_run()
        self._active_s, self._last_ns = -math.inf, 0

    def _row(self, sample: Sample, now: float) -> tuple[float, ...]:
        known, w = self._known, self._known.train_file.resistance
        rolling = davis(Davis(w.a, w.b, 0.0), sample.speed)
        air = w.c * sample.speed * sample.speed
        # Of the reported force, what brakes is the brake's, whose force follows from the command.
        traction = max(0.0, known.traction(sample.force_mean, sample))
        forces = (known.track(sample), rolling, air, traction)
        motion = (now, sample.speed, sample.position)
        return (*motion, *(force / known.inertia for force in forces), known.brake_share(sample))

    def end_run(self) -> None:
        """End the current braking, and keep it if the brake was applied for long enough."""
        rows, changes = self._rows, self._changes
        self._rows, self._changes = [], []
        self._lead.clear()
        if len(rows) < _FEWEST or not changes:
            return
        columns = np.array(rows).T.copy()
        noise = math.hypot(self._noise.std, self._noise.quantum / math.sqrt(12.0))
        self.runs.append(Braking(self._bag, *columns, self._direction, noise, tuple(changes)))
