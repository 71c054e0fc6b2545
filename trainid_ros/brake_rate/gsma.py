# SPDX-License-Identifier: Apache-2.0
"""GSMA: brake rate by the group stochastic M-algorithm, a Rao-Blackwellised particle filter.

After Zheng et al. 2015, section 3.5. (n) is an equation of the paper; [n] marks the same step in the code, here and in
:mod:`m_algorithm`. f is the brake rate, x = [v, a, b, e] the motion of the train and the errors of the train file, see
:mod:`motion_model`. State: particles (f_i, x_i) in strata m (quiet, jumping) with the weights W_m, means mu_m and
variances s_m^2 of f; one covariance P of x given f for all particles.

    [1]  f_i = quantiles of the prior, W = stationary weights of the Markov chain T, P = variances of the errors e
    for each sample with the speed y, measured with variance r, dt after the last one:
    [2]      x_i = Phi x_i + gamma f_i + known input                                                (14)
    [3]      P = Phi P Phi' + Q                                                                     (14)
    [4]      S = P_vv + r                                                                           (16)
    [5]      K = P e_v / S                                                                          (20)
    [6]      P = P - K e_v' P                                                                       (21)
    [7]      if the brake does not act: x_i = x_i + K (y - v_i), with f unchanged; next sample      (21)
    [8]      after a pause without braking: scale f about its mean, which adds the variance drift^2 pause
    [9]      f_i = mu_m + sqrt(1 - kappa^2) (f_i - mu_m), and x_i along its regression on f
    [10]     h_m = sqrt(3 (q_m dt + kappa^2 s_m^2)); group of i: f_ig = f_i + h_m {-1, 0, 1}_g         section 3.5
    [11]     w_ig = W_m / N_m {1/6, 4/6, 1/6}_g N(y; v_ig, S), or 0 unless 0 <= f_ig <= f_max         (17)
    [12]     w_ig = w_ig / sum of all w                                                             (18)
    [13]     W_m, mu_m, s_m^2 = moments of f_ig with the weights w_ig T_{stratum of i, m}
    [14]     choose N_m survivors by systematic resampling in the order of f, with the weights of [13]
    [15]     shift and scale the f of the survivors to mu_m and s_m^2
    [16]     x_ig = x_ig + K (y - v_ig)                                                             (21)
    [17]     x of the survivors: shifted to the mean and the regression on f before [14]
    [18]     f = sum of W_m mu_m                                                                    (19)
    [19]     x = sum of w_ig x_ig                                                                   (22)

The same in plain numpy is ``test/brake_rate/reference_gsma.py``. The differences from the paper are explained in
:mod:`m_algorithm`. Two more:

* f affects only the mean of x, so all particles share one covariance; (14), (16), (20) and (21) of the paper have one
  for each particle.
* A jump can be detected only while the response of the brake to its command is steady. Before that, an error of dead
  time or lag has the same effect. Time in the chain T is therefore scaled by the steadiness, and the probability of a
  jump while no brake acted is kept until then.

Without jumps this is the exact filter, except for sampling noise.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from statistics import NormalDist
from typing import ClassVar, Final

import numpy as np

from trainid_ros.brake_rate.brake_rate_estimator import MAX_RATE_FACTOR, BrakeRateEstimator
from trainid_ros.brake_rate.m_algorithm import GroupCloud, zeros
from trainid_ros.brake_rate.motion_model import ERRORS, NO_ERRORS, STATES, Errors, Start, Transition, true_brake
from trainid_ros.estimators.settings import GsmaConfig, JumpConfig
from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import BrakeRateEstimate
from trainid_ros.interface.scalars import is_finite
from trainid_ros.interface.state import State, declare, definite
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.suggested_drive import STEP_S, Run
from trainid_ros.stream.samples import SAMPLE_PERIOD, Sample, coasting_sample
from trainid_ros.train.forces import BrakeCommandChange, acceleration, davis, lag_integral, lag_response
from trainid_ros.train.train_file import TrainFile

_E: Final = 3


class Covariance:
    """Covariance P of x, shape (n, n), row by row, and gain K of the last measured speed, eq. (20), shape (n,)."""

    STATE: ClassVar[State] = declare(definite('P'))

    def __init__(self) -> None:
        self.P, self.K = vec[float]([0.0] * (STATES * STATES)), vec[float]([0.0] * STATES)
        # Row v of Phi, and the diagonal of the others.
        self._gains, self._decay = vec[float]([1.0] * STATES), vec[float]([1.0] * STATES)

    def reset(self, stds: Errors) -> None:
        """Set uncertainty in the errors only."""
        for k in range(STATES * STATES):
            self.P[k] = 0.0
        for j, std in enumerate(stds):
            self.P[(_E + j) * (STATES + 1)] = std * std

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        P, decay_e, n = self.P, start.decay_e, STATES
        for k in range(_E * n):
            P[k] = 0.0
        for i in range(ERRORS):
            row = (_E + i) * n
            P[row] = P[row + 1] = P[row + 2] = 0.0
            for j in range(ERRORS):
                P[row + _E + j] *= decay_e[i] * decay_e[j]
            P[row + _E + i] += start.q_e[i]
        P[0], P[n + 1], P[2 * (n + 1)] = start.variances

    def predict(self, step: Transition) -> None:
        """Predict over an interval; only v takes from other states."""
        # [3] P = Phi P Phi' + Q, eq. (14)
        P, gains, decay, n = self.P, self._gains, self._decay, STATES
        gains[1], gains[2], decay[1], decay[2] = step.reach, step.dt, step.decay, step.rho
        for j in range(ERRORS):
            gains[_E + j], decay[_E + j] = step.gain_e[j], step.decay_e[j]
        variance = 0.0
        for j in range(n):
            with_v = 0.0
            for i in range(n):
                with_v += gains[i] * P[i * n + j]
            variance += gains[j] * with_v
            P[j] = decay[j] * with_v
            for i in range(1, n):
                P[i * n + j] *= decay[i] * decay[j]
        for j in range(1, n):
            P[j * n] = P[j]
        P[0] = variance + step.q_v
        P[2 * (n + 1)] += step.q_b
        for j in range(ERRORS):
            P[(_E + j) * (n + 1)] += step.q_e[j]

    def error_variance(self, share: vec[float]) -> float:
        """Return the variance of share e, shape (8,), given f."""
        variance = 0.0
        for i in range(ERRORS):
            for j in range(ERRORS):
                variance += share[i] * self.P[(_E + i) * STATES + _E + j] * share[j]
        return variance

    def correct(self, r: float) -> float:
        """Set the gain of a measured speed of variance r [(m/s)^2], update P; return the variance of the innovation."""
        P, K, n = self.P, self.K, STATES
        # [4] Eq. (16).
        S = P[0] + r
        # [5] Eq. (20).
        for i in range(n):
            K[i] = P[i] / S
        # [6] Eq. (21), from below because the first row is that of before.
        for i in range(n - 1, -1, -1):
            for j in range(i + 1):
                P[i * n + j] -= K[i] * P[j]
        for i in range(1, n):
            for j in range(i):
                P[j * n + i] = P[i * n + j]
        return S


def transition(config: JumpConfig, dt: float, pause: float = 0.0) -> tuple[float, float]:
    """Return the probabilities [1] that a quiet brake started to jump, and that a jump ended.

    Jumps are observable for ``dt`` [s], the sample period times ``steadiness``; before, no brake acted in a pause [s].
    """
    return -math.expm1(-config.jump_rate * (dt + pause)), -math.expm1(-dt / config.jump_time)


def drifts(config: JumpConfig) -> tuple[float, float]:
    """Return the variance of f per second in the quiet and in the jumping state [1/s].

    Over its mean duration a jump has the variance ``jump_std^2``.
    """
    quiet = config.drift**2
    return quiet, quiet + config.jump_std**2 / config.jump_time


class GsmaPosterior:
    """Particles in a quiet and a jumping stratum, with one covariance for all; see :class:`Posterior`."""

    STATE: ClassVar[State] = declare('cloud', '_covariance', '_effective', '_rng')

    def __init__(self, config: GsmaConfig, expected: float, rng: np.random.Generator) -> None:
        self._drift, self._max_rate = config.drift, MAX_RATE_FACTOR * expected
        self._rng = rng
        self._random0 = json.dumps(rng.bit_generator.state)
        jumping = max(3, round(config.particles / 3)) if config.jump_rate > 0.0 else 0
        self._sizes = [config.particles - jumping, jumping] if jumping else [config.particles]
        self._q = drifts(config)
        self._walk, self._chain = zeros(len(self._sizes)), vec[float]([1.0] * len(self._sizes) ** 2)
        self.cloud, self._covariance = GroupCloud(self._sizes), Covariance()
        self._config = config
        self.reset(expected, config.prior_std, NO_ERRORS)

    @property
    def rate(self) -> float:
        """Mean of f [1]."""
        return self.cloud.rate

    @property
    def variance(self) -> float:
        """Variance of f [1]."""
        return self.cloud.rate_variance

    def total_rate(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance of f + share e [1]: from the particles, plus the variance of e given f."""
        mean, spread = self.cloud.total(share)
        return mean, spread + self._covariance.error_variance(share)

    @property
    def speed(self) -> float:
        """Mean of v [m/s]."""
        return self.cloud.expected(0)

    @property
    def acceleration(self) -> float:
        """Mean of a [m/s^2]."""
        return self.cloud.expected(1)

    @property
    def effective(self) -> float:
        """Effective number of children in the last step that updated f [1]."""
        return self._effective

    @property
    def errors(self) -> Errors:
        """Means of the errors of the train file."""
        c = self.cloud
        return (
            c.expected(3), c.expected(4), c.expected(5), c.expected(6),
            c.expected(7), c.expected(8), c.expected(9), c.expected(10),
        )  # fmt: skip

    @property
    def error_variances(self) -> Errors:
        """Variances of the errors of the train file."""
        return (
            self._variance_of(3), self._variance_of(4), self._variance_of(5), self._variance_of(6),
            self._variance_of(7), self._variance_of(8), self._variance_of(9), self._variance_of(10),
        )  # fmt: skip

    def _variance_of(self, j: int) -> float:
        return self._covariance.P[j * (STATES + 1)] + self.cloud.spread(j)

    def reset(self, rate: float, std: float, error_stds: Errors) -> None:
        """Reset to the prior: particles at its quantiles, strata at the stationary weights of the Markov chain."""
        # [1]
        prior = NormalDist(rate, std)
        f = [max(0.0, prior.inv_cdf((i + 0.5) / n)) for n in self._sizes for i in range(n)]
        starts, ends = transition(self._config, 1.0)
        weight = [ends / (starts + ends), starts / (starts + ends)] if len(self._sizes) > 1 else [1.0]
        self.cloud.start(f, weight)
        self._covariance.reset(error_stds)
        self._effective = float(len(f))
        self._rng.bit_generator.state = json.loads(self._random0)

    def reinit_motion(self, start: Start) -> None:
        """Restart v, a and b."""
        self.cloud.reinit_motion(start)
        self._covariance.reinit_motion(start)

    def recentre(self, shift: Errors) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old."""
        self.cloud.recentre(vec[float](shift))

    def predict(self, interval: Transition) -> None:
        """Predict the motion over an interval."""
        self.cloud.predict(interval)
        self._covariance.predict(interval)

    def predicted(self) -> tuple[float, float]:
        """Return mean [m/s] and variance [(m/s)^2] of v."""
        return self.speed, self._covariance.P[0] + self.cloud.speed_spread()

    def follow(self, speed: float, r: float) -> None:
        """Update without f, with a measured speed [m/s] of variance r [(m/s)^2]."""
        # [7] Eq. (21), with f unchanged.
        self._covariance.correct(r)
        self.cloud.follow(speed, self._covariance.K)

    def update(self, interval: Transition, elapsed: float, speed: float, r: float) -> bool:
        """Update with a measured speed [m/s] of variance r [(m/s)^2]: one step of GSMA, eqs. (14)-(22)."""
        mean, variance = self.predicted()
        if not is_finite(speed - mean + variance):
            return False
        dt, steadiness, pause = interval.dt, interval.steadiness, elapsed - interval.dt
        # [8]
        if pause > 1e-6:  # a shorter one is rounding
            self.cloud.inflate_variance(interval, self._drift * self._drift * pause)
        quiet, jumping = self._q
        self._walk[0] = quiet * dt
        if len(self._sizes) > 1:
            # A jump is possible only as far as the response is steady.
            self._walk[1] = (quiet + steadiness * (jumping - quiet)) * dt
            starts, ends = transition(self._config, steadiness * dt, max(0.0, pause))
            self._chain[0], self._chain[1], self._chain[2], self._chain[3] = 1.0 - starts, starts, ends, 1.0 - ends
        S = self._covariance.correct(r)
        uniforms: list[float] = self._rng.random(len(self._sizes)).tolist()
        self._effective = self.cloud.update(
            interval, self._walk, speed, self._covariance.K, S, self._max_rate, self._chain, uniforms
        )
        return True


# In a planned braking: time for which the train rolls before it, and the longest one [s].
_BEFORE_S: Final = 2.0
_MAX_BRAKING_S: Final = 300.0


class Gsma(BrakeRateEstimator):
    """Group stochastic M-algorithm."""

    def __init__(self, train_file: TrainFile, config: GsmaConfig, rng: np.random.Generator) -> None:
        check_settings(config)
        super().__init__(train_file, config, GsmaPosterior(config, true_brake(train_file).rate, rng))
        self._train_file, self._gsma_config = train_file, config

    def foreseen(self, run: Run, times: int) -> Iterator[BrakeRateEstimate]:
        """Yield the estimates after one, two, ... of a number of runs with a braking; none before the first sample.

        They depend on the noise that was learned, on the particles, and on what is known of dead time, lag and the
        other errors of the train file. So a copy goes through the braking, with its own predicted speed plus noise.
        """
        if not self.state.stamp_ns:
            return
        copy = Gsma(self._train_file, self._gsma_config, np.random.default_rng())
        copy.restore(self.save())
        for _ in range(times):
            start_ns = copy.state.stamp_ns + round(len(run.steps) * STEP_S * NS_PER_S)
            for sample in copy._planned(run, start_ns):
                copy.step(sample)
            yield copy.estimate(0.0)

    def _planned(self, run: Run, start_ns: int) -> Iterator[Sample]:
        """Yield samples of a braking to the stop, on level track, by a brake as it is estimated."""
        state, train, resistance = self.state, self._train_file.train, self._train_file.resistance
        factor, lag, std = self.posterior.rate, state.timing.lag, math.sqrt(state.noise.variance)
        begin, acts_s, command = round(_BEFORE_S / SAMPLE_PERIOD), _BEFORE_S + state.timing.delay, run.manoeuvre.braking
        rng, v, target = np.random.default_rng(0), run.manoeuvre.start, 0.0
        for k in range(round(_MAX_BRAKING_S / SAMPLE_PERIOD)):
            is_standing = v < self.config.min_speed
            stamp_ns = start_ns + round(k * SAMPLE_PERIOD * NS_PER_S)
            # The holding brake is released at the start.
            given = {0: 0.0, begin: command}.get(k)
            measured = 0.0 if is_standing else v + std * float(rng.standard_normal())
            sample = coasting_sample(stamp_ns, math.nan if k == 0 else SAMPLE_PERIOD, measured)
            sample.brake_command = command if k >= begin else 0.0
            sample.brake_changes = () if given is None else (BrakeCommandChange(stamp_ns, given),)
            sample.curvature_mean = 0.0
            yield sample
            if is_standing:
                return
            acting_s = min(SAMPLE_PERIOD, max(0.0, (k + 1) * SAMPLE_PERIOD - acts_s))
            braked = factor * self._train_file.brake.shape_at(v) * lag_integral(target, command, lag, acting_s)
            target = lag_response(target, command, lag, acting_s)
            coasting = acceleration(0.0, train.mass, train.rotary_mass, davis(resistance, v))
            v += braked + SAMPLE_PERIOD * coasting
