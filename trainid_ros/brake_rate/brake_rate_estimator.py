# SPDX-License-Identifier: Apache-2.0
"""What all estimators of the brake rate have in common: which samples tell of f, and what moves the train.

After Zheng et al. 2015, section 2, with these corrections:

* The command passes an exact dead time (the paper: first-order Pade); a_z is then known and needs no state.
* b, an unmodelled acceleration that decorrelates over distance (gradient map, wind), is a state: without it
  it would be taken for brake rate (the paper: white noise). The gradient and running resistance that are
  known act as input.
* What the train file states wrong is a state too: dead time and lag, running resistance, traction, and a brake
  rate that changes with speed and with the level of the brake.
* Standstill and traction never feed f. While no brake acts, its variance grows by q per second, exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.brake_kinematics import BrakeStep, brake_step
from trainid_ros.brake_rate.disturbance_noise import DisturbanceNoise
from trainid_ros.brake_rate.motion_model import BLEND_SHAPE, LEAST_RATE, MotionModel
from trainid_ros.brake_rate.posterior import Posterior, Start, Transition
from trainid_ros.brake_rate.timing import Timing, TimingStep, timing_step
from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import BrakeRateEstimate, Reason, Rejection
from trainid_ros.core.settings import check_settings
from trainid_ros.core.state_validation import check_not_negative, check_numbers
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.train.brake import CommandHistory

if TYPE_CHECKING:
    from trainid_ros.brake_rate.config import BrakeRateConfig
    from trainid_ros.core.samples import Sample
    from trainid_ros.train.train_file import TrainFile

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
# Memory of the squared innovations in samples, most that one of them counts, and most that all of them do.
_MEMORY: Final = 100.0
_MOST: Final = 9.0
_MOST_EXCESS: Final = 10.0
# A rate is below its limit if it is so by this many standard deviations.
_CLEAR: Final = 3.0
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
        timing: Dead time and lag of the brake as learned.
        rate: Brake rate at the speed and level at which it was last learned.
        rate_variance: Its variance.
        blending: Standard deviation of the changeover between brakes, at the newest sample.
        excess: Variance of the innovations of speed over that of its noise, as learned while braking; at least 1.
        gain: Brake rate by the table and by effects of the train file, for f = 1.
        position: Filtered position [m], NaN while unknown.
        belief: State of the belief as JSON text, filled in when saved.

    """

    noise: SpeedNoise
    disturbance: DisturbanceNoise
    commands: CommandHistory
    timing: Timing
    rate: float = 1.0
    rate_variance: float = 0.0
    blending: float = 0.0
    excess: float = 1.0
    gain: float = 1.0
    stamp_ns: int = 0
    filtered_target: float = 0.0
    unbraked_s: float = 0.0
    certain_ns: int = 0
    position: float = math.nan
    rejected_in_a_row: int = 0
    innovation: float = 0.0
    innovation_variance: float = 0.0
    test_ratio: float = 0.0
    observable: bool = False
    converged: bool = False
    posterior: str = ''


class BrakeRateEstimator:
    """Estimate the brake rate f = actual over expected braking from aligned samples."""

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig, posterior: Posterior) -> None:
        check_settings(config)
        self.config = config
        self.posterior = posterior
        self._model = MotionModel(train_file, config)
        self._brake = brake = self._model.brake
        self._settling_ns = round((brake.delay + _SETTLING * brake.time_constant) * NS_PER_S)
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        config, brake = self.config, self._brake
        self.posterior.reset(brake.rate, config.prior_std, self._model.stds)
        noise = SpeedNoise.declared(config.speed_std)
        disturbance = DisturbanceNoise.declared(self._model.disturbance_std)
        timing = Timing(brake.delay, brake.time_constant, self._model.timing_stds)
        self.state = DriveState(noise, disturbance, CommandHistory(), timing)
        self.state.rate, self.state.rate_variance = self.posterior.rate, self.posterior.variance

    def save(self) -> str:
        """Return the whole state, that of a generator included, as JSON text."""
        return encode(replace(self.state, posterior=self.posterior.save()))

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, DriveState)
        check_numbers(state, may_be_nan=('dt', 'position'))
        check_not_negative('DriveState', unbraked_s=state.unbraked_s, rate_variance=state.rate_variance)
        check_not_negative('DriveState', innovation_variance=state.innovation_variance)
        check_not_negative('DriveState', blending=state.blending, rejected_in_a_row=state.rejected_in_a_row)
        check_restored(state.noise.is_valid(), 'DriveState', 'noise')
        targets = (state.filtered_target, *(change.target_acceleration for change in state.commands.changes))
        check_restored(max(targets) <= 0.0, 'DriveState', 'commands')
        check_restored(state.disturbance.is_valid, 'DriveState', 'disturbance')
        check_restored(state.timing.is_valid(), 'DriveState', 'timing')
        check_restored(state.gain >= LEAST_RATE, 'DriveState', 'gain')
        check_restored(1.0 <= state.excess <= _MOST_EXCESS, 'DriveState', 'excess')
        self.posterior.restore(state.posterior)
        state.posterior = ''
        self.state = state

    @property
    def converged(self) -> bool:
        """True while the brake rate is known well enough."""
        return self.state.converged

    def step(self, sample: Sample) -> BrakeRateEstimate | Rejection:
        """Take one sample in; f learns only while the brake acts on a moving train."""
        before_ns = self.state.stamp_ns
        motion, timing = self._follow_command(sample)
        elapsed = (sample.stamp_ns - before_ns) / NS_PER_S if before_ns else 0.0
        result = self._take(sample, max(0.0, elapsed), motion, timing)
        if result is None or result.reason is not Reason.NOT_BRAKING:
            self.state.disturbance = self.state.disturbance.paused()
        # Fit to use while the uncertainty is small, with a hysteresis of two; a rate at its limit may be beyond it.
        limit = self.config.valid_std * (2.0 if self.state.converged else 1.0)
        rate, std = self._rate()
        self.state.converged = std < limit and rate + _CLEAR * std < LARGEST_RATE * self._brake.rate
        return result or self.estimate(sample.speed)

    def _take(self, sample: Sample, elapsed: float, motion: BrakeStep, timing: TimingStep) -> Rejection | None:
        state = self.state
        if (rejection := self._reject(sample)) is not None:
            if rejection.reason in _ANCHORING:
                self._anchor(sample, elapsed)
            else:
                self.posterior.predict(self._interval(sample, motion, timing))
            return rejection
        self._follow_position(sample)
        interval = self._interval(sample, motion, timing)
        self.posterior.predict(interval)
        if (rejection := self._gate(sample)) is not None:
            if state.rejected_in_a_row >= self.config.readmit_after:  # then believe the speed again
                self._anchor(sample, 0.0)
            return rejection
        braking = max(abs(state.filtered_target), abs(motion.start_target))
        if braking < self.config.min_braking or self._released(sample):
            self.posterior.follow(sample.speed, state.noise.variance)
            self._learn_disturbance(sample, interval, braking)
            return Rejection(sample.stamp_ns, Reason.NOT_BRAKING, braking, self.config.min_braking)
        if not self.posterior.learn(interval, state.unbraked_s, sample.speed, self._noise_variance()):
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, state.innovation, math.nan)
        ratio = min(state.innovation**2 / state.innovation_variance, _MOST)
        state.excess = min(max(1.0, state.excess * math.exp((ratio - 1.0) / _MEMORY)), _MOST_EXCESS)
        share = self._model.share(sample, abs(state.filtered_target))
        state.rate, state.rate_variance = self.posterior.total_rate(share)
        # A changeover is as wide as the model has it, but not of its shape.
        state.blending = BLEND_SHAPE * self.config.blend_std if share[6] > 0.0 else 0.0
        state.unbraked_s = 0.0
        state.observable = True
        return None

    def _reject(self, sample: Sample) -> Rejection | None:
        known, uncertain_s = self._model.known, (self.state.certain_ns - sample.stamp_ns) / NS_PER_S
        checks = (
            (not math.isnan(sample.dt), Reason.GAP, sample.dt, math.nan),
            (sample.speed >= self.config.min_speed, Reason.STANDSTILL, sample.speed, self.config.min_speed),
            (math.isfinite(sample.brake_command), Reason.BRAKE_COMMAND_MISSING, sample.brake_command, math.nan),
            (uncertain_s <= 0.0, Reason.BRAKE_UNCERTAIN, uncertain_s, 0.0),
            (math.isfinite(sample.gradient_mean), Reason.GRADIENT_MISSING, sample.gradient_mean, math.nan),
            (math.isfinite(sample.force_mean), Reason.FORCE_MISSING, sample.force_mean, math.nan),
            (known.is_possible(sample), Reason.OUT_OF_RANGE, sample.force_mean, known.largest_force(sample)),
        )
        for fine, reason, value, limit in checks:
            if not fine:
                return Rejection(sample.stamp_ns, reason, value, limit)
        return None

    def _follow_command(self, sample: Sample) -> tuple[BrakeStep, TimingStep]:
        """Bring the brake command up to the stamp; return the brake's response since the last sample."""
        state = self.state
        if sample.stamp_ns <= state.stamp_ns:  # another time base: commands of the old one mean nothing in it
            state.commands = CommandHistory()
            state.filtered_target, state.certain_ns, state.stamp_ns = 0.0, 0, 0
            state.timing = replace(state.timing, targets=(0.0, 0.0, 0.0, 0.0))
        start_ns = state.stamp_ns or sample.stamp_ns
        for change in sample.brake_changes:
            if not state.commands.changes or change.stamp_ns >= state.commands.changes[-1].stamp_ns:
                state.commands = state.commands.push(change)
        self._move_timing(start_ns)
        brake = replace(self._brake, delay=state.timing.delay, time_constant=state.timing.lag)
        motion = brake_step(state.commands, brake, start_ns, sample.stamp_ns, state.filtered_target)
        nominal = motion.reach * state.filtered_target + motion.gain_v
        state.timing, timing = timing_step(state.timing, state.commands, start_ns, sample.stamp_ns, nominal)
        oldest_s = state.timing.delay + _HISTORY_S
        state.commands = state.commands.prune(sample.stamp_ns - round(oldest_s * NS_PER_S))
        state.filtered_target = motion.end_target
        state.stamp_ns = sample.stamp_ns
        if sample.brake_gap or sample.emergency or math.isnan(sample.brake_command):
            state.certain_ns = sample.stamp_ns + self._settling_ns
        state.unbraked_s += (sample.stamp_ns - start_ns) / NS_PER_S
        # A train at rest reads zero without noise.
        state.noise = state.noise.add(sample.speed, sample.dt if sample.speed >= self.config.min_speed else math.nan)
        state.observable = False
        return motion, timing

    def _move_timing(self, now_ns: int) -> None:
        """Take over what has been learned of dead time and lag while the brake is released."""
        state, timing = self.state, self.state.timing
        if not timing.fresh or not timing.at_rest(state.commands, now_ns):
            return
        e, variances, f = self.posterior.errors, self.posterior.error_variances, max(self.posterior.rate, LEAST_RATE)
        stds = (math.sqrt(variances[0]) / f, math.sqrt(variances[1]) / f)
        state.timing = timing.moved((e[0] / f, e[1] / f), stds, self._brake)
        learned = (f * (state.timing.delay - timing.delay), f * (state.timing.lag - timing.lag))
        self.posterior.recentre((*learned, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    def _interval(self, sample: Sample, motion: BrakeStep, timing: TimingStep) -> Transition:
        """Return what moved the train since the last sample."""
        state = self.state
        gains = state.gain, self._model.gain(sample)
        state.gain = gains[1]
        return self._model.interval(
            sample,
            motion,
            timing,
            rate=self.posterior.rate,
            gains=gains,
            variance=state.disturbance.variance,
            released=self._released(sample),
        )

    def _released(self, sample: Sample) -> bool:
        """True while the brake lets go: traction may begin that the reported force does not show."""
        state = self.state
        return state.commands.value(sample.stamp_ns - round(state.timing.delay * NS_PER_S)) >= 0.0

    def _learn_disturbance(self, sample: Sample, interval: Transition, braking: float) -> None:
        """Learn of the size of b where nothing else that is uncertain acts."""
        state = self.state
        slack = interval.q_v / interval.dt - self.config.acceleration_noise**2
        e = self.posterior.errors
        learned = sum(gain * error for gain, error in zip(interval.lean[2:5], e[2:5], strict=True))
        interval = interval._replace(known=interval.known + learned)
        if braking > _RELEASED or slack > (_SLACK * self.config.disturbance_std) ** 2:
            state.disturbance = state.disturbance.paused()
            return
        state.disturbance = state.disturbance.add(interval, sample.speed, state.noise.variance)

    def _anchor(self, sample: Sample, elapsed: float) -> None:
        """Start the train state anew from the measured speed after a time [s]; f stands."""
        state = self.state
        state.gain = self._model.gain(sample)
        variances = (state.noise.variance, _ANCHOR_BRAKE_STD**2, state.disturbance.variance)
        keep, q_e = self._model.forget(elapsed, 0.0)
        self.posterior.anchor(Start(sample.speed, state.gain * state.filtered_target, variances, keep, q_e))
        state.position = sample.position
        state.rejected_in_a_row = 0

    def _follow_position(self, sample: Sample) -> None:
        """Dead-reckon by filtered speed, pulled towards the odometer (which adds nothing to f)."""
        state, measured = self.state, sample.position
        if math.isnan(measured) or math.isnan(state.position):
            state.position = measured
            return
        position = state.position + sample.direction * self.posterior.speed * sample.dt
        state.position = position + _POSITION_GAIN * (measured - position)

    def _gate(self, sample: Sample) -> Rejection | None:
        """Gate on the innovation of the whole belief."""
        state = self.state
        expected, variance = self.posterior.predicted()
        variance += self._noise_variance()
        innovation = sample.speed - expected
        limit = self.config.gate * math.sqrt(variance)
        state.innovation, state.innovation_variance = innovation, variance
        state.test_ratio = (innovation / limit) ** 2
        if abs(innovation) <= limit:
            state.rejected_in_a_row = 0
            return None
        state.rejected_in_a_row += 1
        return Rejection(sample.stamp_ns, Reason.OUTLIER, innovation, limit)

    def _noise_variance(self) -> float:
        """Return the variance of measured speed that the innovations under the brake bear out [(m/s)^2]."""
        return self.state.noise.variance * self.state.excess

    def _rate(self) -> tuple[float, float]:
        """Mean and standard deviation of the brake rate: sqrt(s^2 + drift^2 t) while no brake acts."""
        mean, config = self.state.rate, self.config
        unseen = config.drift**2 * self.state.unbraked_s + (config.scale_std * mean) ** 2 + self.state.blending**2
        return mean, math.sqrt(self.state.rate_variance + unseen)

    def estimate(self, speed: float) -> BrakeRateEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the brake rate (19) and the filtered train state (22)."""
        state, posterior = self.state, self.posterior
        rate, std = self._rate()
        return BrakeRateEstimate(
            brake_rate=min(max(0.0, rate), LARGEST_RATE * self._brake.rate),
            brake_rate_std=std,
            position=state.position,
            speed=max(0.0, posterior.speed),
            control_acceleration=posterior.acceleration,
            filtered_target=state.filtered_target,
            effective_particles=posterior.effective,
            observable=state.observable,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
        )
