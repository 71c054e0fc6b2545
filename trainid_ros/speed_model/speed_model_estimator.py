# SPDX-License-Identifier: Apache-2.0
"""Estimator of the speed model: admits samples, computes the known forces, runs an algorithm, returns the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.resistance.fitness import is_fit
from trainid_ros.resistance.force_errors import CURVE_RADIUS, curve_std
from trainid_ros.results import Reason, Rejection, SpeedModelEstimate
from trainid_ros.settings import check_settings
from trainid_ros.speed_model.curve_share import CurveShare
from trainid_ros.speed_model.disturbance_observer import Disturbance
from trainid_ros.speed_model.force_delay import ForceDelay
from trainid_ros.speed_model.physical_parameters import full, prior, resistance_variance, to_physical
from trainid_ros.speed_model.recent_values import RecentValues
from trainid_ros.state import check_not_negative, check_numbers, check_restored, decode, encode
from trainid_ros.stream.samples import SAMPLE_PERIOD

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.speed_model.method import Learned, Method, Numbers
    from trainid_ros.speed_model.physical_parameters import SpeedModelConfig, Symmetric, Theta
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Slow samples in a row that indicate standstill: a single one may be an outlier.
_STANDING: Final = 3
# Largest plausible loss of speed from one sample to the next [m/s].
_SUDDEN: Final = 1.0
# A detected change keeps at least the square of this share of the information.
_LEAST_FACTOR: Final = 0.1
# The range of speeds driven: memory of about half an hour, and its half-width in standard deviations.
_USUAL_SAMPLES: Final = 9000.0
_USUAL_SPREAD: Final = 1.5
_NOTHING: Final = RecentValues()
# Limit of the change of traction from sample to sample [N/kN]; beyond it is an outlier.
_MOST_CHANGE: Final = 500.0


@dataclass(frozen=True, slots=True)
class SpeedModelState:
    """State of an estimator of the speed model.

    Attributes:
        numbers: State of the algorithm.
        noise: Noise of measured speed.
        disturbance: Strength of gusts and other unmodelled disturbances.
        late: Delay of the reported force.
        curve: Error of the curve resistance.
        forgetting: Last forgetting factor [1].
        predicted: Last predicted speed [m/s].
        error: Last prediction error [m/s].
        variance: Its predicted variance [(m/s)^2].
        slowest: Slowest speed used [m/s].
        fastest: Fastest speed used [m/s]; less than ``slowest`` if there is none yet.
        usual: Running mean of the speeds used [m/s].
        spread: Their running variance [(m/s)^2].
        used: Number of samples used, up to the memory of these means.
        rejected_in_a_row: Outliers in a row.
        slow_in_a_row: Samples in a row below the minimum speed.
        braked_ns: Last stamp at which the brake was commanded [ns].
        traction: Last known traction [N/kN].
        weighed: Whether the mass was weighed at the last sample.
        speeds: Last measured speeds [m/s].
        tracks: Last known resistances of the track, gradient included [N/kN].
        curves: 600 m over the last curve radii, 0 on straight track [1].
        fit: Whether the resistance is valid.

    """

    numbers: tuple[float, ...]
    noise: SpeedNoise
    disturbance: Disturbance
    late: ForceDelay
    curve: CurveShare
    forgetting: float = 1.0
    predicted: float = 0.0
    error: float = 0.0
    variance: float = 0.0
    slowest: float = 0.0
    fastest: float = -1.0
    usual: float = 0.0
    spread: float = 0.0
    used: float = 0.0
    rejected_in_a_row: int = 0
    slow_in_a_row: int = 0
    braked_ns: int = 0
    traction: float = 0.0
    weighed: bool = False
    speeds: RecentValues = _NOTHING
    tracks: RecentValues = _NOTHING
    curves: RecentValues = _NOTHING
    fit: bool = False


class Traction(NamedTuple):
    """Traction of one step: at its end and its mean [N/kN], and the duration of the step in sample periods [1]."""

    end: float
    mean: float
    scale: float


def load_std(train_file: TrainFile, config: SpeedModelConfig) -> float:
    """Return the standard deviation of the relative change of mass at a stop without weighing [1]."""
    return min(config.load_std, train_file.train.mass_std)


class SpeedModelEstimator:
    """Run a method on samples.

    For an ``adaptive`` method, one whose covariance can be widened, the strength of the disturbances and the delay of
    the reported force are estimated too.
    """

    def __init__(
        self,
        train_file: TrainFile,
        config: SpeedModelConfig,
        method: Callable[[Theta, Symmetric], Method],
        *,
        adaptive: bool = False,
    ) -> None:
        check_settings(config)
        self._config = config
        self._adaptive = adaptive
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis, train = train_file.resistance, train_file.train
        self._curve_std = curve_std(train_file)
        self._k = 1.0 / self._known.inertia
        self._rotary = 1.0 + train.rotary_mass
        mass_std = math.hypot(train.mass_std, train.force_std)
        theta0, P0 = prior((davis.a, davis.b, davis.c), self._k, config, mass_std)
        self._method, self._mass_variance = method(theta0, P0), P0[7]
        unweighed, weighing = load_std(train_file, config), min(config.weighing_std, train.mass_std)
        self._weighed_share = (weighing / unweighed) ** 2 if unweighed > 0.0 else 0.0
        self.reset()

    def reset(self) -> None:
        """Reset to the prior."""
        config = self._config
        noise = SpeedNoise.declared(config.speed_std)
        disturbance, late = Disturbance.declared(config.acceleration_noise), ForceDelay.unknown(config.force_skew)
        curve = CurveShare(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self._curve_std**2)
        self.state = SpeedModelState(self._method.start(noise.variance), noise, disturbance, late, curve)
        self._admission.braked_ns = 0

    def save(self) -> str:
        """Return the complete state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        state = decode(text, SpeedModelState)
        self._check(state)
        try:
            state = self._with_validity(state)
        except ValueError:  # the variance of the resistance is negative at a speed driven
            check_restored(False, 'SpeedModelState', 'numbers')
        self.state = state
        self._admission.braked_ns = state.braked_ns

    def _check(self, state: SpeedModelState) -> None:
        """Raise InputError, naming the field, if a saved state is invalid."""
        kind, numbers = 'SpeedModelState', state.numbers
        # The algorithms as printed can diverge before they restart, so these values are only required to be finite.
        for name in ('forgetting', 'predicted', 'error', 'variance'):
            check_restored(math.isfinite(getattr(state, name)), kind, name)
        bounded = replace(state, numbers=(), forgetting=1.0, predicted=0.0, error=0.0, variance=0.0)
        check_numbers(bounded, may_be_nan=('dt',))  # dt of the noise is NaN after a gap
        check_restored(state.noise.is_valid(), kind, 'noise')
        fits = all(map(math.isfinite, numbers)) and self._method.fits(numbers)
        check_restored(fits and numbers[3] > 0.0, kind, 'numbers')
        variances = self._variances(numbers, state.noise)
        check_restored(min(variances) > 0.0, kind, 'numbers')
        check_restored(state.disturbance.is_valid(), kind, 'disturbance')
        check_restored(state.late.variance >= 0.0, kind, 'late')
        # A non-adaptive algorithm does not estimate the curve error and has no variance of x.
        of_x = numbers[5] if self._adaptive else 0.0
        check_restored(state.curve.is_valid((of_x, *variances)), kind, 'curve')
        for name in ('speeds', 'tracks', 'curves'):
            check_restored(getattr(state, name).is_valid(), kind, name)
        check_not_negative(kind, variance=state.variance, spread=state.spread, used=state.used)
        check_not_negative(kind, rejected_in_a_row=state.rejected_in_a_row, slow_in_a_row=state.slow_in_a_row)

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; return the reason if it is rejected."""
        self._store(sample)
        rejection = self._admission.reject(sample)
        if rejection is not None:
            self._hold(sample, rejection)
            return rejection
        state, traction = self.state, self._traction(sample)
        y, noise = self._speed(), state.noise
        numbers, late, curve = self._moved(sample, traction)
        learned = self._method.learn(numbers, y, traction.mean, traction.scale, noise.variance)
        if learned.rejected:
            self._reject(y, learned, traction.end)
            return Rejection(sample.stamp_ns, Reason.OUTLIER, learned.error, learned.limit)
        numbers = learned.numbers
        if not (numbers[3] > 0.0 and math.isfinite(sum(numbers)) and min(self._variances(numbers, noise)) > 0.0):
            self.state = replace(state, numbers=self._method.anchor(self._method.start(noise.variance), y, 1.0))
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, numbers[3], 0.0)
        self._learn(sample, learned, late, curve, traction)
        return None

    def _speed(self) -> float:
        """Return the speed at the time to which the reported force belongs [m/s]."""
        return self.state.speeds.before(self._delay)

    @property
    def _delay(self) -> float:
        return self.state.late.delay if self._adaptive else 0.0

    def _store(self, sample: Sample) -> None:
        """Store speed, track resistance and curvature of a sample."""
        state, dt = self.state, sample.dt
        track, curve = self._known.track(sample), CURVE_RADIUS * sample.curvature
        if not (math.isfinite(track) and math.isfinite(curve)):
            track = curve = 0.0
        self.state = replace(
            state,
            noise=state.noise.add(sample.speed, dt),
            speeds=state.speeds.add(sample.speed, dt),
            tracks=state.tracks.add(track, dt),
            curves=state.curves.add(curve, dt),
        )

    def _traction(self, sample: Sample) -> Traction:
        """Return the traction of a sample; the mean is used for its end if the force at the stamp is missing."""
        mean = self._known.traction(sample.force_mean, sample)
        end = self._known.traction(sample.force, sample) if math.isfinite(sample.force) else mean
        return Traction(end, mean, sample.dt / SAMPLE_PERIOD)

    def _moved(self, sample: Sample, traction: Traction) -> tuple[Numbers, ForceDelay, CurveShare]:
        """Apply known resistance, disturbance, force delay and curve error of this step; return the new states."""
        state, method = self.state, self._method
        change = -self._k * state.tracks.before(self._delay) * sample.dt
        if not self._adaptive:
            return method.shift(state.numbers, change), state.late, state.curve
        acceleration = state.numbers[3] / SAMPLE_PERIOD * _bounded(traction.end - state.traction)
        late = state.late.changed(acceleration)
        numbers = method.shift(state.numbers, change)
        variance = state.disturbance.lasting * sample.dt + late.speed_variance(state.late)
        numbers, curve = method.widen_speed(numbers, variance), state.curve
        if self._curve_std > 0.0:
            curved = state.curves.before(self._delay)
            numbers, curve = curve.push(numbers, -self._k * curved * sample.dt)
            curve = curve.step(numbers[0], numbers[1:5], traction.mean, traction.scale)
        return numbers, late, curve

    def _learn(self, sample: Sample, learned: Learned, late: ForceDelay, curve: CurveShare, traction: Traction) -> None:
        """Store the result of a measurement update and update the estimates other than theta."""
        state, y, numbers = self.state, sample.speed, learned.numbers
        disturbance, noise = state.disturbance, state.noise
        if self._adaptive:
            numbers, late = self._learn_delay(learned, late)
            if self._curve_std > 0.0:
                curve = curve.learn(numbers, learned.error, learned.variance, noise.variance)
            variance, x = self._k**2 * max(self._variance(y), 0.0), state.numbers[0]
            scale = traction.scale
            phi = (scale * x * x, scale * x, scale * traction.mean, scale)
            correction = learned.numbers[0] - learned.predicted
            numbers, disturbance = self._detect_change(
                numbers, disturbance.add(correction, state.numbers[1:5], phi, sample.dt, variance)
            )
        started, share = state.fastest >= state.slowest, 1.0 / min(state.used + 1.0, _USUAL_SAMPLES)
        self.state = SpeedModelState(
            numbers=numbers,
            noise=noise,
            disturbance=disturbance,
            late=late,
            curve=curve,
            forgetting=learned.forgetting,
            predicted=learned.predicted,
            error=learned.error,
            variance=learned.variance,
            slowest=min(y, state.slowest) if started else y,
            fastest=max(y, state.fastest) if started else y,
            usual=state.usual + share * (y - state.usual),
            spread=(1.0 - share) * (state.spread + share * (y - state.usual) ** 2),
            used=1.0 / share,
            braked_ns=self._admission.braked_ns,
            traction=traction.end,
            weighed=sample.weighed,
            speeds=state.speeds,
            tracks=state.tracks,
            curves=state.curves,
            fit=state.fit,
        )
        self._update_validity()

    def _detect_change(self, numbers: Numbers, disturbance: Disturbance) -> tuple[Numbers, Disturbance]:
        """Reduce the information on the resistance if the window errors show that it has changed."""
        threshold = self._config.change_threshold
        if disturbance.elapsed > 0.0 or disturbance.chi2 <= threshold:
            return numbers, disturbance
        factor = max(threshold / disturbance.chi2, _LEAST_FACTOR) ** 2
        density = self.state.disturbance.density
        return self._method.forget(numbers, factor), replace(disturbance, agreed=0.0, density=density)

    def _learn_delay(self, learned: Learned, late: ForceDelay) -> tuple[Numbers, ForceDelay]:
        """Update the delay of the force; x is moved to the time to which the new delay refers."""
        recent, noise = self.state.speeds, self.state.noise
        after = late.learn(learned.error, learned.variance, noise.variance)
        moved = recent.before(after.delay) - recent.before(late.delay) + after.gain * (after.delay - late.delay)
        return self._method.shift(learned.numbers, moved), after

    def _update_validity(self) -> None:
        """Update whether the resistance is valid at the speeds driven."""
        self.state = self._with_validity(self.state)

    def _with_validity(self, state: SpeedModelState) -> SpeedModelState:
        if state.fastest < state.slowest:
            return state
        width = _USUAL_SPREAD * math.sqrt(state.spread)
        speeds = max(state.usual - width, state.slowest), min(state.usual + width, state.fastest)
        S = self._method.covariance(state.numbers, state.noise.variance)
        fit = is_fit(lambda v: resistance_variance(S, v, self._k), speeds, self._config.valid_std, was_fit=state.fit)
        return state if fit == state.fit else replace(state, fit=fit)

    def _variance(self, speed: float) -> float:
        """Return the variance of w [(N/kN)^2] at a speed [m/s]."""
        state = self.state
        return resistance_variance(self._method.covariance(state.numbers, state.noise.variance), speed, self._k)

    def _variances(self, numbers: tuple[float, ...], noise: SpeedNoise) -> tuple[float, ...]:
        S = self._method.covariance(numbers, noise.variance)
        return S[0], S[4], S[7], S[9]

    def _hold(self, sample: Sample, rejection: Rejection) -> None:
        """Hold theta over a rejected sample; x follows the measurement."""
        state, method, y = self.state, self._method, sample.speed
        noise = state.noise
        slow = state.slow_in_a_row + 1 if y < self._config.min_speed else 0
        traction = self._traction(sample)
        if rejection.reason is Reason.STANDSTILL and slow < _STANDING and state.numbers[0] - y > _SUDDEN:
            moved = self._moved(sample, traction)[0]
            numbers = self._finite(method.coast(moved, traction.mean, traction.scale), y)
        else:
            numbers = method.anchor(state.numbers, self._speed(), noise.variance)
        if slow == _STANDING:
            numbers = method.widen_load(numbers, self._load_share())
        self.state = replace(
            state,
            numbers=numbers,
            disturbance=state.disturbance.ended(),
            late=state.late.anchored(),
            curve=state.curve.anchored(),
            predicted=y,
            error=0.0,
            variance=0.0,
            slow_in_a_row=slow,
            braked_ns=self._admission.braked_ns,
            traction=traction.end if math.isfinite(traction.end) else state.traction,
        )

    def _load_share(self) -> float:
        """Return what a stop adds to the variance of b1, as a share of that of a stop without weighing [1].

        The load varies about the train file's value, so less is added the closer the variance of b1 is to its prior.
        """
        state = self.state
        known = self._method.covariance(state.numbers, state.noise.variance)[7]
        share = max(1.0 - known / self._mass_variance, 0.0)
        return share * (self._weighed_share if state.weighed else 1.0)

    def _reject(self, y: float, learned: Learned, traction: float) -> None:
        """Predict over an outlier; after several in a row accept the measured speed y [m/s]."""
        state, in_a_row = self.state, self.state.rejected_in_a_row + 1
        anchored = in_a_row >= self._config.readmit_after
        numbers = self._finite(learned.numbers, y)
        self.state = replace(
            state,
            numbers=self._method.anchor(numbers, y, state.noise.variance) if anchored else numbers,
            disturbance=state.disturbance.ended() if anchored else state.disturbance,
            late=state.late.anchored() if anchored else state.late,
            curve=state.curve.anchored() if anchored else state.curve,
            predicted=learned.predicted if math.isfinite(learned.predicted) else y,
            error=learned.error if math.isfinite(learned.error) else 0.0,
            variance=learned.variance if math.isfinite(learned.variance) else 0.0,
            rejected_in_a_row=0 if anchored else in_a_row,
            braked_ns=self._admission.braked_ns,
            traction=traction,
        )

    def _finite(self, numbers: tuple[float, ...], y: float) -> tuple[float, ...]:
        """Return the numbers, or if they overflowed, the previous ones restarted from the speed y [m/s]."""
        if math.isfinite(sum(numbers)):
            return numbers
        return self._method.anchor(self.state.numbers, y, self.state.noise.variance)

    @property
    def converged(self) -> bool:
        """Whether w is known accurately enough over the speeds driven."""
        return self.state.fit

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update and its variance before the measurement, as in the estimate."""
        return self.state.error, self.state.variance

    def estimate(self, speed: float) -> SpeedModelEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the speed model and its physical parameters; ``speed`` [m/s] is unused."""
        state = self.state
        theta = self._method.theta(state.numbers)
        S = self._method.covariance(state.numbers, state.noise.variance)
        a, b, c, scale = to_physical(theta, self._k)
        return SpeedModelEstimate(
            *theta,
            full(S),
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
    return min(max(change, -_MOST_CHANGE), _MOST_CHANGE)
