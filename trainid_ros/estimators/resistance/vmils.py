# SPDX-License-Identifier: Apache-2.0
"""V-MILS: Davis parameters by interval-varying multi-innovation least squares.

After Liu et al. 2018 (sections 3 and 4.2), with these corrections:

* y carries rotating mass, gradient and traction instead of eq. (5), see :mod:`speed_window`;
* regularisation is a Gaussian prior (P(0), theta(0)), which equals ridge regression (7) at every step,
  instead of (12)-(16), whose penalty grows with time;
* the p innovations of a step have p times their noise variance. Each observation is used p times, so all
  uses together weigh exactly once and P stays a covariance;
* "interval-varying": the stack holds the last p *good* observations; refused ones leave no hole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Reason, Refusal, ResistanceEstimate
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import davis_prior
from trainid_ros.estimators.resistance.change_detector import NO_STEP, Cusum
from trainid_ros.estimators.resistance.multi_innovation import Belief, multi_innovation_step
from trainid_ros.estimators.resistance.speed_window import Tick, WindowResult, observe_resistance, overlap_factor
from trainid_ros.estimators.speed_noise import SpeedNoise

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.physics.train_file import TrainFile

_SECONDS_PER_HOUR: Final = 3600.0
# A CUSUM sum below this is no sign of a step yet; a lean longer than this is slow drift.
_LEANING: Final = 1.0
_LONGEST_LEAN: Final = 64
_DISTURBANCE_MEMORY: Final = 0.03
_DISTURBANCE_RANGE: Final = (0.3, 3.0)
# One innovation cannot tell much more disturbance than is known: slip is none.
_MOST_SIGMAS: Final = 3.0


@dataclass(frozen=True, slots=True)
class VMilsConfig:
    """Settings of V-MILS."""

    innovation_length: int = setting(4, 'innovation length p', 'observations', 1, 50)
    window: int = setting(25, 'samples in a speed window', 'samples', 5, 200)
    hop: int = setting(12, 'samples between windows', 'samples', 1, 200)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.12, 'unmodelled resistance at the start (then learned)', 'N/kN', 0.0, 10.0)
    disturbance_time: float = setting(12.0, 'correlation time of the disturbance', 's', 0.0, 600.0)
    force_error: float = setting(0.005, 'relative error of the traction force', '1', 0.0, 0.5)
    force_skew: float = setting(0.06, 'unknown delay of the reported force', 's', 0.0, 5.0)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their believed values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    drift_share: float = setting(0.15, 'drift in one hour, std as a share of the prior std', '1', 0.0, 100.0)
    gate: float = setting(4.0, 'innovations beyond this many standard deviations are refused', '1', 1.0, 100.0)
    step_allowance: float = setting(0.4, 'CUSUM allowance per innovation', 'standard deviations', 0.0, 3.0)
    step_threshold: float = setting(7.0, 'CUSUM sum that counts as a step', 'standard deviations', 1.0, 1e6)
    step_share: float = setting(0.4, 'doubt added after a step, std as a share of the prior std', '1', 0.0, 10.0)
    valid_std: float = setting(0.15, 'resistance is fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)


@dataclass(frozen=True, slots=True)
class VMilsState:
    """All that V-MILS remembers; tuples only, so that it saves as JSON."""

    belief: Belief
    before: Belief
    noise: SpeedNoise
    since: tuple[WindowResult, ...] = ()
    stack: tuple[WindowResult, ...] = ()
    ticks: tuple[Tick, ...] = ()
    fresh: int = 0
    disturbance_variance: float = 0.0
    stamp_ns: int = 0
    updated_ns: int = 0
    braked_ns: int = 0
    cusum: Cusum = NO_STEP
    steps_found: int = 0
    innovation: float = 0.0
    innovation_variance: float = 0.0
    test_ratio: float = 0.0
    speed_min: float = 0.0
    speed_max: float = 0.0
    observations: int = 0
    converged: bool = False


class VMils:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples."""

    def __init__(self, train_file: TrainFile, config: VMilsConfig) -> None:
        check_settings(config)
        if config.hop > config.window:
            msg = f'hop = {config.hop} must not exceed window = {config.window}'
            raise InputError(msg)
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis = train_file.resistance
        self._theta0 = (davis.a, davis.b, davis.c)
        floors = (config.prior_std_a, config.prior_std_b, config.prior_std_c)
        self._P0 = davis_prior(self._theta0, config.prior_share, floors)
        a, b, c = (float(variance) for variance in np.diag(self._P0))
        self._most_doubt = (a, b, c)
        growth = config.drift_share**2 / _SECONDS_PER_HOUR
        self._drift_rates = (growth * a, growth * b, growth * c)
        self._step = config.step_share**2 * self._P0
        self._overlap = overlap_factor(config.window, config.hop)
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        prior = Belief.of(np.array(self._theta0), self._P0)
        self.state = VMilsState(
            belief=prior,
            before=prior,
            noise=SpeedNoise.declared(self.config.speed_std),
            disturbance_variance=self.config.disturbance_std**2,
        )
        self._admission.braked_ns = 0

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, VMilsState)
        check_restored(state.belief.is_finite() and state.before.is_finite(), 'VMilsState', 'belief')
        self.state = state
        self._admission.braked_ns = self.state.braked_ns

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough at the speeds seen."""
        return self.state.converged

    def step(self, sample: Sample) -> ResistanceEstimate | Refusal:
        """Take one sample in; every ``hop`` good samples make one observation and one update."""
        if (refusal := self._admission.refuse(sample)) is not None:
            noise = self.state.noise.add(sample.speed, math.nan)
            self.state = replace(
                self.state,
                ticks=(),
                fresh=0,
                noise=noise,
                stamp_ns=sample.stamp_ns,
                braked_ns=self._admission.braked_ns,
            )
            self._judge()
            return refusal
        self._append(sample)
        refusal = self._observe(sample)
        self._judge()
        return refusal or self.estimate(sample.speed)

    def _observe(self, sample: Sample) -> Refusal | None:
        """Make an observation of the window and learn from it, if one is due."""
        state = self.state
        if len(state.ticks) < self.config.window or state.fresh < self.config.hop:
            return None
        self.state = replace(state, fresh=0)
        observed = observe_resistance(list(state.ticks), self._known.inertia, state.noise.std)
        if isinstance(observed, Refusal):
            return observed
        return self._update(observed, sample)

    def _append(self, sample: Sample) -> None:
        traction = self._known.traction(sample.force_mean, sample)
        tick = Tick(sample.stamp_ns, sample.dt, sample.speed, traction - self._known.track(sample), traction)
        ticks = (*self.state.ticks, tick)[-self.config.window :]
        self.state = replace(
            self.state,
            ticks=ticks,
            fresh=self.state.fresh + 1,
            noise=self.state.noise.add(sample.speed, sample.dt),
            stamp_ns=sample.stamp_ns,
            braked_ns=self._admission.braked_ns,
        )

    def _learn_disturbance(self, nu: float, S: float) -> float:
        """What the innovations hold beyond the noise and doubt that are known, within bounds."""
        low, high = ((factor * self.config.disturbance_std) ** 2 for factor in _DISTURBANCE_RANGE)
        known = self.state.disturbance_variance
        if self.state.cusum.peak > 0.5 * self.config.step_threshold:  # rather a step of the parameters
            return known
        bounded = min(nu * nu, _MOST_SIGMAS**2 * S)
        # The noisier one innovation, the less it tells of what little lies beneath.
        gain = _DISTURBANCE_MEMORY * min(1.0, high / S)
        return min(max(known + gain * (bounded - S), low), high)

    def _update(self, observed: WindowResult, sample: Sample) -> Refusal | None:
        """One step of V-MILS at t_s (section 4.2 in its prior form)."""
        state, config = self.state, self.config
        belief = self._now()
        theta, P = belief.arrays()
        phi = np.array(observed.phi)
        nu = observed.y - float(phi @ theta)
        doubt = float(phi @ P @ phi)
        S = doubt + self._marginal_variance(observed)
        # Sums of innovations spread like their long-run variance, not like single ones.
        z = nu / math.sqrt(doubt + self._long_run_variance(observed))
        self.state = replace(
            state,
            belief=belief,
            updated_ns=sample.stamp_ns,
            disturbance_variance=self._learn_disturbance(nu, S),
            cusum=state.cusum.add(z, config.step_allowance, config.gate - 1.0),
            innovation=nu,
            innovation_variance=S,
            test_ratio=nu * nu / (config.gate**2 * S),
        )
        self._watch(observed)
        if self.state.cusum.peak >= config.step_threshold:
            updated = self._relearn()
            stack: tuple[WindowResult, ...] = ()
        elif self.state.test_ratio > 1.0:
            return Refusal(sample.stamp_ns, Reason.OUTLIER, nu, config.gate * math.sqrt(S))
        else:
            stack = (*state.stack, observed)[-config.innovation_length :]
            weights = [config.innovation_length * self._long_run_variance(item) for item in stack]
            updated = multi_innovation_step(belief, stack, weights)
        return self._accept(updated, stack, observed)

    def _accept(self, belief: Belief, stack: tuple[WindowResult, ...], observed: WindowResult) -> Refusal | None:
        state = self.state
        if not belief.is_finite():
            return Refusal(state.stamp_ns, Reason.NUMERICAL, state.innovation, math.nan)
        slow, fast = observed.speed_min, observed.speed_max
        self.state = replace(
            state,
            belief=belief,
            stack=stack,
            speed_min=min(state.speed_min, slow) if state.observations else slow,
            speed_max=max(state.speed_max, fast),
            observations=state.observations + 1,
        )
        return None

    def _now(self) -> Belief:
        """Return the belief after the drift since the last update; never more doubt than at first."""
        state = self.state
        if state.updated_ns == 0 or state.stamp_ns <= state.updated_ns:
            return state.belief
        elapsed_s = (state.stamp_ns - state.updated_ns) / NS_PER_S
        return state.belief.drifted(self._drift_rates, elapsed_s, self._most_doubt)

    def _watch(self, observed: WindowResult) -> None:
        """Remember what was believed, and all observed, since the innovations began to lean to one side."""
        state = self.state
        if state.cusum.peak <= _LEANING or len(state.since) >= _LONGEST_LEAN:
            self.state = replace(state, before=state.belief, since=(observed,))
        else:
            self.state = replace(state, since=(*state.since, observed))

    def _relearn(self) -> Belief:
        """The parameters have stepped: doubt what was believed before, and learn anew all observed since."""
        state = self.state
        belief = state.before.widen(self._step)
        for item in state.since:
            belief = multi_innovation_step(belief, (item,), (self._long_run_variance(item),))
        self.state = replace(state, cusum=NO_STEP, steps_found=state.steps_found + 1)
        return belief

    def _marginal_variance(self, item: WindowResult) -> float:
        """Variance of one observation."""
        return item.noise_std**2 + self.state.disturbance_variance + self._force_variance(item)

    def _long_run_variance(self, item: WindowResult) -> float:
        """Variance per observation of the mean of many: overlap and slow disturbances counted."""
        hop_s = item.duration * self.config.hop / (self.config.window - 1)
        slow = max(1.0, 2.0 * self.config.disturbance_time / hop_s)
        return (
            self._overlap * item.noise_std**2
            + slow * self.state.disturbance_variance
            + self._force_variance(item)
        )

    def _force_variance(self, item: WindowResult) -> float:
        """Variance that gain error and delay of the reported force cost."""
        return (self.config.force_error * item.traction) ** 2 + (self.config.force_skew * item.force_rate) ** 2

    def _judge(self) -> None:
        """Fit to use while w is known over the speeds seen (rms); hysteresis of one half."""
        state = self.state
        if not state.observations:
            return
        speeds = (state.speed_min, 0.5 * (state.speed_min + state.speed_max), state.speed_max)
        belief = self._now()
        rms = math.sqrt(sum(belief.resistance_variance(v) for v in speeds) / len(speeds))
        limit = self.config.valid_std * (1.5 if state.converged else 1.0)
        if state.converged is not (rms < limit):
            self.state = replace(state, converged=rms < limit)

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters and the resistance at a speed [m/s]."""
        state, belief = self.state, self._now()
        a, b, c = belief.theta
        return ResistanceEstimate(
            a=a,
            b=b,
            c=c,
            covariance=belief.P,
            resistance=a + b * speed + c * speed * speed,
            resistance_std=math.sqrt(belief.resistance_variance(speed)),
            speed=speed,
            innovation=state.innovation,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
            speed_min=state.speed_min,
            speed_max=state.speed_max,
        )
