# SPDX-License-Identifier: Apache-2.0
"""Common part of all brake rate estimators: which samples update f, and the size of the unmodelled acceleration b.

Based on Zheng et al. 2015, section 2, with these corrections:

* The command passes an exact dead time (the paper: first-order Pade); a_z is then known and needs no state.
* b, an unmodelled acceleration that decorrelates over distance (gradient map, wind), is a state: otherwise it would
  be attributed to the brake rate (the paper: white noise). Known gradient and running resistance are inputs.
* Errors of the train file are states too: dead time and lag, running resistance, traction, and a brake rate that
  changes with speed and with the brake level.
* Standstill and traction never update f. While no brake acts, its variance grows by exactly q per second.

Errors of gradient maps range from 0.05 to 2 per mille, and the uncertainty of the brake rate depends directly on them.
While no brake acts, the speed shows b: a bank of Kalman filters on [v, b], one for each candidate standard deviation
of b, gives their likelihoods through the innovations. The estimate is the posterior mean of the variance, which stays
large while there is little data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

from trainid_ros.brake_rate.motion_model import (
    AIR,
    BLEND_SHAPE,
    CHANGEOVER,
    DELAY,
    LAG,
    MIN_RATE,
    ROLLING,
    TRACTION,
    BrakeStep,
    MotionModel,
    Posterior,
    Start,
    Timing,
    Transition,
    brake_step,
)
from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import BrakeRateEstimate, Reason, Rejection
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, encode, restore, stored
from trainid_ros.stream.known_force import SpeedNoise
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import CommandHistory
from trainid_ros.train.train_file import TrainFile

# Smallest and largest candidate for the std of b, as multiples of the configured one, and their number.
_LOW, _HIGH, _LEVELS = 0.3, 10.0, 11
# Prior of the configured value: log-normal, one standard deviation is this factor.
_PRIOR_FACTOR: Final = 2.5
# The evidence is forgotten exponentially over this distance [m].
_MEMORY_M: Final = 5_000.0
# Innovations are clipped at this many standard deviations: slip is not a disturbance.
_MAX_INNOVATION: Final = 3.0


@dataclass
class Candidate:
    """A standard deviation of b with its Kalman filter on [v, b]."""

    factor: float  # Standard deviation of b, as a multiple of the configured one [1]
    prior: float  # Logarithm of its prior probability
    evidence: float = 0.0  # Its log-likelihood; the largest of all is 0
    v: float = 0.0  # Speed [m/s]
    b: float = 0.0  # Disturbance [m/s^2]
    vv: float = 0.0  # Variance of v [(m/s)^2]
    vb: float = 0.0  # Covariance of v and b
    bb: float = 0.0  # Variance of b [(m/s^2)^2]


@dataclass
class DisturbanceNoise:
    """Posterior of the standard deviation of b [m/s^2]."""

    declared_std: float  # Configured standard deviation [m/s^2]; 0: the variance is known
    variance: float  # Mean variance of b [(m/s^2)^2]
    candidates: tuple[Candidate, ...] = stored((), kind=Candidate)  # The possible standard deviations
    running: bool = False  # Whether their filters run; not while the brake acts or the train stands

    @classmethod
    def declared(cls, std: float) -> DisturbanceNoise:
        """Return the prior for a configured standard deviation [m/s^2]."""
        factors = [_LOW * (_HIGH / _LOW) ** (k / (_LEVELS - 1)) for k in range(_LEVELS)]
        priors = [-0.5 * (math.log(f) / math.log(_PRIOR_FACTOR)) ** 2 for f in factors]
        noise = DisturbanceNoise(std, 0.0, tuple(map(Candidate, factors, priors)))
        noise.variance = noise.mean_variance()
        return noise

    def add(self, interval: Transition, known: float, speed: float, r: float) -> None:
        """Update while no brake acts.

        Args:
            interval: Motion model without a brake.
            known: Gain of speed by all known forces [m/s].
            speed: Measured speed [m/s].
            r: Its variance [(m/s)^2].
        """
        std = self.declared_std
        if std <= 0.0:
            return
        if not self.running:
            for item in self.candidates:
                item.v, item.b, item.vv, item.vb = speed, 0.0, r, 0.0
                item.bb = (item.factor * std) * (item.factor * std)
            self.running = True
            return
        dt, rho = interval.dt, interval.rho
        kept, best = math.exp(-speed * dt / _MEMORY_M), -math.inf
        for item in self.candidates:
            # Prediction v' = v + dt b + known, b' = rho b.
            S = item.vv + dt * (2.0 * item.vb + dt * item.bb) + interval.q_v + r
            vb = rho * (item.vb + dt * item.bb)
            bb = rho * rho * item.bb + (1.0 - rho * rho) * ((item.factor * std) * (item.factor * std))
            ahead, most = item.v + dt * item.b + known, _MAX_INNOVATION * math.sqrt(S)
            nu = min(max(speed - ahead, -most), most)
            k, left = nu / S, r / S
            item.v, item.b = ahead + (S - r) * k, rho * item.b + vb * k
            item.vv, item.vb, item.bb = (S - r) * left, vb * left, bb - vb * vb / S
            item.evidence = kept * item.evidence - 0.5 * (nu * k + math.log(S))
            best = max(best, item.evidence)
        for item in self.candidates:
            item.evidence -= best
        self.variance = self.mean_variance()

    def mean_variance(self) -> float:
        """Return the posterior mean of the variance of b [(m/s^2)^2]."""
        best, total, mean = -math.inf, 0.0, 0.0
        for item in self.candidates:
            best = max(best, item.evidence + item.prior)
        for item in self.candidates:
            weight = math.exp(item.evidence + item.prior - best)
            total += weight
            mean += weight * item.factor * item.factor
        return self.declared_std * self.declared_std * (mean / total)


# After missing commands the state of the brake is known again this many time constants later.
_SETTLING: Final = 6.0
# Gain of the measured position in the filtered one [1].
_POSITION_GAIN: Final = 0.1
# Standard deviation of the brake acceleration at a restart of the train state [m/s^2].
_REINIT_BRAKE_STD: Final = 0.05
# Time for which commands are kept beyond the dead time [s].
_HISTORY_S: Final = 60.0
# Upper limits for learning the disturbance: residual braking [m/s^2], and traction error over the std of b [1].
_MAX_RESIDUAL_BRAKING: Final = 1e-3
_MAX_TRACTION_SHARE: Final = 0.5
# Memory of the squared innovations in samples, limit of each of them, and limit of the resulting factor.
_MEMORY: Final = 100.0
_MAX_SQUARE: Final = 9.0
_MAX_EXCESS: Final = 10.0
# Distance of a learned time from that of the train file beyond which the file is wrong [std of the file].
_MISTIMED: Final = 4.0
MAX_RATE_FACTOR: Final = 3.0  # largest brake rate as a multiple of that of the train file [1]


@dataclass
class EstimatorState:
    """State other than the posterior."""

    noise: SpeedNoise  # Noise of the measured speed
    disturbance: DisturbanceNoise  # Size of the unmodelled acceleration
    commands: CommandHistory  # Brake commands that may still act
    timing: Timing  # Estimated dead time and lag of the brake
    rate: float = 1.0  # Brake rate at the speed and level of its last update, at medium speed once that is over [1]
    rate_variance: float = 0.0  # Its variance, with that of the shape of a changeover [1]
    # Factor on the variance of the speed noise, estimated from innovations while braking [1]; at least 1
    excess: float = 1.0
    gain: float = 1.0  # Brake rate by the table and the effects of the train file, for f = 1 [1]
    stamp_ns: int = 0  # Stamp of the newest sample [ns], 0 before the first
    filtered_target: float = 0.0  # Command after dead time and lag of a nominal brake [m/s^2]
    unbraked_s: float = 0.0  # Time since the last update of f [s]; the drift over it is not yet in the posterior
    certain_ns: int = 0  # Stamp from which the state of the brake is known again after missing commands [ns]
    position: float = math.nan  # Filtered position [m], NaN while unknown
    rejected_in_a_row: int = 0  # Outliers in a row
    innovation: float = 0.0  # Last innovation of speed [m/s]
    innovation_variance: float = 0.0  # Its variance [(m/s)^2]
    test_ratio: float = 0.0  # Square of the innovation over the limit of the gate [1]
    observable: bool = False  # Whether the last sample updated f
    converged: bool = False  # Whether the brake rate is valid
    is_mistimed: bool = False  # Whether dead time or lag are not those of the train file


class BrakeRateEstimator:
    """Estimate the brake rate f [1], actual over expected braking, from aligned samples."""

    STATE: ClassVar[State] = declare('state', 'posterior')

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig, posterior: Posterior) -> None:
        check_settings(config)
        self.config = config
        self.posterior = posterior
        self._model = MotionModel(train_file, config)
        self._brake = brake = self._model.brake
        self._settling_ns = round((brake.delay + _SETTLING * brake.time_constant) * NS_PER_S)
        self._start = Start(0.0, 0.0, (0.0, 0.0, 0.0))
        # What each sample needs of the settings.
        self._min_speed, self._min_braking, self._gate_stds = config.min_speed, config.min_braking, config.gate
        self._q, self._scale_std, self._valid_std = config.drift**2, config.scale_std, config.valid_std
        self._white = config.acceleration_noise**2
        self._max_traction_variance = (_MAX_TRACTION_SHARE * config.disturbance_std) ** 2
        self._max_rate = MAX_RATE_FACTOR * brake.rate
        self.reset()

    def reset(self) -> None:
        """Reset to the prior."""
        config, brake = self.config, self._brake
        self.posterior.reset(brake.rate, config.prior_std, self._model.stds)
        self.state = EstimatorState(
            SpeedNoise.declared(config.speed_std),
            DisturbanceNoise.declared(self._model.disturbance_std),
            CommandHistory(),
            Timing(brake.delay, brake.time_constant, *self._model.timing_stds),
        )
        self.state.rate, self.state.rate_variance = self.posterior.rate, self.posterior.variance

    def save(self) -> str:
        """Return the state as JSON text, including that of a random generator."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)

    @property
    def converged(self) -> bool:
        """Whether the brake rate is known accurately enough."""
        return self.state.converged

    @property
    def timing_finding(self) -> str:
        """What is wrong with the times of the brake in the train file, empty if nothing is."""
        timing, brake, (delay_std, lag_std) = self.state.timing, self._brake, self._model.timing_stds
        delay, lag, both_std = (
            timing.delay - brake.delay,
            timing.lag - brake.time_constant,
            math.hypot(delay_std, lag_std),
        )
        errors = ((delay, delay_std), (lag, lag_std), (delay + lag, both_std))
        if all(abs(error) <= _MISTIMED * std for error, std in errors):
            return ''
        return (
            f'brake.delay = {brake.delay:.2f} s or brake.time_constant = {brake.time_constant:.2f} s of the train file '
            f'is wrong: by the brakings so far {timing.delay:.2f} and {timing.lag:.2f} s are nearer; '
            'see trainid fit --brake'
        )

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; f is updated only while the brake acts on a moving train."""
        state = self.state
        before_ns = state.stamp_ns
        motion = self._follow_command(sample)
        elapsed = seconds(sample.stamp_ns - before_ns) if before_ns else 0.0
        result = self._process(sample, max(0.0, elapsed), motion)
        if result is None or result.reason is not Reason.NOT_BRAKING:
            state.disturbance.running = False
        self._check_validity()
        return result

    def _check_validity(self) -> None:
        """Decide whether the rate is valid, with a hysteresis of factor two; one within 3 stds of its limit is not.

        What counts is the rate at medium speed and level: the wider band of a weak braking, or at a changeover, is no
        lack of learning.
        """
        state, rate = self.state, self.posterior.rate
        std = self._std(rate, self.posterior.variance)
        limit = self._valid_std * (2.0 if state.converged else 1.0)
        is_known = std < limit and rate + 3.0 * std < self._max_rate
        state.converged = is_known and not state.is_mistimed

    def idle(self, seconds: float) -> None:
        """Let the drift of the rate go on over a time without samples [s]."""
        self.state.unbraked_s += seconds
        self._check_validity()

    def _process(self, sample: Sample, elapsed: float, motion: BrakeStep) -> Rejection | None:
        state, posterior = self.state, self.posterior
        if (rejection := self._unknown(sample)) is not None:
            self._reinit_motion(sample, elapsed)
            if rejection.reason is Reason.STANDSTILL:
                self._conclude()
            return rejection
        if (rejection := self._model.known.reject(sample)) is not None:
            posterior.predict(self._interval(sample, motion))
            return rejection
        self._follow_position(sample)
        interval = self._interval(sample, motion)
        posterior.predict(interval)
        if (rejection := self._gate(sample)) is not None:
            if state.rejected_in_a_row >= self.config.readmit_after:  # then accept the speed
                self._reinit_motion(sample, 0.0)
            return rejection
        braking = max(abs(state.filtered_target), abs(motion.start_target))
        # Traction may begin before the brake is off, as at a departure.
        is_pulling = sample.brake_command >= 0.0 and sample.force_mean > 0.0
        if braking < self._min_braking or motion.is_released or is_pulling:
            posterior.follow(sample.speed, state.noise.variance)
            if braking < self._min_braking:
                self._conclude()
            self._learn_disturbance(sample, interval, braking)
            return Rejection(sample.stamp_ns, Reason.NOT_BRAKING, braking, self._min_braking)
        if not posterior.update(interval, state.unbraked_s, sample.speed, self._noise_variance()):
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, state.innovation, math.nan)
        ratio = min(state.innovation * state.innovation / state.innovation_variance, _MAX_SQUARE)
        state.excess = min(max(1.0, state.excess * math.exp((ratio - 1.0) / _MEMORY)), _MAX_EXCESS)
        share = self._model.share(sample.speed, abs(state.filtered_target))
        state.rate, state.rate_variance = posterior.total_rate(share)
        if share[CHANGEOVER] > 0.0:  # the model has the width of a changeover, but not its exact shape
            state.rate_variance += (BLEND_SHAPE * self.config.blend_std) ** 2
        state.unbraked_s = 0.0
        state.observable = True
        return None

    def _conclude(self) -> None:
        """After a braking, state the brake rate at medium speed for the next one."""
        state, posterior = self.state, self.posterior
        state.rate, state.rate_variance = posterior.rate, posterior.variance

    def _unknown(self, sample: Sample) -> Rejection | None:
        """Return a rejection if the motion since the last sample, or the state of the brake, is not known."""
        if math.isnan(sample.dt):
            return Rejection(sample.stamp_ns, Reason.GAP, sample.dt, math.nan)
        if not sample.speed >= self._min_speed:
            return Rejection(sample.stamp_ns, Reason.STANDSTILL, sample.speed, self._min_speed)
        if not is_finite(sample.brake_command):
            return Rejection(sample.stamp_ns, Reason.BRAKE_COMMAND_MISSING, sample.brake_command, math.nan)
        if self.state.certain_ns > sample.stamp_ns:
            uncertain_s = seconds(self.state.certain_ns - sample.stamp_ns)
            return Rejection(sample.stamp_ns, Reason.BRAKE_UNCERTAIN, uncertain_s, 0.0)
        return None

    def _follow_command(self, sample: Sample) -> BrakeStep:
        """Advance the brake command to the stamp; return the response of the brake since the last sample."""
        state, timing, commands, now_ns = self.state, self.state.timing, self.state.commands, sample.stamp_ns
        if now_ns <= state.stamp_ns:  # another time base, in which the old commands are invalid
            commands.changes = ()
            state.filtered_target, state.certain_ns, state.stamp_ns = 0.0, 0, 0
            timing.release()
        start_ns = state.stamp_ns or now_ns
        commands.follow(sample.brake_changes)
        self._move_timing(start_ns)
        motion = brake_step(commands, timing.delay, timing.lag, start_ns, now_ns, state.filtered_target)
        timing.follow(commands, start_ns, now_ns, motion)
        motion.is_released = commands.value(now_ns - round(timing.delay * NS_PER_S)) >= 0.0
        commands.prune(now_ns - round((timing.delay + _HISTORY_S) * NS_PER_S))
        state.filtered_target = motion.end_target
        state.stamp_ns = now_ns
        if sample.brake_gap or sample.emergency or math.isnan(sample.brake_command):
            state.certain_ns = now_ns + self._settling_ns
        state.unbraked_s += seconds(now_ns - start_ns)
        # At standstill the measured speed is zero without noise.
        state.noise.add(sample.speed, sample.dt if sample.speed >= self._min_speed else math.nan)
        state.observable = False
        return motion

    def _move_timing(self, now_ns: int) -> None:
        """Apply the estimated errors of dead time and lag while the brake is released."""
        timing = self.state.timing
        if not timing.has_acted or not timing.is_idle(self.state.commands, now_ns):
            return
        e, variances, f = self.posterior.errors, self.posterior.error_variances, max(self.posterior.rate, MIN_RATE)
        delay, lag = timing.delay, timing.lag
        stds = math.sqrt(variances[DELAY]) / f, math.sqrt(variances[LAG]) / f
        timing.move((e[DELAY] / f, e[LAG] / f), stds, self._brake)
        applied = (f * (timing.delay - delay), f * (timing.lag - lag))
        self.posterior.recentre((applied[0], applied[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self.state.is_mistimed = bool(self.timing_finding)

    def _interval(self, sample: Sample, motion: BrakeStep) -> Transition:
        state = self.state
        before, state.gain = state.gain, self._model.gain(sample)
        return self._model.interval(
            sample,
            motion,
            rate=self.posterior.rate,
            before=before,
            gain=state.gain,
            variance=state.disturbance.variance,
        )

    def _learn_disturbance(self, sample: Sample, interval: Transition, braking: float) -> None:
        """Update the size of b if no other uncertain force acts; ``braking`` is the brake acceleration [m/s^2]."""
        state = self.state
        if braking > _MAX_RESIDUAL_BRAKING or interval.q_v / interval.dt - self._white > self._max_traction_variance:
            state.disturbance.running = False
            return
        e, gain_e = self.posterior.errors, interval.gain_e
        known = interval.known + (gain_e[ROLLING] * e[ROLLING] + gain_e[AIR] * e[AIR] + gain_e[TRACTION] * e[TRACTION])
        state.disturbance.add(interval, known, sample.speed, state.noise.variance)

    def _reinit_motion(self, sample: Sample, elapsed: float) -> None:
        """Restart the train state from the measured speed after ``elapsed`` [s]; f is unchanged."""
        state, start = self.state, self._start
        state.gain = self._model.gain(sample)
        start.speed, start.target = sample.speed, state.gain * state.filtered_target
        start.variances = (state.noise.variance, _REINIT_BRAKE_STD * _REINIT_BRAKE_STD, state.disturbance.variance)
        self._model.forget(elapsed, 0.0, start.decay_e, start.q_e)
        self.posterior.reinit_motion(start)
        state.position = sample.position
        state.rejected_in_a_row = 0

    def _follow_position(self, sample: Sample) -> None:
        """Integrate the filtered speed and correct towards the odometer (which gives no information on f)."""
        state, measured = self.state, sample.position
        if math.isnan(measured) or math.isnan(state.position):
            state.position = measured
            return
        position = state.position + sample.direction * self.posterior.speed * sample.dt
        state.position = position + _POSITION_GAIN * (measured - position)

    def _gate(self, sample: Sample) -> Rejection | None:
        """Return a rejection if the innovation, relative to the complete posterior, exceeds the gate."""
        state = self.state
        expected, variance = self.posterior.predicted()
        variance += self._noise_variance()
        innovation = sample.speed - expected
        limit = self._gate_stds * math.sqrt(variance)
        state.innovation, state.innovation_variance = innovation, variance
        state.test_ratio = (innovation / limit) * (innovation / limit)
        if abs(innovation) <= limit:
            state.rejected_in_a_row = 0
            return None
        state.rejected_in_a_row += 1
        return Rejection(sample.stamp_ns, Reason.OUTLIER, innovation, limit)

    def _noise_variance(self) -> float:
        """Return the variance of measured speed, scaled to match the innovations while braking [(m/s)^2]."""
        return self.state.noise.variance * self.state.excess

    def _std(self, rate: float, variance: float) -> float:
        """Return the standard deviation of a brake rate [1]: sqrt(s^2 + drift^2 t) while no brake acts."""
        scale = self._scale_std * rate
        return math.sqrt(variance + self._q * self.state.unbraked_s + scale * scale)

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [m/s] and its variance before it [(m/s)^2], as in the estimate."""
        return self.state.innovation, self.state.innovation_variance

    def estimate(self, speed: float) -> BrakeRateEstimate:
        """Return the brake rate, eq. (19), and the filtered train state, eq. (22), for a train at a speed [m/s]."""
        state, posterior = self.state, self.posterior
        rate, variance = state.rate, state.rate_variance
        if speed < self._min_speed:  # the next braking counts, also where samples were rejected on the way to the stop
            rate, variance = posterior.rate, posterior.variance
        return BrakeRateEstimate(
            brake_rate=min(max(0.0, rate), self._max_rate),
            brake_rate_std=self._std(rate, variance),
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
