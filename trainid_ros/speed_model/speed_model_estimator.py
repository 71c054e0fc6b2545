# SPDX-License-Identifier: Apache-2.0
"""Estimator of the speed model: admits samples, computes the known forces, runs an algorithm, returns the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final

from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.results import Reason, Rejection, SpeedModelEstimate
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, encode, restore
from trainid_ros.resistance.davis_posterior import CURVE_RADIUS, curve_std, is_accurate, representative_speeds
from trainid_ros.speed_model.am_vff_rls import (
    AuxiliaryModel,
    Learned,
    Method,
    Symmetric,
    Theta,
    full,
    prior,
    resistance_variance,
    to_physical,
)
from trainid_ros.speed_model.nuisance_parameters import CurveError, Disturbance, ForceDelay, RecentSamples
from trainid_ros.stream.known_force import Admission, KnownForce, SpeedNoise
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.estimators.settings import SpeedModelConfig
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# The range of speeds driven: memory of about half an hour, and its half-width in standard deviations.
_SPEED_SAMPLES: Final = 9000.0
_SPEED_WIDTH: Final = 1.5


@dataclass
class SpeedModelState:
    """State of an estimator of the speed model."""

    noise: SpeedNoise  # Noise of measured speed
    disturbance: Disturbance  # Strength of gusts and other unmodelled disturbances
    force_delay: ForceDelay  # Delay of the reported force
    curve: CurveError  # Error of the curve resistance
    forgetting: float = 1.0  # Last forgetting factor [1]
    predicted: float = 0.0  # Last predicted speed [m/s]
    error: float = 0.0  # Last prediction error [m/s]
    variance: float = 0.0  # Its predicted variance [(m/s)^2]
    slowest: float = 0.0  # Slowest speed used [m/s]
    fastest: float = -1.0  # Fastest speed used [m/s]; less than ``slowest`` if there is none yet
    speed_mean: float = 0.0  # Running mean of the speeds used [m/s]
    speed_variance: float = 0.0  # Their running variance [(m/s)^2]
    used: float = 0.0  # Number of samples used, up to the memory of these means
    rejected_in_a_row: int = 0  # Outliers in a row
    slow_in_a_row: int = 0  # Samples in a row below the minimum speed
    traction: float = 0.0  # Last known traction [N/kN]
    weighed: bool = False  # Whether the mass was weighed at the last sample
    fit: bool = False  # Whether the resistance is valid

    def drive(self, y: float) -> None:
        """Take a speed used [m/s] into the range and the running mean and variance of the speeds."""
        if self.fastest >= self.slowest:
            self.slowest, self.fastest = min(y, self.slowest), max(y, self.fastest)
        else:
            self.slowest = self.fastest = y
        share, off = 1.0 / min(self.used + 1.0, _SPEED_SAMPLES), y - self.speed_mean
        self.speed_mean += share * off
        self.speed_variance = (1.0 - share) * (self.speed_variance + share * (off * off))
        self.used = 1.0 / share

    def speeds_driven(self) -> tuple[float, float]:
        """Return slowest and fastest of the usual speeds [m/s]."""
        width = _SPEED_WIDTH * math.sqrt(self.speed_variance)
        return max(self.speed_mean - width, self.slowest), min(self.speed_mean + width, self.fastest)


# Slow samples in a row that indicate standstill: a single one may be an outlier.
_STANDING: Final = 3
# Largest plausible loss of speed from one sample to the next [m/s].
_MAX_SPEED_LOSS: Final = 1.0
# A detected change keeps at least the square of this share of the information.
_MIN_FACTOR: Final = 0.1
# Shortest stop at which passengers change [s].
_MIN_STOP_S: Final = 15.0
# Limit of the change of traction from sample to sample [N/kN]; beyond it is an outlier.
_MAX_CHANGE: Final = 500.0


class ModelStep:
    """One step of the model: its inputs, and what is known before it.

    Attributes:
        dt: Duration [s].
        scale: Duration in sample periods [1].
        traction: Traction at its end [N/kN].
        u: Mean traction [N/kN].
        theta: Parameters before it.
        phi: Regressor.
        acceleration_variance: Variance of the acceleration due to that of theta [(m/s^2)^2].
    """

    def __init__(self, dt: float, traction: float, u: float) -> None:
        self.dt = dt
        self.scale = dt / SAMPLE_PERIOD
        self.traction = traction
        self.u = u
        self.theta: Theta = (0.0, 0.0, 0.0, 0.0)
        self.phi: Theta = (0.0, 0.0, 0.0, 0.0)
        self.acceleration_variance = 0.0


def load_std(train_file: TrainFile, config: SpeedModelConfig) -> float:
    """Return the standard deviation of the relative change of mass at a stop without weighing [1]."""
    return min(config.load_std, train_file.train.mass_std)


class SpeedModelEstimator:
    """Run a method on samples.

    The auxiliary model has the covariance of x too: with it, the strength of the disturbances, the delay of the
    reported force and the error of the curve resistance are estimated as well.

    Args:
        train_file: Train file.
        config: Settings.
        method: Makes the algorithm from theta(0) and its covariance.
    """

    STATE: ClassVar[State] = declare('state', 'method', '_recent', '_admission')

    def __init__(
        self, train_file: TrainFile, config: SpeedModelConfig, method: Callable[[Theta, Symmetric], Method]
    ) -> None:
        check_settings(config)
        self._config = config
        self._min_speed, self._valid_std = config.min_speed, config.valid_std
        self._change_threshold, self._readmit_after = config.change_threshold, config.readmit_after
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis, train = train_file.resistance, train_file.train
        self._curve_std = curve_std(train_file)
        self._k = 1.0 / self._known.inertia
        self._rotary = 1.0 + train.rotary_mass
        mass_std = math.hypot(train.mass_std, train.force_std)
        theta0, P0 = prior((davis.a, davis.b, davis.c), self._k, config, mass_std)
        self._make_method, self._mass_variance = partial(method, theta0, P0), P0[7]
        unweighed, weighing = load_std(train_file, config), min(config.weighing_std, train.mass_std)
        self._weighed_share = (weighing / unweighed) ** 2 if unweighed > 0.0 else 0.0
        self.reset()

    def reset(self) -> None:
        """Reset to the prior."""
        config = self._config
        noise, disturbance = SpeedNoise.declared(config.speed_std), Disturbance.declared(config.acceleration_noise)
        force_delay, curve = ForceDelay.unknown(config.force_skew), CurveError(0.0, self._curve_std**2)
        self.state = SpeedModelState(noise, disturbance, force_delay, curve)
        self._recent = RecentSamples()
        self._admission.braked_ns = 0
        self._use(self._make_method())
        self.method.start(noise.variance)

    def _use(self, method: Method) -> None:
        self.method = method
        self._auxiliary = method if isinstance(method, AuxiliaryModel) else None

    def save(self) -> str:
        """Return the complete state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)
        self._update_validity(self.state, self._covariance())

    def idle(self, seconds: float) -> None:
        """Add the drift over a time without samples [s], and a change of load if the train may have stopped."""
        if self._auxiliary is not None:
            self._auxiliary.idle(seconds / SAMPLE_PERIOD)
        if seconds > _MIN_STOP_S:
            self.method.inflate_load_variance(self._load_share())
        self._update_validity(self.state, self._covariance())

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; return the reason if it is rejected."""
        self._store(sample)
        rejection = self._admission.reject(sample)
        step = self._model_step(sample)
        if rejection is not None:
            self._hold(sample.speed, step, rejection.reason)
            return rejection
        state, y = self.state, self._recent.speed(self._delay())
        noise, sensitivity, curve_x = state.noise.variance, state.force_delay.sensitivity, state.curve.x
        self._predict(step)
        learned = self.method.update(y, step.u, step.scale, noise)
        usable = self.method.is_usable()
        if usable and not learned.rejected:
            self._learn(sample, step, learned)
            return None
        # A rejected sample holds no information on delay and curve error.
        state.force_delay.sensitivity, state.curve.x = sensitivity, curve_x
        if self._auxiliary is not None:
            state.curve.bound(self._auxiliary)
        if learned.rejected:
            self._reject(y, step, learned, usable)
            return Rejection(sample.stamp_ns, Reason.OUTLIER, learned.error, learned.limit)
        b1 = self.method.theta()[2]
        self.method.start(noise)
        self.method.reinit_speed(y, 1.0)
        return Rejection(sample.stamp_ns, Reason.NUMERICAL, b1, 0.0)

    def _delay(self) -> float:
        """Return the delay of the force [s]: its speed is compared with the one measured then."""
        return self.state.force_delay.delay if self._auxiliary is not None else 0.0

    def _store(self, sample: Sample) -> None:
        """Store speed, track resistance and curvature of a sample."""
        speed, dt = sample.speed, sample.dt
        track, curve = self._known.track(sample), CURVE_RADIUS * sample.curvature
        if not (is_finite(track) and is_finite(curve)):
            track = curve = 0.0
        self.state.noise.add(speed, dt)
        self._recent.add(dt, speed, track, curve)

    def _model_step(self, sample: Sample) -> ModelStep:
        """Return the step to a sample; the mean of the traction is used for its end if the force there is missing."""
        mean = self._known.traction(sample.force_mean, sample)
        end = self._known.traction(sample.force, sample) if is_finite(sample.force) else mean
        step = ModelStep(sample.dt, end, mean)
        if self._auxiliary is not None:
            scale, x = step.scale, self._auxiliary.speed()
            step.theta, step.phi = self._auxiliary.theta(), (scale * x * x, scale * x, scale * mean, scale)
            if self.state.disturbance.elapsed == 0.0:  # a window starts
                variance = resistance_variance(self._auxiliary.covariance(0.0), sample.speed, self._k)
                step.acceleration_variance = self._k**2 * max(variance, 0.0)
        return step

    def _predict(self, step: ModelStep) -> None:
        """Apply known resistance, disturbance, force delay and curve error of a step."""
        state, delay, model = self.state, self._delay(), self._auxiliary
        change = -self._k * self._recent.track(delay) * step.dt
        if model is None:
            self.method.shift(change)
            return
        model.shift(change)
        acceleration = step.theta[2] / SAMPLE_PERIOD * _bounded(step.traction - state.traction)
        by_delay = state.force_delay.predict(acceleration)
        model.inflate_speed_variance(state.disturbance.long_term_density * step.dt + by_delay)
        if self._curve_std > 0.0:
            curved = -self._k * self._recent.curve(delay) * step.dt
            state.curve.predict(model, curved, step.u, step.scale)

    def _learn(self, sample: Sample, step: ModelStep, learned: Learned) -> None:
        """Store the result of a measurement update and update the estimates other than theta."""
        state = self.state
        if self._auxiliary is not None:
            self._learn_nuisances(self._auxiliary, step, learned)
        state.forgetting = learned.forgetting
        state.predicted, state.error, state.variance = learned.predicted, learned.error, learned.variance
        state.drive(sample.speed)
        state.rejected_in_a_row = state.slow_in_a_row = 0
        state.traction, state.weighed = step.traction, sample.weighed
        self._update_validity(state, self._covariance())

    def _learn_nuisances(self, model: AuxiliaryModel, step: ModelStep, learned: Learned) -> None:
        """Update force delay, curve error and disturbance."""
        state, noise = self.state, self.state.noise.variance
        correction = model.speed() - learned.predicted
        self._learn_delay(model, learned)
        if self._curve_std > 0.0:
            state.curve.update(model, learned.error, learned.variance, noise)
            if learned.forgetting < 1.0:
                state.curve.bound(model)
        density = state.disturbance.density
        state.disturbance.add(correction, step.theta, step.phi, step.dt, step.acceleration_variance)
        if state.disturbance.elapsed == 0.0:
            self._detect_change(model, density)

    def _detect_change(self, model: AuxiliaryModel, density: float) -> None:
        """Reduce the information on the resistance if the window errors show that it has changed.

        Args:
            model: The auxiliary model.
            density: Strength of the disturbances before the last window, which the change does not add to.
        """
        disturbance, threshold = self.state.disturbance, self._change_threshold
        if disturbance.chi2 > threshold:
            factor = max(threshold / disturbance.chi2, _MIN_FACTOR)
            model.forget(factor * factor)
            self.state.curve.bound(model)
            disturbance.mean_error, disturbance.density = 0.0, density

    def _learn_delay(self, model: AuxiliaryModel, learned: Learned) -> None:
        """Update the delay of the force; x is moved to the time to which the new delay refers."""
        recent, late = self._recent, self.state.force_delay
        before = late.delay
        late.update(learned.error, learned.variance, self.state.noise.variance)
        moved = recent.speed(late.delay) - recent.speed(before) + late.sensitivity * (late.delay - before)
        model.shift(moved)

    def _update_validity(self, state: SpeedModelState, S: Symmetric) -> None:
        """Update whether the resistance is valid at the speeds driven, with the covariance S of theta."""
        if state.fastest < state.slowest:
            return
        (v1, v2, v3), k = representative_speeds(*state.speeds_driven()), self._k
        variances = resistance_variance(S, v1, k), resistance_variance(S, v2, k), resistance_variance(S, v3, k)
        state.fit = is_accurate(variances, self._valid_std, was_accurate=state.fit)

    def _covariance(self) -> Symmetric:
        if self._auxiliary is not None:
            return self._auxiliary.covariance(0.0)
        return self.method.covariance(self.state.noise.variance)

    def _hold(self, y: float, step: ModelStep, reason: Reason) -> None:
        """Hold theta over a rejected sample of speed y [m/s]; x follows the measurement."""
        state, method, noise = self.state, self.method, self.state.noise.variance
        state.slow_in_a_row = state.slow_in_a_row + 1 if y < self._min_speed else 0
        sudden = method.speed() - y > _MAX_SPEED_LOSS
        if reason is Reason.STANDSTILL and state.slow_in_a_row < _STANDING and sudden:
            self._predict(step)
            method.coast(step.u, step.scale)
            if not self.method.is_usable():
                method.reinit_speed(y, noise)
        else:
            method.reinit_speed(self._recent.speed(self._delay()), noise)
        if state.slow_in_a_row == _STANDING:
            method.inflate_load_variance(self._load_share())
        self._end_window()
        state.predicted, state.error, state.variance = y, 0.0, 0.0
        if is_finite(step.traction):
            state.traction = step.traction

    def _end_window(self) -> None:
        """End the window of the disturbance; x was restarted from a measurement, independent of delay and curves."""
        self.state.disturbance.end_window()
        self.state.force_delay.sensitivity = self.state.curve.x = 0.0

    def _load_share(self) -> float:
        """Return what a stop adds to the variance of b1, as a share of that of a stop without weighing [1].

        The load varies about the train file's value, so less is added the closer the variance of b1 is to its prior.
        """
        share = max(1.0 - self._covariance()[7] / self._mass_variance, 0.0)
        return share * (self._weighed_share if self.state.weighed else 1.0)

    def _reject(self, y: float, step: ModelStep, learned: Learned, usable: bool) -> None:
        """Predict over an outlier; after several in a row accept the measured speed y [m/s]."""
        state = self.state
        state.rejected_in_a_row += 1
        accepted = state.rejected_in_a_row >= self._readmit_after
        if accepted or not usable:
            self.method.reinit_speed(y, state.noise.variance)
        if accepted:
            self._end_window()
            state.rejected_in_a_row = 0
        state.predicted = learned.predicted if is_finite(learned.predicted) else y
        state.error = learned.error if is_finite(learned.error) else 0.0
        state.variance = learned.variance if is_finite(learned.variance) else 0.0
        state.traction = step.traction

    @property
    def converged(self) -> bool:
        """Whether w is known accurately enough over the speeds driven."""
        return self.state.fit

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [m/s] and its variance before it [(m/s)^2], as in the estimate."""
        return self.state.error, self.state.variance

    def estimate(self, speed: float) -> SpeedModelEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the speed model and its physical parameters; ``speed`` [m/s] is unused."""
        state = self.state
        a1, a2, b1, d0 = theta = self.method.theta()
        a, b, c, scale = to_physical(theta, self._k)
        return SpeedModelEstimate(
            a1,
            a2,
            b1,
            d0,
            full(self._covariance()),
            state.forgetting,
            state.predicted,
            state.error,
            a,
            b,
            c,
            mass_factor=self._rotary / scale,
            prediction_variance=state.variance,
        )


def _bounded(change: float) -> float:
    return min(max(change, -_MAX_CHANGE), _MAX_CHANGE)
