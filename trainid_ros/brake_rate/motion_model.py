# SPDX-License-Identifier: Apache-2.0
"""What moves a train over one sample, and by how much each error of the train file adds to it.

With the brake's lagged target y, its integral s over the sample and the inertia k = 1000 (1 + gamma) / g,

    v' - v = f r s + lean e + T dt - (i + w(v)) dt / k,

where r is the brake rate that table and effects of the train file give, and the errors e act by

    lean = [r ds/dT, r ds/dtau, -(a + b v) dt / k, -c v^2 dt / k, T dt, r s p(v), r s m(v), -dt].

p runs from -1/2 at rest to 1/2 at full speed, m is 1 where electric and friction brakes change over, 0 at rest and at
twice that speed. The last error is that of the brake at its level: valves act in steps.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.brake_rate.posterior import ERRORS, Errors, Transition, errors_of
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.train.effects import effect_value

if TYPE_CHECKING:
    from trainid_ros.brake_rate.brake_kinematics import BrakeStep
    from trainid_ros.brake_rate.config import BrakeRateConfig
    from trainid_ros.brake_rate.posterior import Array
    from trainid_ros.brake_rate.timing import TimingStep
    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import Brake, TrainFile

LEAST_RATE: Final = 0.05
"""A brake whose rate is smaller is taken for one of this rate where it is divided by."""
BLEND_SHAPE: Final = 0.7
"""Error of the shape of the changeover between brakes, as a share of the changeover."""
# A short dead time or lag is known as well, relatively, as one of so many seconds.
_LEAST_DELAY_S: Final = 0.67
_LEAST_LAG_S: Final = 0.25
# Changes of the brake come early or late by this, times the relative error of its timing [s].
_JITTER_S: Final = 0.4
# What one changeover differs from another, as such a share.
_BLEND_VARIES: Final = 0.5
# How fast errors of dead time, lag, resistance (twice), traction, slope and changeover are forgotten [s].
_MEMORIES_S: Final = (1e5, 1e5, 1800.0, 1800.0, 1800.0, 1e5, 1e5)
# Slower than this the brake rate published is that of the next braking, at middle speed [m/s].
_STOPPING: Final = 1.0
# A response changes while it moves by this share of itself in a second [1/s].
_CHANGING: Final = 0.1
# Errors of the changeover between brakes last as long [s].
_BLEND_S: Final = 1.0
# The level of the brake counts from here on [m/s^2].
_LEVEL: Final = 0.08


class MotionModel:
    """Train and line as the train file has them, with the standard deviations of their errors."""

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig) -> None:
        self.brake = true_brake(train_file)
        self.known = KnownForce(_with_true_brake(train_file))
        self._train_file, self._config = train_file, config
        self.stds = self._error_stds()

    @property
    def inertia(self) -> float:
        """Specific force per acceleration [N/kN per m/s^2]."""
        return self.known.inertia

    @property
    def disturbance_std(self) -> float:
        """Standard deviation of unmodelled acceleration, the error of the map included [m/s^2]."""
        return math.hypot(self._config.disturbance_std, self._train_file.line.gradient_std / self.inertia)

    @property
    def timing_stds(self) -> tuple[float, float]:
        """Standard deviations of the errors of dead time and lag [s]."""
        # An effect brake_delay was measured; what the file itself states was not.
        stated = self._train_file.brake
        dead_time = stated.timing_std * math.hypot(stated.delay, _LEAST_DELAY_S)
        return dead_time, stated.timing_std * math.hypot(stated.time_constant, _LEAST_LAG_S)

    def _error_stds(self) -> Errors:
        """Return the standard deviations of the errors of the train file."""
        config, train = self._config, self._train_file.train
        delay, lag = self.timing_stds
        timing = (self.brake.rate * delay, self.brake.rate * lag)
        force = math.hypot(train.mass_std, train.force_std)
        resistance, speed = (config.resistance_std, config.resistance_std), (config.slope_std, config.blend_std)
        return (*timing, *resistance, force, *speed, config.level_std)

    def gain(self, sample: Sample) -> float:
        """Return the brake rate that table and effects of the train file give at f = 1."""
        return max(self.known.brake_share(sample) * self.brake.shape_at(sample.speed), LEAST_RATE)

    def traction(self, sample: Sample, nominal: float, *, released: bool) -> float:
        """Return the acceleration by traction [m/s^2].

        The reported force is that of traction less the effort of a nominal brake.

        Args:
            sample: The sample.
            nominal: Integral of the brake's target over it [m/s].
            released: The brake lets go, and traction may have begun.

        """
        force = self.known.traction(sample.force_mean, sample) / self.inertia
        if force <= 0.0 and released and sample.brake_command >= 0.0:
            force -= nominal / sample.dt
        return force if force > 0.0 else 0.0

    def interval(
        self,
        sample: Sample,
        motion: BrakeStep,
        timing: TimingStep,
        *,
        rate: float,
        gains: tuple[float, float],
        variance: float,
        released: bool,
    ) -> Transition:
        """Return what moved the train since the last sample; what is not known counts as nothing.

        Args:
            sample: The sample.
            motion: Response of the brake.
            timing: How it changes with dead time and lag.
            rate: Brake rate as estimated.
            gains: :meth:`gain` before and now.
            variance: That of the disturbance [(m/s^2)^2].
            released: The brake lets go.

        """
        config, dt, v, (before, gain) = self._config, sample.dt, sample.speed, gains
        nominal = motion.reach * motion.start_target + motion.gain_v
        traction = self.traction(sample, nominal, released=released)
        w = self._train_file.resistance
        rolling, air = (w.a + w.b * v) / self.inertia, w.c * v * v / self.inertia
        known = (traction - self.known.track(sample) / self.inertia - rolling - air) * dt
        rho = math.exp(-v * dt / config.disturbance_length)
        keep, q_e = self.forget(dt, motion.end_target - motion.start_target)
        slack = config.acceleration_noise**2 + (config.force_error * traction) ** 2
        # The response of the brake keeps its place on the table: a was left by the gain before.
        return Transition(
            dt=dt,
            reach=motion.reach * gain / before,
            decay=motion.decay * gain / before,
            gain_v=gain * motion.gain_v,
            gain_a=gain * motion.gain_a,
            rho=rho,
            known=known if math.isfinite(known) else 0.0,
            q_v=slack * dt + rate * rate * self._late(motion, timing, dt, v),
            q_b=variance * (1.0 - rho * rho),
            lean=(
                gain * timing.lean_delay,
                gain * timing.lean_lag,
                -rolling * dt,
                -air * dt,
                traction * dt,
                *self._brake_lean(gain * nominal, v, motion.end_target, dt),
            ),
            keep=keep,
            q_e=q_e,
            calm=self._calm(motion, dt),
        )

    def _brake_lean(self, braked: float, v: float, level: float, dt: float) -> tuple[float, float, float]:
        """Return the gains by slope, changeover and level, for a speed that the brake takes off [m/s]."""
        return braked * self._slope(v), braked * self._changeover(v), -dt if level <= -_LEVEL else 0.0

    def _late(self, motion: BrakeStep, timing: TimingStep, dt: float, v: float) -> float:
        """Return the variance of speed by timing and by changeovers that differ, for f = 1 [(m/s)^2]."""
        config, level = self._config, motion.end_target
        early = _JITTER_S * self._train_file.brake.timing_std * (level - motion.start_target)
        blend = _BLEND_VARIES * config.blend_std * self._changeover(v) * level
        return timing.variance + early * early + 2.0 * _BLEND_S * dt * blend * blend

    def _calm(self, motion: BrakeStep, dt: float) -> float:
        """Return 1 while the response stands, towards 0 while it changes."""
        least = max(abs(motion.end_target), self._config.min_braking)
        return math.exp(-abs(motion.end_target - motion.start_target) / (dt * least * _CHANGING))

    def _slope(self, speed: float) -> float:
        """Return p, see the module; a train that is faster than stated has that of the greatest speed."""
        return min(speed / self._train_file.train.max_speed, 1.0) - 0.5

    def _changeover(self, speed: float) -> float:
        """Return m, see the module."""
        return max(0.0, 1.0 - abs(speed / self._config.blend_speed - 1.0))

    def share(self, sample: Sample, level: float) -> Array:
        """Return what the brake rate at a speed and level [m/s^2, >= 0] has of the errors, shape (8,).

        A braking that ends leaves the brake rate at middle speed, for the next one.
        """
        share = np.zeros(ERRORS)
        if sample.brake_command < 0.0 and sample.speed >= _STOPPING:
            share[5:7] = self._slope(sample.speed), self._changeover(sample.speed)
            share[7] = 1.0 / level if level >= _LEVEL else 0.0
        return share

    def forget(self, elapsed: float, change: float) -> tuple[Errors, Errors]:
        """Return what is left of the errors after a time [s] and a change of level [m/s^2], and what enters."""
        keep = [math.exp(-elapsed / memory) for memory in _MEMORIES_S]
        keep.append(math.exp(-abs(change) / self._config.level_length))
        q = [(1.0 - k * k) * std * std for k, std in zip(keep, self.stds, strict=True)]
        return errors_of(keep), errors_of(q)


def true_brake(train_file: TrainFile) -> Brake:
    """Return the brake with what effects of the train file make of it (brake_scale, brake_delay)."""
    brake, effects = train_file.brake, train_file.effects
    rate = brake.rate * effect_value(effects, 'brake_scale', 'ratio', 1.0)
    return replace(brake, rate=rate, delay=brake.delay + effect_value(effects, 'brake_delay', 'extra', 0.0))


def _with_true_brake(train_file: TrainFile) -> TrainFile:
    """Return the train file with brake_scale in the brake, and no more among the effects."""
    effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
    return replace(train_file, brake=true_brake(train_file), effects=effects)
