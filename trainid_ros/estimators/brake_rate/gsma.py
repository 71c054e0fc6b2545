# SPDX-License-Identifier: Apache-2.0
"""GSMA: brake rate by the group stochastic M-algorithm, a Rao-Blackwellised particle filter.

After Zheng et al. 2015, section 3.5 and eqs. (14)-(22), with these corrections:

* A particle's group is {f - h, f, f + h} around its own value with prior weights 1/6, 2/3, 1/6 and
  h = sqrt(3 q dt): every value has its group (the paper leaves one out), none is bound to a grid, and the
  transition has the variance of a random walk per second instead of a grid step per sample.
* Weights carry over: w_k = w_{k-1} p(f_k | f_{k-1}) N(y_k); pruning is systematic resampling.
* The command passes an exact dead time (the paper: first-order Pade); a_z is then known and needs no state.
* f acts on a known input only, so all particles share one covariance (one Riccati equation).
* b, an unmodelled acceleration that decorrelates over distance (gradient map, wind), is a state: without it
  it would be taken for brake rate. The gradient and running resistance that are known act as input.
* Standstill and traction never feed f. While no brake acts, its variance grows by q per second, exactly.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import BrakeRateEstimate, Reason, Refusal
from trainid_ros.core.samples import BrakeCommandChange
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.estimators.brake_rate.brake_kinematics import BrakeStep, brake_step
from trainid_ros.estimators.brake_rate.resampling import effective_number, normalise, systematic
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.physics.brake import CommandHistory
from trainid_ros.physics.effects import effect_value
from trainid_ros.physics.resistance import davis

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.physics.train_file import Brake, TrainFile

_GROUP: Final = np.array([-1.0, 0.0, 1.0])
_GROUP_LOG_PRIOR: Final = np.log([1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0])
_LARGEST_RATE: Final = 3.0  # times the believed one
# The brake is known again this many time constants after its command is.
_SETTLING: Final = 6.0
_POSITION_GAIN: Final = 0.1
# Doubt about the brake's acceleration where the train state starts anew [m/s^2].
_ANCHOR_BRAKE_STD: Final = 0.05
_ANCHORING: Final = frozenset({Reason.GAP, Reason.STANDSTILL, Reason.BRAKE_COMMAND_MISSING, Reason.BRAKE_UNCERTAIN})
_HISTORY_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class GsmaConfig:
    """Settings of GSMA."""

    particles: int = setting(300, 'particles kept after pruning', '1', 2, 100_000)
    prior_std: float = setting(0.2, 'prior standard deviation of the brake rate', '1', 1e-4, 2.0)
    drift: float = setting(0.003, 'drift of the brake rate in one second, standard deviation', '1', 0.0, 1.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.006, 'unmodelled acceleration', 'm/s^2', 0.0, 1.0)
    disturbance_length: float = setting(200.0, 'distance over which it decorrelates', 'm', 1.0, 1e5)
    acceleration_noise: float = setting(0.003, 'white acceleration noise', 'm/s per sqrt(s)', 0.0, 1.0)
    force_error: float = setting(0.01, 'relative error of the traction force', '1', 0.0, 0.5)
    min_speed: float = setting(0.5, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    min_braking: float = setting(0.03, 'weakest braking to learn from', 'm/s^2', 0.0, 5.0)
    gate: float = setting(5.0, 'innovations beyond this many standard deviations are refused', '1', 1.0, 100.0)
    readmit_after: int = setting(5, 'refused samples in a row after which the speed is believed', 'samples', 1, 1000)
    valid_std: float = setting(0.05, 'brake rate is fit to use below this standard deviation', '1', 1e-3, 1.0)


@dataclass(frozen=True, slots=True)
class GsmaState:
    """All that GSMA remembers, the generator's state excepted (it is saved beside).

    Attributes:
        f: Brake rate of each particle, shape (N,) or, not pruned yet, (3N,).
        log_weights: Normalised log-weights, same shape.
        x: Speed [m/s], brake acceleration and disturbance b [m/s^2] of each particle, one row each.
        P: Covariance of x, shared by all particles, shape (3, 3).
        noise: Noise of the measured speed.
        unbraked_s: Time since f last learned [s].
        certain_ns: Stamp from which on the brake's state is known again after commands were missed.
        filtered_target: Command after dead time and lag of a nominal brake [m/s^2].
        random: State of the generator as JSON text, filled in when saved.

    """

    f: NDArray[np.float64]
    log_weights: NDArray[np.float64]
    x: NDArray[np.float64]
    P: NDArray[np.float64]
    noise: SpeedNoise
    commands: tuple[BrakeCommandChange, ...] = ()
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
    random: str = ''


class Gsma:
    """Estimate the brake rate f = actual over expected braking from aligned samples."""

    def __init__(self, train_file: TrainFile, config: GsmaConfig, rng: np.random.Generator) -> None:
        check_settings(config)
        self.config = config
        self._train_file = train_file
        self._brake = _true_brake(train_file)
        self._known = KnownForce(train_file)
        self._rng = rng
        self._random0 = json.dumps(rng.bit_generator.state)
        self.reset()

    def reset(self) -> None:
        """Go back to the prior: particles at its quantiles, equal weights."""
        N = self.config.particles
        # The standard library's normal distribution: importing SciPy's would take longer than all the rest.
        prior = NormalDist(self._brake.rate, self.config.prior_std)
        f = np.array([max(0.0, prior.inv_cdf((i + 0.5) / N)) for i in range(N)])
        self.state = GsmaState(
            f=f,
            log_weights=np.full(N, -math.log(N)),
            x=np.zeros((N, 3)),
            P=np.zeros((3, 3)),
            noise=SpeedNoise.declared(self.config.speed_std),
        )
        self._rng.bit_generator.state = json.loads(self._random0)

    def save(self) -> str:
        """Return the whole state, generator included, as JSON text."""
        return encode(replace(self.state, random=json.dumps(self._rng.bit_generator.state)))

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, GsmaState)
        if len(state.f) not in (self.config.particles, len(_GROUP) * self.config.particles):
            msg = f'saved GsmaState has {len(state.f)} particles, not {self.config.particles}'
            raise InputError(msg)
        finite = all(bool(np.isfinite(item).all()) for item in (state.f, state.x, state.P))
        N = len(state.f)
        sized = (state.log_weights.shape, state.x.shape, state.P.shape) == ((N,), (N, 3), (3, 3))
        check_restored(finite and sized, 'GsmaState', 'f, x or P')
        try:
            self._rng.bit_generator.state = json.loads(state.random)
        except (ValueError, TypeError, KeyError) as error:
            msg = f'saved GsmaState: random cannot be read: {error}'
            raise InputError(msg) from None
        self.state = replace(state, random='')

    @property
    def converged(self) -> bool:
        """True while the brake rate is known well enough."""
        return self.state.converged

    def step(self, sample: Sample) -> BrakeRateEstimate | Refusal:
        """Take one sample in; f learns only while the brake acts on a moving train."""
        motion = self._follow_command(sample)
        refusal = self._refuse(sample)
        if refusal is not None:
            if refusal.reason in _ANCHORING:
                self._anchor(sample)
            else:
                known = self._known_acceleration(sample)
                self._coast(sample, motion, known if math.isfinite(known) else 0.0, measured=False)
            self._judge()
            return refusal
        self._follow_position(sample)
        known = self._known_acceleration(sample)
        braking = max(abs(self.state.filtered_target), abs(motion.start_target))
        if braking < self.config.min_braking:
            self._coast(sample, motion, known, measured=True)
            self._judge()
            return Refusal(sample.stamp_ns, Reason.NOT_BRAKING, braking, self.config.min_braking)
        refusal = self._learn(sample, motion, known)
        self._judge()
        return refusal or self.estimate(sample.speed)

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
        state, brake = self.state, self._brake
        if sample.stamp_ns <= state.stamp_ns:  # another time base: commands of the old one mean nothing in it
            state = replace(state, commands=(), filtered_target=0.0, certain_ns=0, stamp_ns=0)
        start_ns = state.stamp_ns or sample.stamp_ns
        history = CommandHistory(state.commands)
        for change in sample.brake_changes:
            if not history.changes or change.stamp_ns >= history.changes[-1].stamp_ns:
                history = history.push(change)
        motion = brake_step(history, brake, start_ns, sample.stamp_ns, state.filtered_target)
        settled_ns = sample.stamp_ns + round((brake.delay + _SETTLING * brake.time_constant) * NS_PER_S)
        unsure = sample.brake_gap or sample.emergency or math.isnan(sample.brake_command)
        elapsed_s = (sample.stamp_ns - start_ns) / NS_PER_S
        self.state = replace(
            state,
            commands=history.prune(sample.stamp_ns - round((brake.delay + _HISTORY_S) * NS_PER_S)).changes,
            filtered_target=motion.end_target,
            stamp_ns=sample.stamp_ns,
            certain_ns=settled_ns if unsure else state.certain_ns,
            unbraked_s=state.unbraked_s + elapsed_s,
            # A train at rest reads zero without noise.
            noise=state.noise.add(sample.speed, sample.dt if sample.speed >= self.config.min_speed else math.nan),
            observable=False,
        )
        return motion

    def _known_acceleration(self, sample: Sample) -> float:
        """Acceleration by traction, gradient, running resistance and modelled effects [m/s^2]."""
        traction = self._known.traction(max(sample.force_mean, 0.0), sample)
        resistance = davis(self._train_file.resistance, sample.speed)
        return (traction - self._known.track(sample) - resistance) / self._known.inertia

    def _anchor(self, sample: Sample) -> None:
        """Start the train state anew from the measured speed; f stands."""
        state, config = self.state, self.config
        x = np.zeros_like(state.x)
        x[:, 0] = sample.speed
        x[:, 1] = state.f * state.filtered_target
        P = np.diag(np.square([state.noise.std, _ANCHOR_BRAKE_STD, config.disturbance_std]))
        self.state = replace(state, x=x, P=P, position=sample.position, refused_in_a_row=0)

    def _follow_position(self, sample: Sample) -> None:
        """Dead-reckon by filtered speed, pulled towards the odometer (which adds nothing to f)."""
        state, measured = self.state, sample.position
        if math.isnan(measured) or math.isnan(state.position):
            self.state = replace(state, position=measured)
            return
        position = state.position + sample.direction * self._mean(state.x[:, 0]) * sample.dt
        position += _POSITION_GAIN * (measured - position)
        self.state = replace(state, position=position)

    def _mean(self, values: NDArray[np.float64]) -> float:
        return float(np.exp(self.state.log_weights) @ values)

    def _predict(
        self, x: NDArray[np.float64], f: NDArray[np.float64], motion: BrakeStep, known: float, sample: Sample
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Eq. (14): x = Phi x + f Gamma + known input, and its covariance, which f does not enter."""
        config, dt = self.config, sample.dt
        rho = math.exp(-sample.speed * dt / config.disturbance_length)
        Phi = np.array([[1.0, motion.reach, dt], [0.0, motion.decay, 0.0], [0.0, 0.0, rho]])
        force = sample.force_mean if sample.force_mean > 0.0 else 0.0
        slack = config.force_error * self._known.traction(force, sample) / self._known.inertia
        Q = np.diag(
            [(config.acceleration_noise**2 + slack**2) * dt, 0.0, config.disturbance_std**2 * (1.0 - rho * rho)]
        )
        predicted = x @ Phi.T + np.outer(f, [motion.gain_v, motion.gain_a, 0.0]) + [known * dt, 0.0, 0.0]
        return predicted, Phi @ self.state.P @ Phi.T + Q

    def _update(
        self, x: NDArray[np.float64], P: NDArray[np.float64], nu: NDArray[np.float64], S: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Eqs. (20), (21): one gain for all particles; Joseph form for the covariance."""
        K = P[:, 0] / S
        A = np.eye(3)
        A[:, 0] -= K
        return x + np.outer(nu, K), A @ P @ A.T + self.state.noise.variance * np.outer(K, K)

    def _coast(self, sample: Sample, motion: BrakeStep, known: float, *, measured: bool) -> None:
        """Follow the train while f is not observable: f stands, its uncertainty grows with time."""
        state = self.state
        x, P = self._predict(state.x, state.f, motion, known, sample)
        self.state = replace(state, x=x, P=P)
        if not measured:
            return
        S = float(P[0, 0]) + self.state.noise.variance
        nu = sample.speed - x[:, 0]
        if self._gate(nu, S, sample, state.log_weights) is not None:
            self._readmit(sample)
            return
        x, P = self._update(x, P, nu, S)
        self.state = replace(self.state, x=x, P=P)

    def _learn(self, sample: Sample, motion: BrakeStep, known: float) -> Refusal | None:
        """One step of GSMA, eqs. (14)-(22)."""
        config = self.config
        self._prune()
        state = self.state
        # This step's own drift is that of the groups.
        f = self._widened(max(0.0, state.unbraked_s - sample.dt))
        h = math.sqrt(3.0 * sample.dt) * config.drift
        # Every particle branches within its group; weights carry over (17).
        f = (f[:, None] + h * _GROUP).ravel()
        log_weights = (state.log_weights[:, None] + _GROUP_LOG_PRIOR).ravel()
        x, P = self._predict(np.repeat(state.x, len(_GROUP), axis=0), f, motion, known, sample)
        S = float(P[0, 0]) + state.noise.variance  # (16)
        nu = sample.speed - x[:, 0]  # (15)
        if (refusal := self._gate(nu, S, sample, log_weights)) is not None:
            self._coast(sample, motion, known, measured=False)
            self._readmit(sample)
            return refusal
        possible = (f >= 0.0) & (f <= _LARGEST_RATE * self._brake.rate)
        log_weights = np.where(possible, log_weights - 0.5 * nu * nu / S, -np.inf)
        log_weights = normalise(log_weights)  # (18), by the sum
        x, P = self._update(x, P, nu, S)
        if not (np.isfinite(x).all() and np.isfinite(P).all()):
            return Refusal(sample.stamp_ns, Reason.NUMERICAL, float(nu[0]), math.nan)
        self.state = replace(
            self.state, f=f, log_weights=log_weights, x=x, P=P, unbraked_s=0.0, observable=True
        )
        return None

    def _prune(self) -> None:
        """Keep N of the particles by systematic resampling, which favours none.

        In the order of f the survivors are nearly its quantiles, so that pruning adds little noise.
        """
        state, N = self.state, self.config.particles
        if len(state.f) > N:
            order = np.argsort(state.f, kind='stable')
            kept = order[systematic(np.exp(state.log_weights[order]), N, float(self._rng.random()))]
            equal = np.full(N, -math.log(N))
            self.state = replace(state, f=state.f[kept], log_weights=equal, x=state.x[kept])

    def _widened(self, unbraked_s: float) -> NDArray[np.float64]:
        """Return the particles widened by what a time without braking adds to their variance."""
        f = self.state.f
        mean, std = self._mean(f), self._particle_std()
        return mean + (f - mean) * (self._grown(std, unbraked_s) / std) if std > 0.0 else f

    def _particle_std(self) -> float:
        mean = self._mean(self.state.f)
        return math.sqrt(max(0.0, self._mean(np.square(self.state.f - mean))))

    def _grown(self, std: float, unbraked_s: float) -> float:
        """Law of the uncertainty while no brake acts: sqrt(s^2 + drift^2 t)."""
        return math.hypot(std, self.config.drift * math.sqrt(unbraked_s))

    def _gate(
        self, nu: NDArray[np.float64], S: float, sample: Sample, log_weights: NDArray[np.float64]
    ) -> Refusal | None:
        """Gate on the innovation of the whole mixture."""
        weights = np.exp(log_weights)
        mean = float(weights @ nu)
        variance = S + float(weights @ np.square(nu - mean))
        limit = self.config.gate * math.sqrt(variance)
        refused = self.state.refused_in_a_row + 1 if abs(mean) > limit else 0
        self.state = replace(
            self.state,
            innovation=mean,
            innovation_variance=variance,
            test_ratio=(mean / limit) ** 2,
            refused_in_a_row=refused,
        )
        return Refusal(sample.stamp_ns, Reason.OUTLIER, mean, limit) if refused else None

    def _readmit(self, sample: Sample) -> None:
        """After several refusals in a row believe the speed again."""
        if self.state.refused_in_a_row >= self.config.readmit_after:
            self._anchor(sample)

    def _judge(self) -> None:
        """Fit to use while the uncertainty is small; hysteresis of a factor of two."""
        limit = self.config.valid_std * (2.0 if self.state.converged else 1.0)
        self.state = replace(self.state, converged=self._std() < limit)

    def _std(self) -> float:
        """Standard deviation of f now."""
        return self._grown(self._particle_std(), self.state.unbraked_s)

    def estimate(self, speed: float) -> BrakeRateEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the brake rate (19) and the filtered train state (22)."""
        state = self.state
        return BrakeRateEstimate(
            brake_rate=self._mean(state.f),
            brake_rate_std=self._std(),
            position=state.position,
            speed=max(0.0, self._mean(state.x[:, 0])),
            control_acceleration=self._mean(state.x[:, 1]),
            filtered_target=state.filtered_target,
            effective_particles=effective_number(np.exp(state.log_weights)),
            observable=state.observable,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
        )


def _true_brake(train_file: TrainFile) -> Brake:
    """Return the brake with what effects of the train file make of it (brake_scale, brake_delay)."""
    brake, effects = train_file.brake, train_file.effects
    rate = brake.rate * effect_value(effects, 'brake_scale', 'ratio', 1.0)
    return replace(brake, rate=rate, delay=brake.delay + effect_value(effects, 'brake_delay', 'extra', 0.0))
