# SPDX-License-Identifier: Apache-2.0
"""filter-bank: Davis parameters with realistic uncertainty of mass, force, map and wheel diameter.

A bank of extended Kalman filters on raw speed. It is not from one of the three papers. It combines Bayesian
change-point detection (Adams and MacKay 2007) with a multiple-model estimator of the noise sizes (Blom and Bar-Shalom
1988). (1) is the motion at the head of :mod:`hypotheses`; [n] marks the same step in the code: here and in
:mod:`hypotheses`. A hypothesis i has a filter (x_i, P_i) with x = [v, a, b, c, g, e, kappa,
delta, kappa_R], a weight W_i, an age, and sizes of gusts g and map errors e.

    [1]  hypotheses = {stated prior, wide prior of small weight} x all sizes
    at each departure with the measured speed y of variance R:
    [2]      v = y, g = e = 0; after a stop P_kappa += change of load; after ten minutes P_a, P_c += possible step
    for each sample with y and R, two samples late since a delayed force needs the following reports:
    [3]      T(t + delta) by a cubic through four reports; variance of v by the noise of the force
    [4]      x_i = solution of (1) over dt with the speed in the middle; g and e decay
    [5]      P_i = F P_i F' + Q
    [6]      nu, S = innovation of the mixture of all predictions and its variance: for outliers and diagnostics
    [7]      S_i = P_vv + R,  nu_i = y - v_i
    [8]      L_i = (1 - eps) N(nu_i; 0, S_i) + eps / 2 m/s;  w_i = first term / L_i
    [9]      K = P_i e_v / (P_vv + R / w_i);  x_i = x_i + K nu_i;  P_i = P_i - K e_v' P_i
    [10]     W_i = W_i L_i,  age_i = age_i + dt
    every 10 s, from the hypothesis of the largest weight:
    [11]     branch: P_aa += step, W = W p(step); the same for c; and one with other sizes of gusts or map errors
    [12]     prune to the maximum number; young ones have a bonus
    estimate:
    [13]     mean = sum of W_i x_i over hypotheses of the minimum age
    [14]     covariance = that of the mixture, in which young hypotheses count more: a step may just have happened
    [15]     covariance = inflation covariance + error of the wheel diameter

The same in plain numpy is ``test/resistance/reference_filter_bank.py``. Mass and force gain are known only to a few per
cent, and forces are reported late; kappa is observable by driving with different tractive efforts, delta while the
traction ramps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from trainid_ros.estimators.settings import FilterBankConfig, prior_variances
from trainid_ros.interface.errors import check_settings
from trainid_ros.interface.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.interface.scalars import is_finite, seconds
from trainid_ros.interface.state import State, declare, encode, restore, several
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.davis_posterior import (
    CURVE_RADIUS,
    DrivenSpeeds,
    Inflation,
    drift_growth,
    force_variances,
    is_delay_at_end,
    is_fit_to_use,
    length_under_train,
    resistance_estimate,
    scale_step,
)
from trainid_ros.resistance.hypotheses import (
    DELTA,
    KAPPA,
    KAPPA_R,
    N_PUBLISHED,
    STATES,
    A,
    AdmittedSample,
    Array,
    B,
    Bank,
    BankPlan,
    C,
    Innovation,
    Interval,
    Mixture,
    ProcessNoise,
)
from trainid_ros.resistance.suggested_drive import STEP_S, Run, Step
from trainid_ros.stream.known_force import Admission, KnownForce, SpeedNoise
from trainid_ros.stream.samples import SAMPLE_PERIOD, Sample
from trainid_ros.train.forces import STANDING
from trainid_ros.train.train_file import TrainFile

# Hypothetical sizes of gusts and map errors, as multiples of the settings.
_GUST_SIZES, _MAP_SIZES = (1.0, 2.0, 4.0, 8.0), (0.25, 1.25)
# Step of the traction interpolation [s], at least one sample; two later steps must be available.
_SPACING_S: Final = 0.2
_STEPS_AHEAD: Final = 2
# Innovations beyond this many standard deviations have a weight below 0.001.
_GATE: Final = 5.5
# Duration of consecutive rejections after which the filters restart from the measured speed [s].
_RESTART_AFTER_S: Final = 5.0
# Longer than a stop, so that weather and train may have changed in the meantime [s].
_IDLE_S: Final = 600.0
# Number of accepted samples between two tests whether the estimate is fit to use, a second at 5 Hz; and the time since
# the last sample from which on each is tested [ns].
_VALIDITY_CHECK_INTERVAL: Final = 5
_VALIDITY_CHECK_AFTER_NS: Final = 210_000_000
# Standard deviation of the relative error of the wheel diameter, which is up to about half a per cent.
_WHEEL_STD: Final = 0.003
# Indices of kappa and delta in a mixture.
_SCALE: Final = 3
_DELAY: Final = 4


class FilterBank:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples, one update per sample.

    Attributes:
        config: Settings.
        bank: The hypotheses.
    """

    STATE: ClassVar[State] = declare(
        'bank', '_speed_noise', '_inflation', several('_admitted', AdmittedSample), '_driven', '_running', '_stopped',
        '_stride', '_rejected_s', '_admission', '_advanced_ns', '_innovation', '_innovation_variance', '_test_ratio',
        '_converged',
    )  # fmt: skip

    def __init__(self, train_file: TrainFile, config: FilterBankConfig, plan: BankPlan | None = None) -> None:
        """Prepare; ``plan`` replaces that of the train file and the settings."""
        check_settings(config)
        self.config = config
        self._train = train_file.train
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self.bank = Bank(plan or bank_plan(train_file, config, self._known.inertia))
        self._clear()

    def _clear(self) -> None:
        self._speed_noise = SpeedNoise.declared(self.config.speed_std, robust=True)
        self._inflation = Inflation()
        self._admitted: list[AdmittedSample] = []
        self._stride = 1
        # Of the newest sample, for drives that are foreseen; not saved.
        self._sampled_s, self._weighed = _SPACING_S, False
        self._driven = DrivenSpeeds()
        self._running = self._stopped = self._converged = False
        self._rejected_s, self._admission.braked_ns, self._advanced_ns = 0.0, 0, 0
        self._innovation = self._innovation_variance = self._test_ratio = 0.0
        # What is published; None where the hypotheses or the inflation have changed since it was computed.
        self._published: Mixture | None = None

    def reset(self) -> None:
        """Return to the prior."""
        self.bank.reset()
        self._clear()

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the driven speeds."""
        return self._converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; the filters run two steps late."""
        if (rejection := self._admission.reject(sample)) is not None:
            self._interrupt(sample)
            return rejection
        self._speed_noise.add(sample.speed, sample.dt)
        self._admitted.append(self._admit(sample))
        if len(self._admitted) == 1 and self._converged:  # the speed may be far from where the last drive ended
            self._check_validity()
        if len(self._admitted) <= _STEPS_AHEAD:  # the first samples of a drive set its stride, at most 50 of them
            self._stride = max(1, min(round(_SPACING_S / sample.dt), 50))
        while len(self._admitted) > (_STEPS_AHEAD + 1) * self._stride + 1:
            del self._admitted[0]
        if len(self._admitted) > _STEPS_AHEAD * self._stride:
            return self._advance()
        return None

    def _admit(self, sample: Sample) -> AdmittedSample:
        self._sampled_s, self._weighed = sample.dt, sample.weighed
        return AdmittedSample(
            stamp_ns=sample.stamp_ns,
            dt=sample.dt,
            speed=sample.speed,
            traction=self._known.traction(sample.force_mean, sample),
            track=self._known.track(sample),
            curve=CURVE_RADIUS * sample.curvature,
            variance=self._speed_noise.variance,
            weighed=sample.weighed,
            force_interval=sample.force_interval,
        )

    def _interrupt(self, sample: Sample) -> None:
        """End the drive, so that the next admitted sample starts a new one."""
        self._admitted.clear()
        self._running = False
        # NaN marks a gap: speed is zero without noise at rest, and has jerks under hard braking.
        self._speed_noise.add(sample.speed, math.nan)
        self._stopped = self._stopped or sample.speed < STANDING

    def _advance(self) -> Rejection | None:
        """Move the filters over the newest interval with enough later force reports."""
        self._published, stride = None, self._stride
        sample, next_, last = self._admitted[-1 - 2 * stride], self._admitted[-1 - stride], self._admitted[-1]
        if not self._running:
            self._depart(sample)
            return None
        before = self._admitted[max(-1 - 3 * stride, -len(self._admitted))]
        traction = (before.traction, sample.traction, next_.traction, last.traction)
        interval = Interval(
            dt=sample.dt,
            traction=traction,
            track=sample.track,
            curve=sample.curve,
            speed=sample.speed,
            speed_variance=sample.variance,
            spacing=stride * sample.dt,
            force_interval=sample.force_interval,
        )
        # [3]-[12]
        innovation = self.bank.advance(interval)
        if not is_finite(innovation.variance):
            self.bank.reset()
            # The estimate is lost, so it is not fit to use, and the driven speeds are cleared.
            self._driven, self._inflation = DrivenSpeeds(), Inflation()
            self._running = self._converged = False
            return Rejection(sample.stamp_ns, Reason.NUMERICAL, innovation.value, math.nan)
        return self._account(sample, innovation)

    def idle(self, seconds: float) -> None:
        """Add the variance of possible steps in a time without samples [s]; after a long one nothing is fit to use."""
        self.bank.idle(seconds)
        self._published = None
        self._converged = self._converged and seconds <= _IDLE_S

    def _depart(self, sample: AdmittedSample) -> None:
        """Restart the speed; after a stop the load may have changed, after a long idle time also a and c."""
        idle_s = seconds(sample.stamp_ns - self._advanced_ns) if self._advanced_ns else 0.0
        if idle_s > _IDLE_S:
            self.idle(idle_s)
        # [2]
        if self._stopped:
            self.bank.inflate_force_scale_variance(scale_step(self._train, weighed=sample.weighed) ** 2)
            self._stopped = False
        self.bank.restart(sample.speed, sample.variance)
        self._running, self._rejected_s, self._advanced_ns = True, 0.0, sample.stamp_ns
        if self._converged:
            self._check_validity()

    def _account(self, sample: AdmittedSample, innovation: Innovation) -> Rejection | None:
        """Record the innovation as a resistance [N/kN]; return the rejection of an outlier."""
        nu, S = innovation.value, innovation.variance
        per_speed = self.bank.plan.noise.inertia / sample.dt
        self._innovation, self._innovation_variance = -per_speed * nu, per_speed * per_speed * S
        self._test_ratio = nu * nu / (_GATE * _GATE * S)
        self._inflation.add(innovation.weight * nu / math.sqrt(S), 1.0, sample.dt)
        if self._test_ratio > 1.0:
            self._rejected_s += sample.dt
            self._running = self._rejected_s < _RESTART_AFTER_S - 0.5 * sample.dt
            return Rejection(sample.stamp_ns, Reason.OUTLIER, nu, _GATE * math.sqrt(S))
        since_ns, self._rejected_s, self._advanced_ns = sample.stamp_ns - self._advanced_ns, 0.0, sample.stamp_ns
        self._driven.add(sample.speed)
        if self._driven.count % _VALIDITY_CHECK_INTERVAL == 0 or since_ns > _VALIDITY_CHECK_AFTER_NS:
            self._check_validity()
        return None

    def _check_validity(self) -> None:
        """Decide whether w is fit to use: at the driven speeds, and at the present one even if a step just happened."""
        config, speed = self.config, self._admitted[-1].speed
        now = self._inflated(self.bank.mixture(), self._inflation.factor)
        # A delay outside the range that can be estimated biases the other states.
        self._converged = not is_delay_at_end(now.mean[_DELAY]) and is_fit_to_use(
            now.davis,
            self._current().davis,
            self._driven,
            speed,
            (config.valid_std, config.valid_share),
            was_fit=self._converged,
        )

    def _current(self) -> Mixture:
        """Return what is published: it covers steps that may just have happened."""
        if self._published is None:
            # [13]-[15]
            self._published = self._inflated(self.bank.mixture(self.bank.plan.young_weight), self._inflation.factor)
        return self._published

    def _inflated(self, now: Mixture, factor: float) -> Mixture:
        """Return a mixture whose covariance is inflated for unmodelled errors and wheel diameter errors."""
        a, c, kappa = now.mean[0], now.mean[2], now.mean[_SCALE]
        # [15] A relative wheel diameter error r adds r a to a, -r c to c and a share r to the force scale 1 + kappa.
        wheel = vec[float]([_WHEEL_STD * x for x in (a, 0.0, -c, 1.0 + kappa, 0.0)])
        covariance = now.covariance[:]
        k = 0
        for i in range(N_PUBLISHED):
            for j in range(i, N_PUBLISHED):
                covariance[k] = factor * covariance[k] + wheel[i] * wheel[j]
                k += 1
        return Mixture(now.mean, covariance)

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [N/kN] and its variance before it [(N/kN)^2], as in the estimate."""
        return self._innovation, self._innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        return self._estimate(self._current(), speed)

    def _estimate(self, now: Mixture, speed: float) -> ResistanceEstimate:
        # The upper triangle ends with the variance of kappa, its covariance with delta, and the variance of delta.
        scale_std = math.sqrt(max(now.covariance[12], 0.0))
        delay_std = math.sqrt(max(now.covariance[14], 0.0))
        return resistance_estimate(
            now.davis,
            speed,
            (self._innovation, self._innovation_variance, self._test_ratio),
            (self._driven.slowest, self._driven.fastest),
            (1.0 + now.mean[_SCALE], scale_std, now.mean[_DELAY], delay_std),
        )

    def foreseen(self, run: Run, times: int, deviations: Array | None = None) -> Iterator[ResistanceEstimate]:
        """Yield the mean estimates after one, two, ... of a number of runs, each from a stop.

        Covariances are means over n sequences of innovations over their standard deviations, shape (n, times, steps);
        by default those of :func:`usual_deviations`.
        """
        mean, slowest = self._current().mean, self.config.min_speed
        first = max(1, run.first_learned(self._known.settling, slowest))
        speed_variance = self._speed_noise.variance * self._sampled_s / STEP_S
        variances = speed_variance, scale_step(self._train, weighed=self._weighed) ** 2
        found = [
            list(foreseen_mixtures(self.bank, run, sequence, first, 0.5 * slowest, variances))
            for sequence in (usual_deviations(run, times) if deviations is None else deviations)
        ]
        for k, mixtures in enumerate(zip(*found, strict=True), 1):
            factor = self._inflation.foreseen(k * len(run.steps) * STEP_S)
            covariance = np.mean([list(mixture.covariance) for mixture in mixtures], axis=0)
            now = self._inflated(Mixture(mean, vec[float](covariance.tolist())), factor)
            yield self._estimate(now, run.steps[-1].speed)

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)
        self._published = None


def usual_deviations(run: Run, times: int) -> Array:
    """Return innovations over their stds, shape (2, times, steps): one sequence, and the same negated.

    How soon a step can be excluded that may just have happened depends on them.
    """
    one = np.random.default_rng(times).standard_normal((times, len(run.steps)))
    return np.stack([one, -one])


def foreseen_mixtures(
    now: Bank, run: Run, deviations: Array, first: int, slowest: float, variances: tuple[float, float]
) -> Iterator[Mixture]:
    """Yield the mixture after each of some runs from a stop; the bank stays as it is.

    Args:
        now: The bank.
        run: The run, driven once or more.
        deviations: Innovations over their standard deviations, shape (runs, steps).
        first: Index of the first step from which is learned, at least 1.
        slowest: Speed at which the train is taken to stop [m/s].
        variances: Variance of the speed at the end of a step [(m/s)^2], and of the force scale at a stop [1].
    """
    bank, (speed_variance, scale_variance) = Bank(now.plan), variances
    restore(bank, encode(now))
    for row in deviations.tolist():
        bank.inflate_force_scale_variance(scale_variance)
        bank.restart(run.steps[first - 1].speed, speed_variance)
        for step, deviation in zip(run.steps[first:], row[first:], strict=True):
            if not bank.simulate_step(_planned(step, speed_variance), deviation, slowest):
                break
        yield bank.mixture(bank.plan.young_weight)


def _planned(step: Step, variance: float) -> Interval:
    """Return a planned step as an interval; ``variance`` is that of the speed at its end [(m/s)^2]."""
    T, change = step.traction, step.ramp * _SPACING_S
    return Interval(
        dt=STEP_S,
        traction=(T - change, T, T + change, T + 2.0 * change),
        track=0.0,
        curve=0.0,
        speed=step.speed,
        speed_variance=variance,
        spacing=_SPACING_S,
        force_interval=_SPACING_S,
    )


def bank_plan(train_file: TrainFile, config: FilterBankConfig, inertia: float) -> BankPlan:
    """Return the settings of the bank for a train; inertia = 1000 (1 + gamma) / g0 [N/kN per m/s^2]."""
    davis, mean, variance = train_file.resistance, np.zeros(STATES), np.zeros(STATES)
    mean[[A, B, C]] = davis.a, davis.b, davis.c
    variance[[A, B, C]] = prior_variances((davis.a, davis.b, davis.c), config)
    variance[[KAPPA, DELTA, KAPPA_R]] = force_variances(train_file, config.force_delay_std)
    drift = drift_growth(config.drift_share) * variance
    drift[KAPPA] = 0.0  # kappa changes only at stops
    # The text of the setting states the share of a; a step of c is not zero without c.
    step_a, step_c = config.step_a + 0.15 * davis.a, max(config.step_share_c * davis.c, 1e-6)
    gradient_std = train_file.line.gradient_std
    map_stds = tuple(size * gradient_std for size in _MAP_SIZES) if gradient_std > 0.0 else (0.0,)
    return BankPlan(
        mean=mean,
        variance=variance,
        gust_stds=tuple(size * config.gust_std for size in _GUST_SIZES),
        map_stds=map_stds,
        step_variances=(step_a**2, step_c**2),
        hazard=1.0 / config.step_interval,
        branch_interval=config.branch_interval,
        hypotheses=config.hypotheses,
        min_age=config.min_age,
        young_weight=config.young_weight,
        wrong_prior=config.wrong_prior,
        drift=drift,
        noise=ProcessNoise(
            inertia=inertia,
            gust_time=config.gust_time,
            map_length=length_under_train(config.map_length, train_file.train.length),
            force_density=config.force_noise**2 * SAMPLE_PERIOD,  # the noise is stated for the mean over a sample
            skew=config.force_skew,
            outliers=config.outlier_share,
        ),
    )
