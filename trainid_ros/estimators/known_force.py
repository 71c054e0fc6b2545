# SPDX-License-Identifier: Apache-2.0
"""Known part of the specific force balance: traction, gradient and modelled effects."""

from __future__ import annotations

import math
from typing import Final

from trainid_ros.results import Reason, Rejection
from trainid_ros.scalars import is_finite
from trainid_ros.stream.samples import Sample
from trainid_ros.train.davis import G, specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, effect_value, resistance_terms
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import TrainFile

# Reference brake force where no brake acts [N/kN]: effects are nearly linear in it.
_REFERENCE_BRAKE: Final = -1.0

# After this many time constants a released brake is below 0.04 % of its initial force.
_SETTLING: Final = 8.0


class KnownForce:
    """Specific force without the running resistance, u = 1000 F/(M g) - i - w_extra [N/kN].

    With it the balance of the interface reads ``u - w(v) = inertia * dv/dt``. Effects of the train file enter as
    their equivalent resistance at the sample; their influence on the brake is given by :meth:`brake_share`.
    """

    def __init__(self, train_file: TrainFile) -> None:
        self.train_file = train_file
        self.inertia = specific_inertia(1.0, train_file.train.rotary_mass)
        """1000 (1 + gamma) / g: specific force [N/kN] per acceleration [m/s^2]."""
        brake = train_file.brake
        self.brake_delay = brake.delay + effect_value(train_file.effects, 'brake_delay', 'extra', 0.0)
        """Dead time of the brake, with the effects of the train file [s]."""
        self.settling = self.brake_delay + _SETTLING * brake.time_constant
        """Time after the release of the brake until it is certainly off [s]."""
        self._mass = train_file.train.mass
        self._terms = resistance_terms(train_file.effects)
        known_line = self._terms and train_file.line.gradient
        self._line = LineProfile(train_file.line, train_file.train.length) if known_line else None
        self._point = TrackPoint(
            time_s=0.0,
            position=math.nan,
            direction=1,
            speed=0.0,
            length=train_file.train.length,
            # A delay of the brake is part of its dead time, so its earlier values are not looked up.
            brake_before=lambda _: self._point.brake,
            traction_before=lambda _: self._point.traction,
            gradient_ahead=self._gradient_ahead,
        )
        self._gradient = 0.0

    def mass(self, sample: Sample) -> float:
        """Return the weighed mass, or that of the train file if there is none [kg]."""
        return sample.mass if is_finite(sample.mass) else self._mass

    def traction(self, force: float, sample: Sample) -> float:
        """Return 1000 F/(M g) [N/kN] of a reported force [N]."""
        return specific_force(force, self.mass(sample))

    def reject(self, sample: Sample) -> Rejection | None:
        """Return a rejection if force or gradient is missing, or if no train could exert the force; else None."""
        stamp_ns, force = sample.stamp_ns, sample.force_mean
        if not is_finite(force):
            return Rejection(stamp_ns, Reason.FORCE_MISSING, force, math.nan)
        # No wheel can transmit a force greater than its load, so no train one greater than its weight [N].
        weight = self.mass(sample) * G
        if max(abs(force), abs(sample.force)) > weight:
            return Rejection(stamp_ns, Reason.OUT_OF_RANGE, force, weight)
        if not is_finite(sample.gradient_mean):
            return Rejection(stamp_ns, Reason.GRADIENT_MISSING, sample.gradient_mean, math.nan)
        return None

    def track(self, sample: Sample) -> float:
        """Return the sum of gradient and modelled extra resistance, mean since the previous sample [N/kN]."""
        return sample.gradient_mean + self.extra(sample)

    def extra(self, sample: Sample) -> float:
        """Return the resistance of the train file's effects, evaluated without brake force [N/kN]."""
        if not self._terms:
            return 0.0
        if not math.isnan(sample.extra):
            return sample.extra
        force = sample.force_mean
        # A negative force is braking effort while the brake is applied, else it is noise. It may be missing.
        if not is_finite(force) or (force < 0.0 and sample.motion.brake < BRAKE_APPLIED):
            force = 0.0
        self._go_to(sample)
        return self._sum(self.traction(force, sample), 0.0)

    def brake_share(self, sample: Sample) -> float:
        """Return the share of the brake force left by the train file's effects [1]: 0.9 for a fade of 10 %."""
        if not self._terms:
            return 1.0
        nominal = self.train_file.brake.rate_at(sample.speed) * self.inertia * sample.motion.brake
        brake = min(nominal, _REFERENCE_BRAKE)
        # A braking train has no traction, and the force may be missing.
        self._go_to(sample)
        return 1.0 - (self._sum(0.0, brake) - self._sum(0.0, 0.0)) / brake

    def _sum(self, traction: float, brake: float) -> float:
        """Return the sum of all effects with a traction and a braking force [N/kN]."""
        point, total = self._point, 0.0
        point.traction, point.brake = traction, brake
        for term in self._terms:
            total += term(self.train_file.resistance, point)
        return total

    def _go_to(self, sample: Sample) -> None:
        """Move the point at which the effects are evaluated."""
        point, motion, curvature = self._point, sample.motion, sample.curvature
        point.time_s = motion.time_s
        point.position = sample.position
        point.direction = sample.direction
        point.speed = sample.speed
        point.curve_radius = 1.0 / curvature if curvature > 0.0 else 0.0
        point.tunnel = sample.tunnel
        point.distance_run = motion.distance_run
        point.since_release = motion.since_release
        point.heat = motion.heat
        self._gradient = sample.gradient_mean

    def _gradient_ahead(self, distance: float) -> float:
        """Return the gradient a distance [m] ahead [per mille].

        The line profile gives its change from the measured gradient; without line or position it is constant.
        """
        line, here, direction = self._line, self._point.position, self._point.direction
        if line is None or not is_finite(here):
            return self._gradient
        offset = self._gradient - line.gradient(here, direction)
        return offset + line.gradient(here + direction * distance, direction)
