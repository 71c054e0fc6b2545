# SPDX-License-Identifier: Apache-2.0
"""Motion model of the train over one sample, with the effect of each error of the train file.

With the brake's lagged target y, its integral s over the sample and k = g / (1000 (1 + gamma)), the inverse of the
specific inertia,

    v' - v = f r s + gain_e e + T dt - k (i + w(v)) dt,

where r is the brake rate by the table and the effects of the train file, and the errors e act with the gains

    gain_e = [r ds/dT, r ds/dtau, -k (a + b v) dt, -k c v^2 dt, T dt, r s p(v), r s m(v), -dt].

p rises from -1/2 at rest to 1/2 at full speed; m is 1 at the speed at which electric and friction brakes change over,
0 at rest and at twice that speed. The last error is that of the brake at its level, because valves act in steps.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.posterior import ERRORS, Errors, Transition
from trainid_ros.scalars import is_finite
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.train.effects import effect_value
from trainid_ros.vectors import vec

if TYPE_CHECKING:
    from trainid_ros.brake_rate.brake_kinematics import BrakeStep
    from trainid_ros.brake_rate.brake_rate_settings import BrakeRateConfig
    from trainid_ros.brake_rate.timing import TimingStep
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import Brake, TrainFile

LEAST_RATE: Final = 0.05
"""Lower limit of a brake rate that is used as a divisor."""
BLEND_SHAPE: Final = 0.7
"""Error of the shape of the changeover between brakes, as a share of its size."""
# Timing jitter of brake changes per relative error of the timing [s].
_JITTER_S: Final = 0.4
# Variation between changeovers, as a share of their size.
_BLEND_VARIES: Final = 0.5
# Correlation times of the errors of dead time, lag, slope and changeover, and of resistance and traction [s].
_LONG_S: Final = 1e5
_SHORT_S: Final = 1800.0
# Below this speed the published brake rate is that of the next braking, at medium speed [m/s].
_STOPPING: Final = 1.0
# Relative change of the response per second at which its steadiness is 1/e [1/s].
_CHANGING: Final = 0.1
# Correlation time of the variation between changeovers [s].
_BLEND_S: Final = 1.0
# Smallest brake level with a level error [m/s^2].
_LEVEL: Final = 0.08


class MotionModel:
    """Train and line according to the train file, with the standard deviations of their errors."""

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig) -> None:
        self.brake = true_brake(train_file)
        self.known = KnownForce(_with_true_brake(train_file))
        self.inertia = self.known.inertia
        self._train_file, self._config, self._resistance = train_file, config, train_file.resistance
        self.max_speed, self._timing_std = train_file.train.max_speed, train_file.brake.timing_std
        # Settings that each sample needs.
        self._length, self._white = config.disturbance_length, config.acceleration_noise**2
        self._force_error, self._least = config.force_error, config.min_braking
        self._blend_speed, self._blend_std, self._level_length = (
            config.blend_speed, config.blend_std, config.level_length
        )  # fmt: skip
        self.stds = self._error_stds()
        self._stds, self._share = vec[float](self.stds), vec[float]([0.0] * ERRORS)
        self._interval = Transition(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def disturbance_std(self) -> float:
        """Standard deviation of the unmodelled acceleration, including the map error [m/s^2]."""
        return math.hypot(self._config.disturbance_std, self._train_file.line.gradient_std / self.inertia)

    @property
    def timing_stds(self) -> tuple[float, float]:
        """Standard deviations of the errors of dead time and lag [s]."""
        # Relative to the delay stated in the file, because the effect brake_delay was measured.
        return self._train_file.brake.timing_stds

    def _error_stds(self) -> Errors:
        """Return the standard deviations of the errors of the train file; units as in :class:`Transition`."""
        config, train = self._config, self._train_file.train
        delay, lag = self.timing_stds
        timing = (self.brake.rate * delay, self.brake.rate * lag)
        force = math.hypot(train.mass_std, train.force_std)
        resistance, speed = (config.resistance_std, config.resistance_std), (config.slope_std, config.blend_std)
        return (*timing, *resistance, force, *speed, config.level_std)

    def gain(self, sample: Sample) -> float:
        """Return the brake rate by the table and the effects of the train file for f = 1 [1]."""
        return max(self.known.brake_share(sample) * self.brake.shape_at(sample.speed), LEAST_RATE)

    def traction(self, sample: Sample, nominal: float, *, released: bool) -> float:
        """Return the acceleration by traction [m/s^2].

        The reported force is that of traction minus the force of a nominal brake.

        Args:
            sample: The sample.
            nominal: Integral of the brake target over it [m/s].
            released: Whether the brake is released after its dead time, so that traction may have begun unseen.

        """
        force = self.known.traction(sample.force_mean, sample) / self.inertia
        if sample.brake_command >= 0.0 and (released or force > 0.0):
            force -= nominal / sample.dt
        return force if force > 0.0 else 0.0

    def interval(
        self,
        sample: Sample,
        motion: BrakeStep,
        timing: TimingStep,
        *,
        rate: float,
        before: float,
        gain: float,
        variance: float,
        released: bool,
    ) -> Transition:
        """Return the motion model since the last sample, valid until the next call; missing forces count as zero.

        Args:
            sample: The sample.
            motion: Response of the brake.
            timing: Its sensitivity to dead time and lag.
            rate: Estimated brake rate [1].
            before: :meth:`gain` at the last sample [1].
            gain: The same at this one [1].
            variance: Variance of the disturbance [(m/s^2)^2].
            released: Whether the brake is released.

        """
        step, dt, v, w = self._interval, sample.dt, sample.speed, self._resistance
        nominal = motion.reach * motion.start_target + motion.gain_v
        traction = self.traction(sample, nominal, released=released)
        rolling, air = (w.a + w.b * v) / self.inertia, w.c * v * v / self.inertia
        known = (traction - self.known.track(sample) / self.inertia - rolling - air) * dt
        rho = math.exp(-v * dt / self._length)
        uncertain = self._force_error * traction
        slack = self._white + uncertain * uncertain
        # The response scales with the gain of the table: a was computed with the gain at the last sample.
        step.dt = dt
        step.reach, step.decay = motion.reach * gain / before, motion.decay * gain / before
        step.gain_v, step.gain_a = gain * motion.gain_v, gain * motion.gain_a
        step.rho, step.known = rho, known if is_finite(known) else 0.0
        step.q_v = slack * dt + rate * rate * self._timing_variance(motion, timing, dt, v)
        step.q_b = variance * (1.0 - rho * rho)
        gain_e, braked = step.gain_e, gain * nominal
        gain_e[0], gain_e[1] = gain * timing.delay_gain, gain * timing.lag_gain
        gain_e[2], gain_e[3], gain_e[4] = -rolling * dt, -air * dt, traction * dt
        gain_e[5], gain_e[6] = braked * self._slope(v), braked * self._changeover(v)
        gain_e[7] = -dt if motion.end_target <= -_LEVEL else 0.0
        self.forget(dt, motion.end_target - motion.start_target, step.decay_e, step.q_e)
        step.steadiness = self._steadiness(motion, dt)
        return step

    def _timing_variance(self, motion: BrakeStep, timing: TimingStep, dt: float, v: float) -> float:
        """Return the variance of speed due to timing and variation between changeovers, for f = 1 [(m/s)^2]."""
        level = motion.end_target
        early = _JITTER_S * self._timing_std * (level - motion.start_target)
        blend = _BLEND_VARIES * self._blend_std * self._changeover(v) * level
        return timing.variance + early * early + 2.0 * _BLEND_S * dt * blend * blend

    def _steadiness(self, motion: BrakeStep, dt: float) -> float:
        """Return the steadiness of the response: 1 while it is constant, towards 0 while it changes."""
        change = abs(motion.end_target - motion.start_target)
        if change == 0.0:
            return 1.0
        slow = dt * max(abs(motion.end_target), self._least) * _CHANGING
        return math.exp(-change / slow) if slow > 0.0 else 0.0

    def _slope(self, speed: float) -> float:
        """Return p, see the module; above the maximum speed it stays constant."""
        return min(speed / self.max_speed, 1.0) - 0.5

    def _changeover(self, speed: float) -> float:
        """Return m, see the module."""
        return max(0.0, 1.0 - abs(speed / self._blend_speed - 1.0))

    def share(self, sample: Sample, level: float) -> vec[float]:
        """Return the shares of the errors in the brake rate at a speed and level [m/s^2, >= 0], shape (8,).

        They are valid until the next call. At the end of a braking they are zero, which gives the brake rate at medium
        speed, for the next braking.
        """
        share = self._share
        share[5] = share[6] = share[7] = 0.0
        if sample.brake_command < 0.0 and sample.speed >= _STOPPING:
            share[5], share[6] = self._slope(sample.speed), self._changeover(sample.speed)
            share[7] = 1.0 / level if level >= _LEVEL else 0.0
        return share

    def forget(self, elapsed: float, change: float, decay_e: vec[float], q_e: vec[float]) -> None:
        """Write the decay of the errors over a time [s] and a change of level [m/s^2], and the variances added."""
        slow, fast = math.exp(-elapsed / _LONG_S), math.exp(-elapsed / _SHORT_S)
        decay_e[0] = decay_e[1] = decay_e[5] = decay_e[6] = slow
        decay_e[2] = decay_e[3] = decay_e[4] = fast
        decay_e[7] = math.exp(-abs(change) / self._level_length)
        for j in range(ERRORS):
            q_e[j] = (1.0 - decay_e[j] * decay_e[j]) * self._stds[j] * self._stds[j]


def true_brake(train_file: TrainFile) -> Brake:
    """Return the brake with the effects of the train file applied (brake_scale, brake_delay)."""
    brake, effects = train_file.brake, train_file.effects
    rate = brake.rate * effect_value(effects, 'brake_scale', 'ratio', 1.0)
    return replace(brake, rate=rate, delay=brake.delay + effect_value(effects, 'brake_delay', 'extra', 0.0))


def _with_true_brake(train_file: TrainFile) -> TrainFile:
    """Return the train file with brake_scale applied to the brake and removed from the effects."""
    effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
    return replace(train_file, brake=true_brake(train_file), effects=effects)
