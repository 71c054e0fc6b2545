# SPDX-License-Identifier: Apache-2.0
"""What all estimators of the brake rate have in common: which samples tell of f, and what moves the train.

After Zheng et al. 2015, section 2, with these corrections:

* The command passes an exact dead time (the paper: first-order Pade); a_z is then known and needs no state.
* b, an unmodelled acceleration that decorrelates over distance (gradient map, wind), is a state: without it
  it would be taken for brake rate (the paper: white noise). The gradient and running resistance that are
  known act as input.
* Standstill and traction never feed f. While no brake acts, its variance grows by q per second, exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import BrakeRateEstimate, Reason, Refusal
from trainid_ros.core.settings import check_settings
from trainid_ros.core.soundness import check_not_negative, check_numbers
from trainid_ros.estimators.brake_rate.belief import Belief, Interval
from trainid_ros.estimators.brake_rate.brake_kinematics import BrakeStep, brake_step
from trainid_ros.estimators.brake_rate.disturbance import DisturbanceNoise
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.physics.brake import CommandHistory
from trainid_ros.physics.effects import effect_value
from trainid_ros.physics.resistance import davis

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.estimators.brake_rate.config import BrakeRateConfig
    from trainid_ros.physics.train_file import Brake, TrainFile

# The brake is known again this many time constants after its command is.
_SETTLING: Final = 6.0
_POSITION_GAIN: Final = 0.1
# Doubt about the brake's acceleration where the train state starts anew [m/s^2].
_ANCHOR_BRAKE_STD: Final = 0.05
_ANCHORING: Final = frozenset({Reason.GAP, Reason.STANDSTILL, Reason.BRAKE_COMMAND_MISSING, Reason.BRAKE_UNCERTAIN})
_HISTORY_S: Final = 60.0
# A brake that is released, and traction whose error is small enough, to learn of the disturbance.
_RELEASED: Final = 1e-3
_SLACK: Final = 0.5
LARGEST_RATE: Final = 3.0
"""The brake rate is at most so many times the believed one."""


@dataclass(slots=True)
class DriveState:
    """All that is remembered besides the belief.

    Attributes:
        noise: Noise of the measured speed.
        disturbance: Size of the unmodelled acceleration.
        commands: Brake commands that may still act.
        stamp_ns: Stamp of the newest sample, 0 before the first.
        filtered_target: Command after dead time and lag of a nominal brake [m/s^2].
        unbraked_s: Time since f last learned [s], whose drift the belief does not hold yet.
        certain_ns: Stamp from which on the brake's state is known again after commands were missed.
        position: Filtered position [m], NaN while unknown.
        belief: State of the belief as JSON text, filled in when saved.

    """

    noise: SpeedNoise
    disturbance: DisturbanceNoise
    commands: CommandHistory
    stamp_ns: int = 0
    filtered_target: float = 0.0
    unbraked_s: float = 0.0
    certain_ns: int = 0
    position: float = math.nan
    refused_in_a_row: int = 0
    innovation: float = 0.0
    innovation_variance: float = 0.0
    test_ratio: float = 0.0
    observable: bool = False
    converged: bool = False
    belief: str = ''


class BrakeRateEstimator:
    """Estimate the brake rate f = actual over expected braking from aligned samples."""

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig, belief: Belief) -> None:
        check_settings(config)
        self.config = config
        self.belief = belief
        self._train_file = train_file
        self._brake = true_brake(train_file)
        self._delay_ns = round(self._brake.delay * NS_PER_S)
        self._settling_ns = round((self._brake.delay + _SETTLING * self._brake.time_constant) * NS_PER_S)
        self._known = KnownForce(_with_true_brake(train_file))
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        self.belief.reset(self._brake.rate, self.config.prior_std)
        noise = SpeedNoise.declared(self.config.speed_std)
        disturbance = DisturbanceNoise.declared(self.config.disturbance_std)
        self.state = DriveState(noise, disturbance, CommandHistory())

    def save(self) -> str:
        """Return the whole state, that of a generator included, as JSON text."""
        return encode(replace(self.state, belief=self.belief.save()))

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, DriveState)
        check_numbers(state, may_be_nan=('dt', 'position'))
        check_not_negative('DriveState', unbraked_s=state.unbraked_s, innovation_variance=state.innovation_variance)
        check_restored(min(state.noise.variance, state.noise.declared_std) > 0.0, 'DriveState', 'noise')
        targets = (state.filtered_target, *(change.target_acceleration for change in state.commands.changes))
        check_restored(max(targets) <= 0.0, 'DriveState', 'commands')
        check_restored(state.disturbance.sound, 'DriveState', 'disturbance')
        self.belief.restore(state.belief)
        state.belief = ''
        self.state = state

    @property
    def converged(self) -> bool:
        """True while the brake rate is known well enough."""
        return self.state.converged

    def step(self, sample: Sample) -> BrakeRateEstimate | Refusal:
        """Take one sample in; f learns only while the brake acts on a moving train."""
        motion = self._follow_command(sample)
        result = self._take(sample, motion)
        if result is None or result.reason is not Reason.NOT_BRAKING:
            self.state.disturbance = self.state.disturbance.paused()
        # Fit to use while the uncertainty is small; hysteresis of a factor of two.
        limit = self.config.valid_std * (2.0 if self.state.converged else 1.0)
        self.state.converged = self._std() < limit
        return result or self.estimate(sample.speed)

    def _take(self, sample: Sample, motion: BrakeStep) -> Refusal | None:
        state = self.state
        if (refusal := self._refuse(sample)) is not None:
            if refusal.reason in _ANCHORING:
                self._anchor(sample)
            else:
                self.belief.predict(self._interval(sample, motion))
            return refusal
        self._follow_position(sample)
        interval = self._interval(sample, motion)
        self.belief.predict(interval)
        if (refusal := self._gate(sample)) is not None:
            if state.refused_in_a_row >= self.config.readmit_after:  # then believe the speed again
                self._anchor(sample)
            return refusal
        braking = max(abs(state.filtered_target), abs(motion.start_target))
        if braking < self.config.min_braking:
            self.belief.follow(sample.speed, state.noise.variance)
            self._learn_disturbance(sample, interval, braking)
            return Refusal(sample.stamp_ns, Reason.NOT_BRAKING, braking, self.config.min_braking)
        if not self.belief.learn(interval, state.unbraked_s, sample.speed, state.noise.variance):
            return Refusal(sample.stamp_ns, Reason.NUMERICAL, state.innovation, math.nan)
        state.unbraked_s = 0.0
        state.observable = True
        return None

    def _refuse(self, sample: Sample) -> Refusal | None:
        uncertain_s = (self.state.certain_ns - sample.stamp_ns) / NS_PER_S
        checks = (
            (not math.isnan(sample.dt), Reason.GAP, sample.dt, math.nan),
            (sample.speed >= self.config.min_speed, Reason.STANDSTILL, sample.speed, self.config.min_speed),
            (math.isfinite(sample.brake_command), Reason.BRAKE_COMMAND_MISSING, sample.brake_command, math.nan),
            (uncertain_s <= 0.0, Reason.BRAKE_UNCERTAIN, uncertain_s, 0.0),
            (math.isfinite(sample.gradient_mean), Reason.GRADIENT_MISSING, sample.gradient_mean, math.nan),
            (math.isfinite(sample.force_mean), Reason.FORCE_MISSING, sample.force_mean, math.nan),
        )
        for fine, reason, value, limit in checks:
            if not fine:
                return Refusal(sample.stamp_ns, reason, value, limit)
        return None

    def _follow_command(self, sample: Sample) -> BrakeStep:
        """Bring the brake command up to the stamp; return the brake's response since the last sample."""
        state = self.state
        if sample.stamp_ns <= state.stamp_ns:  # another time base: commands of the old one mean nothing in it
            state.commands = CommandHistory()
            state.filtered_target, state.certain_ns, state.stamp_ns = 0.0, 0, 0
        start_ns = state.stamp_ns or sample.stamp_ns
        for change in sample.brake_changes:
            if not state.commands.changes or change.stamp_ns >= state.commands.changes[-1].stamp_ns:
                state.commands = state.commands.push(change)
        motion = brake_step(state.commands, self._brake, start_ns, sample.stamp_ns, state.filtered_target)
        state.commands = state.commands.prune(sample.stamp_ns - self._delay_ns - round(_HISTORY_S * NS_PER_S))
        state.filtered_target = motion.end_target
        state.stamp_ns = sample.stamp_ns
        if sample.brake_gap or sample.emergency or math.isnan(sample.brake_command):
            state.certain_ns = sample.stamp_ns + self._settling_ns
        state.unbraked_s += (sample.stamp_ns - start_ns) / NS_PER_S
        # A train at rest reads zero without noise.
        state.noise = state.noise.add(sample.speed, sample.dt if sample.speed >= self.config.min_speed else math.nan)
        state.observable = False
        return motion

    def _interval(self, sample: Sample, motion: BrakeStep) -> Interval:
        """What moved the train since the last sample; what is not known counts as nothing."""
        config, dt, inertia = self.config, sample.dt, self._known.inertia
        force = sample.force_mean if sample.force_mean > 0.0 else 0.0
        traction = self._known.traction(force, sample)
        resistance = davis(self._train_file.resistance, sample.speed)
        known = (traction - self._known.track(sample) - resistance) / inertia
        slack = config.force_error * traction / inertia
        rho = math.exp(-sample.speed * dt / config.disturbance_length)
        share = self._known.brake_share(sample)
        return Interval(
            dt=dt,
            reach=motion.reach,
            decay=motion.decay,
            gain_v=share * motion.gain_v,
            gain_a=share * motion.gain_a,
            rho=rho,
            known=known * dt if math.isfinite(known) else 0.0,
            q_v=(config.acceleration_noise**2 + slack**2) * dt,
            q_b=self.state.disturbance.variance * (1.0 - rho * rho),
        )

    def _learn_disturbance(self, sample: Sample, interval: Interval, braking: float) -> None:
        """Learn of the size of b where nothing else that is uncertain acts."""
        state = self.state
        slack = interval.q_v / interval.dt - self.config.acceleration_noise**2
        if braking > _RELEASED or slack > (_SLACK * self.config.disturbance_std) ** 2:
            state.disturbance = state.disturbance.paused()
            return
        state.disturbance = state.disturbance.add(interval, sample.speed, state.noise.variance)

    def _anchor(self, sample: Sample) -> None:
        """Start the train state anew from the measured speed; f stands."""
        state = self.state
        variances = (state.noise.variance, _ANCHOR_BRAKE_STD**2, state.disturbance.variance)
        target = self._known.brake_share(sample) * state.filtered_target
        self.belief.anchor(sample.speed, target, variances)
        state.position = sample.position
        state.refused_in_a_row = 0

    def _follow_position(self, sample: Sample) -> None:
        """Dead-reckon by filtered speed, pulled towards the odometer (which adds nothing to f)."""
        state, measured = self.state, sample.position
        if math.isnan(measured) or math.isnan(state.position):
            state.position = measured
            return
        position = state.position + sample.direction * self.belief.speed * sample.dt
        state.position = position + _POSITION_GAIN * (measured - position)

    def _gate(self, sample: Sample) -> Refusal | None:
        """Gate on the innovation of the whole belief."""
        state = self.state
        expected, variance = self.belief.predicted()
        variance += state.noise.variance
        innovation = sample.speed - expected
        limit = self.config.gate * math.sqrt(variance)
        state.innovation, state.innovation_variance = innovation, variance
        state.test_ratio = (innovation / limit) ** 2
        if abs(innovation) <= limit:
            state.refused_in_a_row = 0
            return None
        state.refused_in_a_row += 1
        return Refusal(sample.stamp_ns, Reason.OUTLIER, innovation, limit)

    def _std(self) -> float:
        """Law of the uncertainty: sqrt(s^2 + drift^2 t) while no brake acts."""
        return math.sqrt(self.belief.variance + self.config.drift**2 * self.state.unbraked_s)

    def estimate(self, speed: float) -> BrakeRateEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the brake rate (19) and the filtered train state (22)."""
        state, belief = self.state, self.belief
        return BrakeRateEstimate(
            brake_rate=min(max(0.0, belief.rate), LARGEST_RATE * self._brake.rate),
            brake_rate_std=self._std(),
            position=state.position,
            speed=max(0.0, belief.speed),
            control_acceleration=belief.acceleration,
            filtered_target=state.filtered_target,
            effective_particles=belief.effective,
            observable=state.observable,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
        )


def true_brake(train_file: TrainFile) -> Brake:
    """Return the brake with what effects of the train file make of it (brake_scale, brake_delay)."""
    brake, effects = train_file.brake, train_file.effects
    rate = brake.rate * effect_value(effects, 'brake_scale', 'ratio', 1.0)
    return replace(brake, rate=rate, delay=brake.delay + effect_value(effects, 'brake_delay', 'extra', 0.0))


def _with_true_brake(train_file: TrainFile) -> TrainFile:
    """Return the train file with brake_scale in the brake, and no more among the effects."""
    effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale')
    return replace(train_file, brake=true_brake(train_file), effects=effects)
