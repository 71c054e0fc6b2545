# SPDX-License-Identifier: Apache-2.0
"""The regressions of Liu et al. 2018 as streaming estimators, for comparison with V-MILS.

Samples are cut into windows of fixed length, or into the segments of Fig. 2; each gives one observation of the
resistance and one step of a regression. Internally v is in km/h as in the paper, since the penalty of the
regularised forms depends on the unit. There are no other safeguards: no prior from the train file, no drift and no
step detection. V-MILS as printed skips observations that a robust gate marks as bad; the paper does not state how
bad data are found.

The covariance is ``p sigma^2 P`` with the long-run variance sigma^2 of the residuals, which includes their
correlation. Each observation is used up to p times, so P is about p times too small. The bias caused by a penalty is
not included.

The P of the paper is a covariance only after multiplication by the noise variance, which it never estimates, and only
for white noise; with overlapping windows and gusts the noise is correlated: see :class:`Residuals`.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

from trainid_lab.resistance.recursive import Vector, covariance, prediction_variance
from trainid_lab.resistance.regressions import Regression, RegressionState, Step, begin, skip, strict_step
from trainid_lab.resistance.segments import Segments, Windows, cut
from trainid_ros.interface.errors import check_settings, setting
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.interface.state import State, declare, encode, restore, stored
from trainid_ros.resistance.davis_posterior import is_accurate, largest_std, representative_speeds
from trainid_ros.resistance.window_learner import WindowResult, WindowSample, observe_resistance
from trainid_ros.stream.known_force import Admission, KnownForce
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

_LAGS: Final = 8
_MEMORY: Final = 51
# Weight of the declared noise, in observations.
_DECLARED: Final = 4
# Ratio of the standard deviation to the median absolute deviation of a Gaussian.
_MAD: Final = 1.4826


@dataclass(frozen=True, slots=True)
class Residuals:
    """Sums over the residuals so far."""

    count: int = 0  # Number of residuals
    squares: float = 0.0  # Sum of their squares [(N/kN)^2]
    products: tuple[float, ...] = (0.0,) * _LAGS  # Sums of products of residuals at lags 1, 2, ... [(N/kN)^2]
    last: tuple[float, ...] = ()  # Latest residuals, oldest first [N/kN]
    # Latest innovations, including those of bad observations, used by :meth:`is_outlier` [N/kN].
    recent: tuple[float, ...] = ()

    def add(self, residual: float) -> Residuals:
        """Return the sums after one more residual of a good observation [N/kN]."""
        products = list(self.products)
        for lag, earlier in enumerate(reversed(self.last)):
            products[lag] += residual * earlier
        return Residuals(
            self.count + 1,
            self.squares + residual * residual,
            tuple(products),
            (*self.last, residual)[-_LAGS:],
            self.recent,
        )

    def remember(self, innovation: float) -> Residuals:
        """Return the statistics after one more innovation [N/kN] for :meth:`is_outlier`; the sums do not change."""
        return Residuals(self.count, self.squares, self.products, self.last, (*self.recent, innovation)[-_MEMORY:])

    def is_outlier(self, innovation: float, gate: float) -> bool:
        """Return whether an innovation [N/kN] lies more than ``gate`` robust standard deviations from the median."""
        if len(self.recent) < _MEMORY:
            return False
        middle = statistics.median(self.recent)
        spread = _MAD * statistics.median(abs(value - middle) for value in self.recent)
        return abs(innovation - middle) > gate * spread

    def variance(self, declared_std: float) -> float:
        """Return the variance of one observation [(N/kN)^2]; the declared std [N/kN] counts as a few residuals."""
        return (_DECLARED * declared_std**2 + self.squares) / (_DECLARED + self.count)

    def long_run_variance(self, declared_std: float) -> float:
        """Return the long-run variance per observation [(N/kN)^2] (Newey and West 1987); declared std in N/kN."""
        if self.squares <= 0.0:
            return self.variance(declared_std)
        taper = (1.0 - lag / (_LAGS + 1) for lag in range(1, _LAGS + 1))
        factor = 1.0 + 2.0 * math.fsum(w * p for w, p in zip(taper, self.products, strict=True)) / self.squares
        # The tapered sum is never negative; near zero it would be overconfident for a finite record.
        return self.variance(declared_std) * max(factor, 0.1)


_KMH: Final = 3.6
# With fewer residuals the three parameters may fit the noise.
_MIN_RESIDUALS: Final = 10
# Forgetting without excitation lets P grow without bound; below this limit nothing overflows.
_HUGE: Final = 1e100


@dataclass(frozen=True, slots=True)
class WindowedConfig:
    """Settings of the regressions; each algorithm uses those that apply to it."""

    innovation_length: int = setting(1, 'innovation length p', 'observations', 1, 50)
    penalty: float = setting(0.0, 'penalty lambda on a, b, c with v in km/h, 0 = none', '1', 0.0, 1e9)
    record_length: int = setting(
        0,
        'length N of the record, for the penalty as printed; 0 = the full penalty at the start',
        'observations',
        0,
        1e9,
    )
    forgetting: float = setting(1.0, 'forgetting factor per observation', '1', 0.5, 1.0)
    gate: float = setting(
        0.0, 'observations beyond this many robust standard deviations are bad, 0 = no gate', '1', 0.0, 100.0
    )
    segment: float = setting(0.0, 'change of speed that ends a segment (Fig. 2), 0 = fixed windows', 'm/s', 0.0, 5.0)
    window: int = setting(25, 'samples in a fixed window', 'samples', 5, 200)
    hop: int = setting(12, 'samples between fixed windows', 'samples', 1, 200)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    noise_std: float = setting(0.8, 'noise of an observation at the start (then learned)', 'N/kN', 1e-3, 100.0)
    valid_std: float = setting(0.15, 'resistance is fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)


@dataclass(frozen=True, slots=True)
class WindowedState:
    """Saved state of a windowed regression; P times ``scale`` [(N/kN)^2] is the covariance."""

    regression: RegressionState
    scale: float
    residuals: Residuals = field(default_factory=Residuals)
    ticks: tuple[WindowSample, ...] = stored((), kind=WindowSample)
    braked_ns: int = 0
    innovation: float = 0.0
    innovation_variance: float = 0.0
    test_ratio: float = 0.0
    speed_min: float = 0.0
    speed_max: float = 0.0
    converged: bool = False


class WindowedRegression:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples by one of the paper's regressions."""

    STATE: ClassVar[State] = declare('state', '_admission')

    def __init__(self, train_file: TrainFile, config: WindowedConfig, step: Step) -> None:
        check_settings(config)
        self.config = config
        self._learn = step
        self._regression = Regression(config.innovation_length, config.penalty, config.record_length, config.forgetting)
        windows = Windows(config.window, config.hop)
        self._cutter = Segments(config.segment) if config.segment > 0.0 else windows
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self.reset()

    def reset(self) -> None:
        """Return to the initial state."""
        self.state = WindowedState(begin(self._regression), self._scale(Residuals()))
        self._admission.braked_ns = 0

    def idle(self, seconds: float) -> None:
        """Do nothing: the method of the paper has no drift."""

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the speeds observed."""
        return self.state.converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; each complete window or segment gives one observation."""
        if (rejection := self._admission.reject(sample)) is not None:
            self.state = replace(self._skipped(), ticks=(), braked_ns=self._admission.braked_ns)
            return rejection
        traction = self._known.traction(sample.force_mean, sample)
        tick = WindowSample(sample.stamp_ns, sample.dt, sample.speed, traction - self._known.track(sample), traction)
        ticks, piece = cut(self.state.ticks, tick, self._cutter)
        self.state = replace(self.state, ticks=ticks, braked_ns=self._admission.braked_ns)
        return self._observe(piece) if piece else None

    def _observe(self, piece: tuple[WindowSample, ...]) -> Rejection | None:
        # An infinite noise level disables outlier removal: the paper uses all speeds.
        observed = observe_resistance(list(piece), self._known.inertia, math.inf)
        if isinstance(observed, Rejection):
            self.state = self._skipped()
            return observed
        return self._update(observed, piece[-1].stamp_ns)

    def _update(self, observed: WindowResult, stamp_ns: int) -> Rejection | None:
        """Make one step of the regression, unless the observation is bad."""
        state, config = self.state, self.config
        phi = _in_kmh(observed.phi)
        # (16)
        e = observed.y - sum(f * x for f, x in zip(phi, state.regression.theta, strict=True))
        # Variance of the prediction, p phi' P phi, in units of the noise variance; P is p times too small.
        added = config.innovation_length * prediction_variance(state.regression.UD, phi)
        S = state.residuals.variance(config.noise_std) * (1.0 + added)
        bad = config.gate > 0.0 and state.residuals.is_outlier(e, config.gate)
        self.state = replace(
            state,
            residuals=state.residuals.remember(e) if config.gate > 0.0 else state.residuals,
            innovation=e,
            innovation_variance=S,
            test_ratio=e * e / (9.0 * S),
        )
        if bad:
            self.state = self._skipped()
            return Rejection(stamp_ns, Reason.OUTLIER, e, math.nan)
        learned = self._learn(self.state.regression, phi, observed.y, self._regression)
        if not _is_valid(learned):
            self.state = self._skipped()
            return Rejection(stamp_ns, Reason.NUMERICAL, e, math.nan)
        self._accept(learned, e / math.sqrt(1.0 + added), observed)
        return None

    def _accept(self, learned: RegressionState, residual: float, observed: WindowResult) -> None:
        state = self.state
        first = state.speed_max == 0.0
        known = state.regression.determined and state.regression.steps >= 3
        # The first three innovations depend on the initial theta, not on the noise alone.
        residuals = state.residuals.add(residual) if known else state.residuals
        self.state = replace(
            state,
            regression=learned,
            scale=self._scale(residuals),
            residuals=residuals,
            speed_min=observed.speed_min if first else min(state.speed_min, observed.speed_min),
            speed_max=max(state.speed_max, observed.speed_max),
        )
        self._judge()

    def _skipped(self) -> WindowedState:
        """Return the state after a bad or missing observation; only V-MILS clears its stack."""
        if self._learn is not strict_step:
            return self.state
        return replace(self.state, regression=skip(self.state.regression))

    def _judge(self) -> None:
        """Decide whether w is fit to use."""
        state = self.state
        scale, UD = state.scale, state.regression.UD
        enough = state.regression.determined and state.residuals.count >= _MIN_RESIDUALS
        v1, v2, v3 = (
            scale * prediction_variance(UD, _regressor(v))
            for v in representative_speeds(state.speed_min, state.speed_max)
        )
        converged = enough and is_accurate((v1, v2, v3), self.config.valid_std, was_accurate=state.converged)
        self.state = replace(state, converged=converged)

    def _scale(self, residuals: Residuals) -> float:
        """Return p sigma^2 [(N/kN)^2]."""
        return self.config.innovation_length * residuals.long_run_variance(self.config.noise_std)

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [N/kN] and its variance before it [(N/kN)^2], as in the estimate."""
        return self.state.innovation, self.state.innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        state = self.state
        a, b, c = _in_kmh(state.regression.theta)
        P11, P12, P13, P22, P23, P33 = (state.scale * value for value in covariance(state.regression.UD))
        k, k2, k3, k4 = _KMH, _KMH**2, _KMH**3, _KMH**4
        std = math.sqrt(state.scale * prediction_variance(state.regression.UD, _regressor(speed)))
        P = P11, k * P12, k2 * P13, k * P12, k2 * P22, k3 * P23, k2 * P13, k3 * P23, k4 * P33
        return ResistanceEstimate(
            a=a,
            b=b,
            c=c,
            covariance=P,
            resistance=a + speed * (b + speed * c),
            resistance_std=std,
            speed=speed,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
            speed_min=state.speed_min,
            speed_max=state.speed_max,
            resistance_std_max=largest_std(P, (state.speed_min, state.speed_max), std),
        )


def _regressor(speed: float) -> Vector:
    """Return [1, v, v^2] with v in km/h for a speed in m/s."""
    v = _KMH * speed
    return 1.0, v, v * v


def _in_kmh(values: Vector) -> Vector:
    """Convert [1, v, v^2] from m/s to km/h, or parameters from v in km/h to v in m/s: both use the same factors."""
    return values[0], _KMH * values[1], _KMH**2 * values[2]


def _is_valid(state: RegressionState) -> bool:
    numbers = [*state.theta, *state.UD]
    return len(numbers) == 9 and all(abs(value) < _HUGE for value in numbers) and min(state.UD[3:]) >= 0.0
