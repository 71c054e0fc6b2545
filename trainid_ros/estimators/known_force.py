# SPDX-License-Identifier: Apache-2.0
"""The part of the specific balance that is known: traction, gradient and modelled effects."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.train.davis import G, specific_force, specific_inertia
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, resistance_terms
from trainid_ros.train.line import LineProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Brake force that stands for all where none acts [N/kN]: effects are nearly linear in it.
_SOME_BRAKE: Final = -1.0


class KnownForce:
    """Specific force without the running resistance, u = 1000 F/(M g) - i - w_extra [N/kN].

    With it the balance of the interface reads ``u - w(v) = inertia * dv/dt``. Effects of the train file count by
    their equivalent resistance at the sample; what they make of the brake is told by :meth:`brake_share`.
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
        """Return the weighed mass, or that of the train file [kg]."""
        return sample.mass if math.isfinite(sample.mass) else self.train_file.train.mass

    def traction(self, force: float, sample: Sample) -> float:
        """Return 1000 F/(M g) as reported [N/kN]."""
        return specific_force(force, self.mass(sample))

    def largest_force(self, sample: Sample) -> float:
        """Return the weight of the train [N]: no wheel transmits a force greater than its load."""
        return self.mass(sample) * G

    def is_possible(self, sample: Sample) -> bool:
        """Return False if no train could exert the reported force."""
        return not max(abs(sample.force_mean), abs(sample.force)) > self.largest_force(sample)

    def track(self, sample: Sample) -> float:
        """Return gradient and modelled extra resistance, mean since the previous sample [N/kN]."""
        return sample.gradient_mean + self.extra(sample)

    def extra(self, sample: Sample) -> float:
        """Return the resistance of the effects in the train file while no brake acts [N/kN]."""
        if not self._terms:
            return 0.0
        # Under the brake a negative force is that of the brake, else it is noise.
        pulls = sample.motion.brake >= BRAKE_APPLIED
        return self._sum(sample, sample.force_mean if pulls else max(0.0, sample.force_mean), 0.0)

    def brake_share(self, sample: Sample) -> float:
        """Return what effects of the train file leave of the brake: 0.9 under a fade by a tenth."""
        if not self._terms:
            return 1.0
        believed = self.train_file.brake.rate_at(sample.speed) * self.inertia * sample.motion.brake
        brake = min(believed, _SOME_BRAKE)
        # A train that brakes does not pull, and the force may be missing.
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
            # A delay of the brake belongs to its dead time, and what it was before is not looked up.
            brake_before=lambda _: brake,
            traction_before=lambda _: traction,
            gradient_ahead=self._gradient_ahead(sample),
        )

    def _gradient_ahead(self, sample: Sample) -> Callable[[float], float]:
        """Return the gradient of the map around the train; that at the train where the line is not known."""
        line, here, direction = self._line, sample.position, sample.direction
        if line is None or not math.isfinite(here):
            return lambda _: sample.gradient_mean
        offset = sample.gradient_mean - line.gradient(here, direction)
        return lambda ahead: offset + line.gradient(here + direction * ahead, direction)
