# SPDX-License-Identifier: Apache-2.0
"""From samples to an algorithm for the speed model: what is admitted, what is known of the force, what comes out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.results import Reason, Refusal, SpeedModelEstimate
from trainid_ros.core.samples import SAMPLE_PERIOD
from trainid_ros.core.settings import check_settings
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.speed_model.parameters import full, prior, resistance_variance, to_physical
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.physics.resistance import G

if TYPE_CHECKING:
    from collections.abc import Callable

    from trainid_ros.core.samples import Sample
    from trainid_ros.estimators.speed_model.method import Learned, Method
    from trainid_ros.estimators.speed_model.parameters import SpeedModelConfig, Symmetric, Theta
    from trainid_ros.physics.train_file import TrainFile

# Slow samples in a row that mean standstill: one may be an outlier.
_STANDING: Final = 3
# A train does not lose more speed from one sample to the next [m/s].
_SUDDEN: Final = 1.0
# Nor does its traction change by more [N/kN]; what does is an outlier and no worse for being greater.
_MOST_CHANGE: Final = 500.0


@dataclass(frozen=True, slots=True)
class SpeedModelState:
    """All that an estimator of the speed model remembers.

    Attributes:
        numbers: State of the algorithm.
        noise: Noise of measured speed.
        forgetting: Last forgetting factor.
        predicted: Last predicted speed [m/s].
        error: Last error of prediction [m/s].
        variance: Its variance as stated before the measurement [(m/s)^2].
        slowest: Slowest speed learned from [m/s].
        fastest: Fastest speed learned from [m/s]; below the slowest: none yet.
        refused_in_a_row: Outliers in a row.
        slow_in_a_row: Samples in a row that are too slow to learn from.
        braked_ns: Last stamp at which the brake was asked for.
        traction: Last known traction [N/kN].

    """

    numbers: tuple[float, ...]
    noise: SpeedNoise
    forgetting: float = 1.0
    predicted: float = 0.0
    error: float = 0.0
    variance: float = 0.0
    slowest: float = 0.0
    fastest: float = -1.0
    refused_in_a_row: int = 0
    slow_in_a_row: int = 0
    braked_ns: int = 0
    traction: float = 0.0


class SpeedModelEstimator:
    """Drives a method by samples."""

    def __init__(
        self, train_file: TrainFile, config: SpeedModelConfig, method: Callable[[Theta, Symmetric], Method]
    ) -> None:
        check_settings(config)
        self._config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis = train_file.resistance
        self._method = method(*prior((davis.a, davis.b, davis.c), 1.0 / self._known.inertia, config))
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        noise = SpeedNoise.declared(self._config.speed_std)
        self.state = SpeedModelState(self._method.start(noise.variance), noise)
        self._admission.braked_ns = 0

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, SpeedModelState)
        numbers = state.numbers
        fits = self._method.fits(numbers) and all(map(math.isfinite, numbers))
        check_restored(fits and numbers[3] > 0.0, 'SpeedModelState', 'numbers')
        check_restored(state.noise.variance > 0.0, 'SpeedModelState', 'noise')
        self.state = state
        self._admission.braked_ns = state.braked_ns

    def step(self, sample: Sample) -> SpeedModelEstimate | Refusal:
        """Take one sample in."""
        refusal = self._admission.refuse(sample)
        if refusal is not None:
            self._rest(sample, refusal)
            return refusal
        state, y = self.state, sample.speed
        noise = state.noise.add(y, sample.dt)
        traction, scale = self._known.traction(sample.force_mean, sample), sample.dt / SAMPLE_PERIOD
        doubtful = self._method.doubt_force(state.numbers, _bounded(traction - state.traction))
        # u: specific traction less all resistance that is known [N/kN]
        learned = self._method.learn(doubtful, y, traction - self._known.track(sample), scale, noise.variance)
        if learned.refused:
            self._refuse(y, noise, learned, traction)
            return Refusal(sample.stamp_ns, Reason.OUTLIER, learned.error, learned.limit)
        numbers = learned.numbers
        if not (numbers[3] > 0.0 and math.isfinite(sum(numbers)) and min(self._variances(numbers, noise)) > 0.0):
            self.state = replace(state, numbers=self._method.anchor(self._method.start(noise.variance), y, 1.0))
            return Refusal(sample.stamp_ns, Reason.NUMERICAL, numbers[3], 0.0)
        seen = state.fastest >= state.slowest
        self.state = SpeedModelState(
            numbers,
            noise,
            learned.forgetting,
            learned.predicted,
            learned.error,
            learned.variance,
            min(y, state.slowest) if seen else y,
            max(y, state.fastest) if seen else y,
            0,
            0,
            self._admission.braked_ns,
            traction,
        )
        return self.estimate(y)

    def _variances(self, numbers: tuple[float, ...], noise: SpeedNoise) -> tuple[float, ...]:
        S = self._method.covariance(numbers, noise.variance)
        return S[0], S[4], S[7], S[9]

    def _rest(self, sample: Sample, refusal: Refusal) -> None:
        """Nothing to learn: theta stands, the model's speed follows the measurement."""
        state, method, y = self.state, self._method, sample.speed
        noise = state.noise.add(y, math.nan)
        slow = state.slow_in_a_row + 1 if y < self._config.min_speed else 0
        traction = self._known.traction(sample.force_mean, sample)
        if refusal.reason is Reason.STANDSTILL and slow < _STANDING and state.numbers[0] - y > _SUDDEN:
            u, scale = traction - self._known.track(sample), sample.dt / SAMPLE_PERIOD
            numbers = self._finite(method.coast(state.numbers, u, scale), y)
        else:
            numbers = method.anchor(state.numbers, y, noise.variance)
        if slow == _STANDING:
            numbers = method.doubt_load(numbers)
        self.state = replace(
            state,
            numbers=numbers,
            noise=noise,
            predicted=numbers[0],
            error=0.0,
            variance=0.0,
            slow_in_a_row=slow,
            braked_ns=self._admission.braked_ns,
            traction=traction if math.isfinite(traction) else state.traction,
        )

    def _refuse(self, y: float, noise: SpeedNoise, learned: Learned, traction: float) -> None:
        """Coast on the model over a refused sample; after several in a row believe the measurement."""
        state, in_a_row = self.state, self.state.refused_in_a_row + 1
        anchored = in_a_row >= self._config.readmit_after
        numbers = self._finite(learned.numbers, y)
        self.state = replace(
            state,
            numbers=self._method.anchor(numbers, y, noise.variance) if anchored else numbers,
            noise=noise,
            predicted=learned.predicted if math.isfinite(learned.predicted) else y,
            error=learned.error if math.isfinite(learned.error) else 0.0,
            variance=learned.variance if math.isfinite(learned.variance) else 0.0,
            refused_in_a_row=0 if anchored else in_a_row,
            braked_ns=self._admission.braked_ns,
            traction=traction,
        )

    def _finite(self, numbers: tuple[float, ...], y: float) -> tuple[float, ...]:
        """Return numbers, or the last ones anchored if a force beyond all measure spoilt these."""
        if math.isfinite(sum(numbers)):
            return numbers
        return self._method.anchor(self.state.numbers, y, self.state.noise.variance)

    @property
    def converged(self) -> bool:
        """True while w is known well enough at the slowest and the fastest speed learned from."""
        state = self.state
        if state.fastest < state.slowest:
            return False
        theta, S = self._believed()
        worst = max(resistance_variance(theta, S, v) for v in (state.slowest, state.fastest))
        return worst < self._config.valid_std**2

    def _believed(self) -> tuple[Theta, Symmetric]:
        numbers = self.state.numbers
        return self._method.theta(numbers), self._method.covariance(numbers, self.state.noise.variance)

    def estimate(self, speed: float) -> SpeedModelEstimate:  # noqa: ARG002 - one signature for all estimators
        """Return the model and what it means physically."""
        state = self.state
        theta, S = self._believed()
        a, b, c, k = to_physical(theta)
        return SpeedModelEstimate(
            *theta,
            full(S),
            state.forgetting,
            state.predicted,
            state.error,
            a,
            b,
            c,
            mass_factor=G / (1000.0 * k),
            prediction_variance=state.variance,
        )


def _bounded(change: float) -> float:
    return min(max(change, -_MOST_CHANGE), _MOST_CHANGE)
