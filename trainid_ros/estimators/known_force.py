# SPDX-License-Identifier: Apache-2.0
"""The part of the specific balance that is known: traction, gradient and modelled effects."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from trainid_ros.physics.effects import TrackPoint, effect_value, resistance_terms
from trainid_ros.physics.resistance import specific_force, specific_inertia

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.physics.train_file import TrainFile


class KnownForce:
    """Specific force without the running resistance, u = 1000 F/(M g) - i - w_extra [N/kN].

    With it the balance of the interface reads ``u - w(v) = inertia * dv/dt``. Effects of the train file
    that are a resistance count, and so do mass_error and traction_scale.
    """

    def __init__(self, train_file: TrainFile) -> None:
        self.train_file = train_file
        self._terms = resistance_terms(train_file.effects)
        self._mass_ratio = effect_value(train_file.effects, 'mass_error', 'ratio', 1.0)
        self._traction_ratio = effect_value(train_file.effects, 'traction_scale', 'ratio', 1.0)

    @property
    def inertia(self) -> float:
        """1000 (1 + gamma) / g: specific force [N/kN] per acceleration [m/s^2]."""
        return specific_inertia(1.0, self.train_file.train.rotary_mass)

    def mass(self, sample: Sample) -> float:
        """Return the weighed mass, or that of the train file [kg]."""
        believed = sample.mass if math.isfinite(sample.mass) else self.train_file.train.mass
        return self._mass_ratio * believed

    def traction(self, force: float, sample: Sample) -> float:
        """Return 1000 F/(M g) [N/kN]."""
        return specific_force(self._traction_ratio * force, self.mass(sample))

    def track(self, sample: Sample) -> float:
        """Return gradient and modelled extra resistance, mean since the previous sample [N/kN]."""
        return sample.gradient_mean + self.extra(sample)

    def extra(self, sample: Sample) -> float:
        """Return the resistance of the effects in the train file [N/kN]."""
        if not self._terms:
            return 0.0
        # Effects that set in at some time or wear off with distance: taken as set in, and as worn off.
        point = TrackPoint(
            time_s=math.inf,
            position=sample.position,
            direction=sample.direction,
            speed=sample.speed,
            curve_radius=sample.curve_radius,
            tunnel=sample.tunnel,
            length=self.train_file.train.length,
            distance_run=math.inf,
        )
        return sum(term(self.train_file.resistance, point) for term in self._terms)
