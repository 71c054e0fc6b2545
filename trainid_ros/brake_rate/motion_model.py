# SPDX-License-Identifier: Apache-2.0
"""Motion model of the train over one sample, linear in the brake rate f and in the errors of the train file.

With the brake's lagged target y, its integral s over the sample, the acceleration A by traction, the gradient plus all
known extra resistance i, the Davis resistance w(v) = w0 + w1 v + w2 v^2, and k = g0 / (1000 (1 + gamma)), the inverse
of the specific inertia,

    v' - v = f r s + gain_e e + A dt - k (i + w(v)) dt,

where r is the brake rate by the table and the effects of the train file, and the errors e act with the gains

    gain_e = [r ds/dT, r ds/dtau, -k (w0 + w1 v) dt, -k w2 v^2 dt, A dt, r s p(v), r s m(v), -dt].

p rises from -1/2 at rest to 1/2 at full speed; m is 1 at the speed at which electric and friction brakes change over,
0 at rest and at twice that speed. The last error is that of the brake at its level, because valves act in steps.

The acceleration a by the brake follows ``tau a' = -a + f u(t - T)`` with dead time T and lag tau (Zheng et al. 2015,
eq. (1), with T for the printed tau in the argument).
The command u is piecewise constant, so over any interval the response is exact:

    a_end = decay * a_start + f * gain_a,      v gains  a_start * reach + f * gain_v.

Dead time T and lag tau may be wrong in a train file. The integral s(T, tau) is computed for T +- h and tau +- h. By
statistical linearisation its differences give the gains of speed by their errors, for f = 1:

    gain_T = (s(T + h, tau) - s(T - h, tau)) / 2 h,

and the remaining variance, for an error with standard deviation h, is half the square of the second difference.
Whenever the brake is released, T and tau are set to their estimates, and h to their standard deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Protocol

from trainid_ros.estimators.settings import BrakeRateConfig
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.vectors import vec
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import CommandHistory, actuator_response, lag_integral, lag_response
from trainid_ros.train.train_file import Brake, TrainFile

Errors = tuple[float, float, float, float, float, float, float, float]
NO_ERRORS: Errors = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # gains, variances or means of e that are zero
_UNCHANGED: Errors = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)  # decays of e that does not change
ERRORS: Final = 8  # number of errors e
# Indices of the errors e.
DELAY: Final = 0  # of the dead time, times f [s]
LAG: Final = 1  # of the lag, times f [s]
ROLLING: Final = 2  # of w0 + w1 v, as a share [1]
AIR: Final = 3  # of w2 v^2, as a share [1]
TRACTION: Final = 4  # of the traction, as a share [1]
SLOPE: Final = 5  # of the change of the brake rate from rest to full speed [1]
CHANGEOVER: Final = 6  # of its change where electric and friction brakes change over [1]
LEVEL: Final = 7  # of the brake at its level [m/s^2]
STATES: Final = 11  # number of states x = [v, a, b, e]


class Transition:
    """Motion of the train over one sample of dt [s], linear in x = [v, a, b, e] and the brake rate f.

    v' = v + reach a + dt b + gain_e e + gain_v f + known,   a' = decay a + gain_a f,   b' = rho b,   e' = decay_e e.

    v is the speed [m/s], a the acceleration by the brake [m/s^2], b a disturbance along the line [m/s^2], e the errors
    of the train file, shape (8,). The gains reach [s] and gain_e [m/s per unit] are those of speed, gain_v [m/s] and
    gain_a [m/s^2] those by the command at f = 1, known [m/s] that by all known forces; decay, rho and decay_e are the
    shares left at the end [1]. q_v [(m/s)^2], q_b [(m/s^2)^2] and q_e are the variances added to v, b and e. The
    steadiness is 1 while the response of the brake is constant, towards 0 while it changes [1].
    """

    def __init__(
        self,
        dt: float,
        reach: float,
        decay: float,
        gain_v: float,
        gain_a: float,
        rho: float,
        known: float,
        q_v: float,
        q_b: float,
        gain_e: Errors = NO_ERRORS,
        decay_e: Errors = _UNCHANGED,
        q_e: Errors = NO_ERRORS,
        steadiness: float = 1.0,
    ) -> None:
        self.dt, self.reach, self.decay, self.gain_v, self.gain_a = dt, reach, decay, gain_v, gain_a
        self.rho, self.known, self.q_v, self.q_b, self.steadiness = rho, known, q_v, q_b, steadiness
        self.gain_e, self.decay_e, self.q_e = vec[float](gain_e), vec[float](decay_e), vec[float](q_e)


class Start:
    """Restart of speed v [m/s], brake acceleration a = f target [m/s^2] and disturbance b = 0.

    The variances are those of v [(m/s)^2], of a given f and of b [(m/s^2)^2]. For decay_e and q_e of the errors see
    :class:`Transition`.
    """

    def __init__(
        self,
        speed: float,
        target: float,
        variances: tuple[float, float, float],
        decay_e: Errors = _UNCHANGED,
        q_e: Errors = NO_ERRORS,
    ) -> None:
        self.speed, self.target, self.variances = speed, target, variances
        self.decay_e, self.q_e = vec[float](decay_e), vec[float](q_e)


class Posterior(Protocol):
    """The joint distribution of f and of the motion x = [v, a, b, e]: Gaussian, mixture or particles."""

    @property
    def rate(self) -> float:
        """Mean of f [1]."""

    @property
    def variance(self) -> float:
        """Variance of f at its last update [1]."""

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1], the brake rate at this speed and level; share of shape (8,)."""

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""

    @property
    def effective(self) -> float:
        """Effective number of hypotheses [1]; 1 for a Gaussian."""

    @property
    def errors(self) -> Errors:
        """Means of the errors e."""

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors e."""

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior: mean and std of f [1], and standard deviations of the errors, whose mean is zero."""

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b; f is unchanged."""

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval; f is constant."""

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v over all hypotheses."""

    def follow(self, speed: float, r: float) -> None:
        """Update all states except f with a measured speed [m/s] of variance r [(m/s)^2]."""

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update all states and f with a measured speed [m/s] of variance r [(m/s)^2], after :meth:`predict`.

        f has drifted over ``elapsed`` [s], the time since its last update. Return False if a number is no longer
        finite; the posterior is then unchanged.
        """


# Smallest step of a difference quotient; below it rounding dominates [s].
_MIN_SPREAD: Final = 0.02
# A time constant stays above this share of that of the train file [1].
_MIN_LAG: Final = 0.25


class BrakeStep:
    """Exact response over an interval for f = 1, see the module; decay, reach and the gains as in :class:`Transition`.

    Attributes:
        start_target: Brake acceleration at the start [m/s^2].
        end_target: Brake acceleration at the end [m/s^2].
        integral: Gain of speed by the brake, s [m/s].
        delay_gain: Gain of speed by an error of the dead time [m/s per s].
        lag_gain: Gain of speed by an error of the lag [m/s per s].
        variance: Remaining variance of speed by these errors [(m/s)^2].
        is_released: Whether the brake is released, so that traction may begin that the reported force does not show.
    """

    def __init__(self, decay: float, reach: float, gain_a: float, gain_v: float, start_target: float) -> None:
        self.decay, self.reach, self.gain_a, self.gain_v = decay, reach, gain_a, gain_v
        self.start_target, self.end_target = start_target, decay * start_target + gain_a
        self.integral = reach * start_target + gain_v
        self.delay_gain = self.lag_gain = self.variance = 0.0
        self.is_released = False


def brake_step(
    commands: CommandHistory, delay: float, tau: float, start_ns: int, end_ns: int, start_target: float
) -> BrakeStep:
    """Return the response over (start, end] [ns] to commands after a dead time, with a time constant [s], eq. (1)."""
    a, v = _response(commands, start_ns, end_ns, 0.0, delay, tau)
    elapsed = seconds(end_ns - start_ns)
    return BrakeStep(lag_response(1.0, 0.0, tau, elapsed), lag_integral(1.0, 0.0, tau, elapsed), a, v, start_target)


@dataclass
class Timing:
    """Estimates of dead time and lag."""

    delay: float  # Dead time [s]
    lag: float  # Time constant [s]
    delay_std: float  # Standard deviation h of the dead time [s]; 0: known exactly
    lag_std: float  # Standard deviation h of the time constant [s]
    later: float = 0.0  # Lagged target of a brake of rate 1 with T + h [m/s^2]
    sooner: float = 0.0  # The same with T - h
    slower: float = 0.0  # The same with tau + h
    faster: float = 0.0  # The same with tau - h
    has_acted: bool = False  # Whether the brake has acted since the last update

    def is_idle(self, commands: CommandHistory, stamp_ns: int) -> bool:
        """Return whether no command acts, acted recently, or is still pending for any possible dead time."""
        # A target of less than 1e-4 m/s^2 has no effect.
        if commands.value(stamp_ns) != 0.0 or min(self.later, self.sooner, self.slower, self.faster) < -1e-4:
            return False
        longest_ns = round((self.delay + self.delay_std) * NS_PER_S)
        return not commands.changes or commands.changes[-1].stamp_ns < stamp_ns - longest_ns

    def release(self) -> None:
        """Set the targets to those of a released brake."""
        self.later = self.sooner = self.slower = self.faster = 0.0

    def move(self, errors: tuple[float, float], stds: tuple[float, float], brake: Brake) -> None:
        """Correct by estimated errors of T and tau with standard deviations [s], while the brake is released."""
        self.delay = max(0.0, self.delay + errors[0])
        self.lag = max(_MIN_LAG * brake.time_constant, self.lag + errors[1])
        self.delay_std, self.lag_std = _spread(stds[0], self.delay_std), _spread(stds[1], self.lag_std)
        self.release()
        self.has_acted = False

    def follow(self, commands: CommandHistory, start_ns: int, end_ns: int, motion: BrakeStep) -> None:
        """Propagate the targets over (start, end] [ns]; give the nominal response its gains by timing errors."""
        if self.is_idle(commands, end_ns):
            self.release()
            return
        T, tau, h_T, h_tau = self.delay, self.lag, self.delay_std, self.lag_std
        shorter, less = max(0.0, T - h_T), max(_MIN_LAG * tau, tau - h_tau)
        self.later, later = _response(commands, start_ns, end_ns, self.later, T + h_T, tau)
        self.sooner, sooner = _response(commands, start_ns, end_ns, self.sooner, shorter, tau)
        self.slower, slower = _response(commands, start_ns, end_ns, self.slower, T, tau + h_tau)
        self.faster, faster = _response(commands, start_ns, end_ns, self.faster, T, less)
        motion.delay_gain = (later - sooner) / max(T + h_T - shorter, _MIN_SPREAD)
        motion.lag_gain = (slower - faster) / max(tau + h_tau - less, _MIN_SPREAD)
        by_delay, by_lag = later + sooner - 2.0 * motion.integral, slower + faster - 2.0 * motion.integral
        motion.variance = 0.5 * (by_delay * by_delay) + 0.5 * (by_lag * by_lag)
        self.has_acted = True


def _response(
    commands: CommandHistory, start_ns: int, end_ns: int, target: float, delay: float, lag: float
) -> tuple[float, float]:
    """Return a target at the end of (start, end] [m/s^2], and its integral over it [m/s]."""
    return actuator_response(commands, start_ns, end_ns, target, delay_ns=round(delay * NS_PER_S), time_constant=lag)


def _spread(std: float, before: float) -> float:
    return min(max(std, _MIN_SPREAD), before) if before > 0.0 else 0.0


MIN_RATE: Final = 0.05  # lower limit of a brake rate that is used as a divisor [1]
BLEND_SHAPE: Final = 0.7  # error of the shape of the changeover between brakes, as a share of its size [1]
# Least std of dead time and lag [s]: a vehicle bus sends every 0.1 s.
_MIN_TIMING_STD: Final = 0.03
# Timing jitter of brake changes per relative error of the timing [s].
_JITTER_S: Final = 0.4
# Variation between changeovers, as a share of their size, and its correlation time [s].
_BLEND_VARIES: Final = 0.5
_BLEND_S: Final = 1.0
# Correlation times of the errors of dead time, lag, slope and changeover, and of resistance and traction [s].
_LONG_S: Final = 1e5
_SHORT_S: Final = 1800.0
# Relative change of the response per second at which its steadiness is 1/e [1/s].
_CHANGING: Final = 0.1
# Smallest brake level with a level error [m/s^2].
_MIN_LEVEL: Final = 0.08


def rate_slope(speed: float, max_speed: float) -> float:
    """Return p at a speed [m/s], see the module; above the maximum speed it stays constant."""
    return min(speed / max_speed, 1.0) - 0.5


def rate_changeover(speed: float, blend_speed: float) -> float:
    """Return m at a speed [m/s], see the module; 1 at that of the changeover."""
    return max(0.0, 1.0 - abs(speed / blend_speed - 1.0))


class MotionModel:
    """Train and line according to the train file.

    Attributes:
        stds: Standard deviations of the errors e.
        timing_stds: Standard deviations of dead time and lag that may be learned [s].
        disturbance_std: Std of the unmodelled acceleration, including the map error [m/s^2].
    """

    def __init__(self, train_file: TrainFile, config: BrakeRateConfig) -> None:
        self.brake = true_brake(train_file)
        # The brake has its scale already.
        effects = tuple(effect for effect in train_file.effects if effect.name != 'brake_scale' or effect.runs)
        self.known = KnownForce(replace(train_file, brake=self.brake, effects=effects))
        self.inertia = self.known.inertia
        self._resistance, train = train_file.resistance, train_file.train
        self._max_speed, self._timing_std = train.max_speed, train_file.brake.timing_std
        self.disturbance_std = math.hypot(config.disturbance_std, train_file.line.gradient_std / self.inertia)
        # Relative to the delay stated in the file, because the effect brake_delay was measured.
        delay, lag = (max(std, _MIN_TIMING_STD) if std > 0.0 else 0.0 for std in train_file.brake.timing_stds)
        self.timing_stds = delay, lag
        # Settings that each sample needs.
        self._length, self._white = config.disturbance_length, config.acceleration_noise**2
        self._force_error, self._min_braking = config.force_error, config.min_braking
        self._blend_speed, self._blend_std, self._level_length = (
            config.blend_speed, config.blend_std, config.level_length
        )  # fmt: skip
        force, resistance = math.hypot(train.mass_std, train.force_std), config.resistance_std
        self.stds: Errors = (
            self.brake.rate * delay, self.brake.rate * lag, resistance, resistance, force,
            config.slope_std, config.blend_std, config.level_std,
        )  # fmt: skip
        self._stds, self._share = vec[float](self.stds), vec[float]([0.0] * ERRORS)
        self._interval = Transition(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def gain(self, sample: Sample) -> float:
        """Return the brake rate by the table and the effects of the train file for f = 1 [1]."""
        return max(self.known.brake_share(sample) * self.brake.shape_at(sample.speed), MIN_RATE)

    def interval(
        self, sample: Sample, motion: BrakeStep, *, rate: float, before: float, gain: float, variance: float
    ) -> Transition:
        """Return the motion model since the last sample, valid until the next call; missing forces count as zero.

        Args:
            sample: The sample.
            motion: Response of the brake.
            rate: Estimated brake rate [1].
            before: :meth:`gain` at the last sample [1].
            gain: The same at this one [1].
            variance: Variance of the disturbance [(m/s^2)^2].
        """
        step, dt, v, w = self._interval, sample.dt, sample.speed, self._resistance
        # The reported force is traction minus a nominal brake, behind which traction may begin unseen.
        traction = self.known.traction(sample.force_mean, sample) / self.inertia
        if sample.brake_command >= 0.0 and (motion.is_released or traction > 0.0):
            traction -= motion.integral / dt
        traction = traction if traction > 0.0 else 0.0
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
        share = self.share(v, 0.0)
        step.q_v = slack * dt + rate * rate * self._timing_variance(motion, dt, share[CHANGEOVER])
        step.q_b = variance * (1.0 - rho * rho)
        gain_e, braked = step.gain_e, gain * motion.integral
        gain_e[DELAY], gain_e[LAG] = gain * motion.delay_gain, gain * motion.lag_gain
        gain_e[ROLLING], gain_e[AIR], gain_e[TRACTION] = -rolling * dt, -air * dt, traction * dt
        gain_e[SLOPE], gain_e[CHANGEOVER] = braked * share[SLOPE], braked * share[CHANGEOVER]
        gain_e[LEVEL] = -dt if motion.end_target <= -_MIN_LEVEL else 0.0
        self.forget(dt, motion.end_target - motion.start_target, step.decay_e, step.q_e)
        step.steadiness = self._steadiness(motion, dt)
        return step

    def _timing_variance(self, motion: BrakeStep, dt: float, changeover: float) -> float:
        """Return the variance of speed by timing and variation between changeovers, for f = 1 [(m/s)^2]; with m [1]."""
        level = motion.end_target
        early = _JITTER_S * self._timing_std * (level - motion.start_target)
        blend = _BLEND_VARIES * self._blend_std * changeover * level
        return motion.variance + early * early + 2.0 * _BLEND_S * dt * blend * blend

    def _steadiness(self, motion: BrakeStep, dt: float) -> float:
        """Return the steadiness of the response: 1 while it is constant, towards 0 while it changes."""
        change = abs(motion.end_target - motion.start_target)
        if change == 0.0:
            return 1.0
        slow = dt * max(abs(motion.end_target), self._min_braking) * _CHANGING
        return math.exp(-change / slow) if slow > 0.0 else 0.0

    def share(self, speed: float, level: float) -> vec[float]:
        """Return the shares of the errors in the brake rate at a speed [m/s] and level [m/s^2, >= 0], shape (8,).

        It is valid until the next call.
        """
        share = self._share
        share[SLOPE] = rate_slope(speed, self._max_speed)
        share[CHANGEOVER] = rate_changeover(speed, self._blend_speed)
        share[LEVEL] = 1.0 / level if level >= _MIN_LEVEL else 0.0
        return share

    def forget(self, elapsed: float, change: float, decay_e: vec[float], q_e: vec[float]) -> None:
        """Write the decay of the errors over a time [s] and a change of level [m/s^2], and the variances added."""
        slow, fast = math.exp(-elapsed / _LONG_S), math.exp(-elapsed / _SHORT_S)
        decay_e[DELAY] = decay_e[LAG] = decay_e[SLOPE] = decay_e[CHANGEOVER] = slow
        decay_e[ROLLING] = decay_e[AIR] = decay_e[TRACTION] = fast
        decay_e[LEVEL] = math.exp(-abs(change) / self._level_length)
        for j in range(ERRORS):
            q_e[j] = (1.0 - decay_e[j] * decay_e[j]) * self._stds[j] * self._stds[j]


def true_brake(train_file: TrainFile) -> Brake:
    """Return the brake with the effects of the train file applied (brake_scale, brake_delay)."""
    brake, effects = train_file.brake, train_file.effects
    rate = brake.rate * effect_value(effects, 'brake_scale', 'ratio', 1.0)
    return replace(brake, rate=rate, delay=brake.delay + effect_value(effects, 'brake_delay', 'extra', 0.0))
