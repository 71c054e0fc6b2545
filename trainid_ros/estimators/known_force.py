# SPDX-License-Identifier: Apache-2.0
"""Known part of the specific force balance: traction, gradient and modelled effects."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.train.davis import G, specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, resistance_terms
from trainid_ros.train.line import LineProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Reference brake force where no brake acts [N/kN]: effects are nearly linear in it.
_REFERENCE_BRAKE: Final = -1.0


class KnownForce:
    """Specific force without the running resistance, u = 1000 F/(M g) - i - w_extra [N/kN].

    With it the balance of the interface reads ``u - w(v) = inertia * dv/dt``. Effects of the train file enter as
    their equivalent resistance at the sample; their influence on the brake is given by :meth:`brake_share`.
    """

    def __init__(self, train_file: TrainFile) -> None:
        self.train_file = train_file
        self._terms = resistance_terms(train_file.effects)
        known_line = self._terms and train_file.line.gradient
        self._line = LineProfile(train_file.line, train_file.train.length) if known_line else None

    @property
    def inertia(self) -> float:
        """1000 (1 + gamma) / g: specific force [N/kN] per acceleration [m/s^2]."""
        return specific_inertia(1.0, self.train_file.train.rotary_mass)

    def mass(self, sample: Sample) -> float:
        """Return the weighed mass, or that of the train file if there is none [kg]."""
        return sample.mass if math.isfinite(sample.mass) else self.train_file.train.mass

    def traction(self, force: float, sample: Sample) -> float:
        """Return 1000 F/(M g) [N/kN] of a reported force [N]."""
        return specific_force(force, self.mass(sample))

    def largest_force(self, sample: Sample) -> float:
        """Return the weight of the train [N]: no wheel can transmit a force greater than its load."""
        return self.mass(sample) * G

    def is_possible(self, sample: Sample) -> bool:
        """Return False if no train could exert the reported force."""
        return not max(abs(sample.force_mean), abs(sample.force)) > self.largest_force(sample)

    def track(self, sample: Sample) -> float:
        """Return the sum of gradient and modelled extra resistance, mean since the previous sample [N/kN]."""
        return sample.gradient_mean + self.extra(sample)

    def extra(self, sample: Sample) -> float:
        """Return the resistance of the train file's effects, evaluated without brake force [N/kN]."""
        if not self._terms:
            return 0.0
        # A negative force is braking effort while the brake is applied, else it is noise.
        released = sample.motion.brake >= BRAKE_APPLIED
        return self._sum(sample, sample.force_mean if released else max(0.0, sample.force_mean), 0.0)

    def brake_share(self, sample: Sample) -> float:
        """Return the share of the brake force left by the train file's effects [1]: 0.9 for a fade of 10 %."""
        if not self._terms:
            return 1.0
        nominal = self.train_file.brake.rate_at(sample.speed) * self.inertia * sample.motion.brake
        brake = min(nominal, _REFERENCE_BRAKE)
        # A braking train has no traction, and the force may be missing.
        return 1.0 - (self._sum(sample, 0.0, brake) - self._sum(sample, 0.0, 0.0)) / brake

    def _sum(self, sample: Sample, force: float, brake: float) -> float:
        point = self._point(sample, self.traction(force, sample), brake)
        return sum(term(self.train_file.resistance, point) for term in self._terms)

    def _point(self, sample: Sample, traction: float, brake: float) -> TrackPoint:
        motion = sample.motion
        return TrackPoint(
            time_s=motion.time_s,
            position=sample.position,
            direction=sample.direction,
            speed=sample.speed,
            curve_radius=1.0 / sample.curvature if sample.curvature > 0.0 else 0.0,
            tunnel=sample.tunnel,
            length=self.train_file.train.length,
            distance_run=motion.distance_run,
            since_release=motion.since_release,
            traction=traction,
            brake=brake,
            heat=motion.heat,
            # A delay of the brake is part of its dead time, so its earlier values are not looked up.
            brake_before=lambda _: brake,
            traction_before=lambda _: traction,
            gradient_ahead=self._gradient_ahead(sample),
        )

    def _gradient_ahead(self, sample: Sample) -> Callable[[float], float]:
        """Return the gradient [per mille] as a function of the distance ahead [m].

        The line profile gives its change from the measured gradient; without line or position it is constant.
        """
        line, here, direction = self._line, sample.position, sample.direction
        if line is None or not math.isfinite(here):
            return lambda _: sample.gradient_mean
        offset = sample.gradient_mean - line.gradient(here, direction)
        return lambda ahead: offset + line.gradient(here + direction * ahead, direction)
