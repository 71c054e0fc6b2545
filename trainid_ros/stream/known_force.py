# SPDX-License-Identifier: Apache-2.0
"""Known part of the force balance, samples that the running resistance is learned from, and noise of the speed.

The known part are traction, gradient and modelled effects. The resistance is learned from complete samples in motion
with the brake off, because the brake rate is itself unknown.

The noise is estimated from the measurements alone. Tachometers of trains differ by a factor of ten. Second differences
of equally spaced speeds contain the noise (with variance 6 sigma^2) and almost none of the motion, whose jerk is small.

They do not show the rounding error of a speed measured in coarse steps. While the train coasts, a speed in whole km/h
stays the same for seconds and then jumps. Its error has the variance q^2/12, but all samples between two jumps share
it, so together they count as one sample. Where every sample changes the speed the error is just as large, and
differences may not have revealed it yet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Final

from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, stored
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import BRAKE_APPLIED, TrackPoint, effect_value, resistance_terms
from trainid_ros.train.forces import STANDING, G, load_drag, specific_inertia
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import TrainFile

# Weight of a new square in the learned variance: a memory of 100 samples [1].
_WEIGHT: Final = 0.01
# Range of the learned standard deviation, as multiples of the declared one [1]: tachometers differ by a factor of ten.
_MIN_FACTOR: Final = 0.3
_MAX_FACTOR: Final = 10.0
# Limit of a second difference in learned standard deviations [1]: slip and outliers are not noise.
_MAX_Z: Final = 3.0
CAPPED_MEAN: Final = 0.51606
"""E min(z^2, 1) of a standard normal z: Huber's proposal 2."""
# Number of speeds in a second difference, and relative difference of their two steps that still counts as equal [1].
_POINTS: Final = 3
_MAX_UNEVENNESS: Final = 0.1
# Growth of the quantum, the smallest step seen, at each step [1]: one message may have been wrong.
_QUANTUM_GROWTH: Final = 1.01
# Limit of the quantum [m/s]: whole mph are 0.45 m/s, larger steps are slip or outliers.
_MAX_QUANTUM: Final = 0.5
# Weight of a new sample in the share of changed speeds: a memory of 25 samples [1].
_CHANGED_WEIGHT: Final = 0.04
# Lower limit of that share where it is used [1]: a speed constant for more than 50 samples is stuck.
_MIN_CHANGED: Final = 0.02


@dataclass(slots=True)
class SpeedNoise:
    """Noise of one speed measurement."""

    declared_std: float  # Declared standard deviation [m/s]
    learned: float  # Variance learned from second differences [(m/s)^2]
    # Whether each square is capped at its expectation (Huber's proposal 2) instead of at three standard deviations:
    # with 5 % gross errors the noise is then overestimated by 15 %, not tenfold
    robust: bool = False
    last: float = 0.0  # Last speed [m/s]
    before: float = 0.0  # Speed before the last [m/s]
    dt: float = stored(0.0, may_be_nan=True)  # Time between the two [s]
    count: int = 0  # Number of speeds since the last gap
    quantum: float = 0.0  # Step in which the speed is measured [m/s]
    changed: float = 1.0  # Share of samples in which the speed changed [1]
    squares: float = 1.0 / _WEIGHT  # Number of squares learned from, and of those that the declared variance counts for

    @classmethod
    def declared(cls, std: float, *, robust: bool = False, squares: float = 1.0 / _WEIGHT) -> SpeedNoise:
        """Return the noise with the declared standard deviation [m/s], which counts for so many squares."""
        return cls(std, std * std, robust, squares=squares)

    @property
    def variance(self) -> float:
        """Variance of one speed measurement [(m/s)^2]."""
        return self.learned if self.changed == 1.0 else max(self.learned, self.rounding)

    @property
    def std(self) -> float:
        """Standard deviation of one speed measurement [m/s]."""
        return math.sqrt(self.variance)

    @property
    def is_seen(self) -> bool:
        """True if the measurements show noise, as those of an ideal simulator do not."""
        low = _MIN_FACTOR * self.declared_std
        return self.learned > 2.0 * low * low

    @property
    def rounding(self) -> float:
        """Variance of the rounding of a single sample that gives all of them together their true weight [(m/s)^2]."""
        if self.changed == 1.0:  # no speed was repeated: the steps are those of an accelerating train
            return 0.0
        return self.quantum * self.quantum / 12.0 / max(self.changed, _MIN_CHANGED)

    def add(self, speed: float, dt: float) -> None:
        """Add one more speed [m/s], measured ``dt`` [s] after the last one; NaN after a gap."""
        before, last, last_dt = self.before, self.last, self.dt
        self.before, self.last, self.dt = last, speed, dt
        self.count = 1 if math.isnan(dt) else self.count + 1
        if self.count > 1:
            self._add_step(speed, abs(speed - last))
        if self.count < _POINTS or abs(dt - last_dt) > _MAX_UNEVENNESS * dt:
            return
        second = speed - 2.0 * last + before
        square = second * second / 6.0
        most = self.learned if self.robust else _MAX_Z * _MAX_Z * self.learned
        low, high = _MIN_FACTOR * self.declared_std, _MAX_FACTOR * self.declared_std
        # One that is capped shows only that the noise is larger.
        self.squares += 1.0 if square < most else 0.0
        weight = max(_WEIGHT, 1.0 / self.squares)
        square = min(square, most) / (CAPPED_MEAN if self.robust else 1.0)
        self.learned = min(max(self.learned + weight * (square - self.learned), low * low), high * high)

    def _add_step(self, speed: float, step: float) -> None:
        """Learn the quantum from a step [m/s] between two consecutive speeds that ends at ``speed`` [m/s]."""
        if speed < STANDING:
            return
        if step == 0.0:
            self.changed = (1.0 - _CHANGED_WEIGHT) * self.changed
            return
        if step <= _MAX_QUANTUM:
            self.quantum = min(_QUANTUM_GROWTH * self.quantum if self.quantum > 0.0 else _MAX_QUANTUM, step)
        self.changed += _CHANGED_WEIGHT * (1.0 - self.changed)


# Braking force at which effects are evaluated where no brake acts [N/kN]: they are nearly linear in it.
_REFERENCE_BRAKE: Final = -1.0
# Time constants until a released brake is certainly off [1]: exp(-8) = 0.03 % of its force are left.
_SETTLING: Final = 8.0


class KnownForce:
    """Specific force without the running resistance, u = 1000 F/(M g0) - i - w_extra [N/kN].

    With it the balance of the interface reads ``u - w(v) = inertia * dv/dt``. Effects of the train file enter as
    their equivalent resistance at the sample; their influence on the brake is given by :meth:`brake_share`.
    """

    def __init__(self, train_file: TrainFile) -> None:
        self.train_file = train_file
        self.inertia = specific_inertia(1.0, train_file.train.rotary_mass)
        """1000 (1 + gamma) / g0: specific force [N/kN] per acceleration [m/s^2]."""
        extra_delay = effect_value(train_file.effects, 'brake_delay', 'extra', 0.0)
        self.brake = replace(train_file.brake, delay=train_file.brake.delay + extra_delay)
        """Brake with the dead time that the effects of the train file add."""
        self.settling = self.brake.delay + _SETTLING * self.brake.time_constant
        """Time after the release of the brake until it is certainly off [s]."""
        self._mass = train_file.train.mass
        self._terms = resistance_terms(train_file.effects)
        self._by_weight = train_file.c_of_load
        self._has_extra = bool(self._terms) or self._by_weight > 0.0
        known_line = self._terms and train_file.line.gradient
        self._line = profile_of(train_file) if known_line else None
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
        return self._mass if math.isnan(sample.mass) else sample.mass

    def traction(self, force: float, sample: Sample) -> float:
        """Return 1000 F/(M g0) [N/kN] of a reported force [N]."""
        mass = self._mass if math.isnan(sample.mass) else sample.mass
        return force * (1000.0 / (mass * G))

    def reject(self, sample: Sample) -> Rejection | None:
        """Return a rejection if force or gradient is missing, or if no train could exert the force; else None."""
        stamp_ns, force = sample.stamp_ns, sample.force_mean
        if math.isnan(force):
            return Rejection(stamp_ns, Reason.FORCE_MISSING, force, math.nan)
        # No wheel can transmit a force greater than its load, so no train one greater than its weight [N].
        weight = self.mass(sample) * G
        if max(abs(force), abs(sample.force)) > weight:
            return Rejection(stamp_ns, Reason.OUT_OF_RANGE, force, weight)
        if math.isnan(sample.gradient_mean):
            return Rejection(stamp_ns, Reason.GRADIENT_MISSING, sample.gradient_mean, math.nan)
        return None

    def track(self, sample: Sample) -> float:
        """Return the sum of gradient and modelled extra resistance, mean since the previous sample [N/kN]."""
        return sample.gradient_mean + (self.extra(sample) if self._has_extra else 0.0)

    def extra(self, sample: Sample) -> float:
        """Return the resistance of the train file's effects, evaluated without brake force, and of the load [N/kN]."""
        if not self._has_extra:
            return 0.0
        if not math.isnan(sample.extra):
            return sample.extra
        force = sample.force_mean
        # A negative force is braking effort while the brake is applied, else it is noise. It may be missing.
        if not is_finite(force) or (force < 0.0 and sample.motion.brake < BRAKE_APPLIED):
            force = 0.0
        self._go_to(sample)
        load = load_drag(self._by_weight, self._mass, sample.mass, sample.speed)
        return self._sum(self.traction(force, sample), 0.0) + load

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
        point.run = motion.run
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


# Specific force below which the brake is requested [N/kN]: noise while coasting stays above, braking is far below.
_BRAKE_FORCE: Final = -1.5


class Admission:
    """Admits or rejects samples one by one.

    Attributes:
        known: Known part of the force balance.
        min_speed: Slowest speed admitted [m/s].
        braked_ns: Last stamp at which braking was requested [ns], 0 if never.
    """

    STATE: ClassVar[State] = declare('braked_ns')

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
