# SPDX-License-Identifier: Apache-2.0
"""filter-bank: Davis parameters with realistic uncertainty of mass, force, map and wheel diameter.

A bank of extended Kalman filters on raw speed, see :mod:`hypotheses` and :mod:`speed_states`. For real trains the
force errors are states: a scale kappa on the specific force, since mass and force gain are known only to a few per
cent, and a delay delta, since forces are reported late. Both are observable in normal operation: kappa by driving
with different tractive efforts, delta while the traction ramps.

The filters run two steps (0.4 s or two samples) late, since a delayed force needs the following force reports.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import prior_variances
from trainid_ros.estimators.speed_noise import SpeedNoise
from trainid_ros.records import NS_PER_S
from trainid_ros.resistance.fitness import DrivenSpeeds, drift_growth, is_fit_where_driven
from trainid_ros.resistance.force_errors import CURVE_RADIUS, force_errors, is_delay_at_end, scale_step
from trainid_ros.resistance.hypotheses import Bank, BankPlan, Hypotheses, Mixture
from trainid_ros.resistance.inflation import Inflation
from trainid_ros.resistance.speed_states import (
    DELTA,
    KAPPA,
    KAPPA_R,
    STATES,
    A,
    B,
    C,
    Interval,
    ProcessNoise,
    V,
)
from trainid_ros.results import Reason, Rejection, ResistanceEstimate
from trainid_ros.settings import check_settings, setting
from trainid_ros.state import check_not_negative, check_numbers, check_restored, decode, encode, is_covariance_matrix
from trainid_ros.stream.samples import STANDING

if TYPE_CHECKING:
    from trainid_ros.resistance.hypotheses import Innovation
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Hypothetical disturbance sizes, as multiples of the settings.
_GUST_SIZES: Final = (1.0, 2.0, 4.0, 8.0)
_MAP_SIZES: Final = (0.25, 1.25)
# Step of the traction interpolation [s], at least one sample; two later steps must be available.
_SPACING_S: Final = 0.2
_STEPS_AHEAD: Final = 2
# Maximum number of samples in two steps ahead and one behind.
_MAX_TICKS: Final = 200
# Innovations beyond this many standard deviations have a weight below 0.001.
_GATE: Final = 5.5
# Duration of consecutive rejections after which the filters restart from the measured speed [s].
_RESTART_AFTER_S: Final = 5.0
# Longer than a stop, so that weather and train may have changed in the meantime [s].
_IDLE_S: Final = 600.0
# Number of accepted samples between two tests whether the estimate is fit to use.
_JUDGED_EVERY: Final = 5
# Standard deviation of the relative error of the wheel diameter, which is up to about half a per cent.
_WHEEL_STD: Final = 0.003
# Forces within the valid range of the records lead to lower speeds; beyond, the filter steps would diverge [m/s].
_MAX_SPEED: Final = 1e5
# Share of a added to the std of its steps; minimum std of a step of c [N/kN per (m/s)^2].
_STEP_SHARE_A: Final = 0.15
_MIN_STEP_C: Final = 1e-6
# Age up to which a hypothesis is young [s].
_YOUTH_S: Final = 120.0
# Sample interval for which the white noise of the force is stated [s].
_FORCE_INTERVAL_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class FilterBankConfig:
    """Settings of the filter bank."""

    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    gust_std: float = setting(0.1, 'smallest std of gusts; 2, 4 and 8 times it are tried too', 'N/kN', 1e-3, 10.0)
    gust_time: float = setting(6.0, 'correlation time of gusts', 's', 0.1, 600.0)
    map_length: float = setting(250.0, 'correlation length of map errors', 'm', 1.0, 1e5)
    force_noise: float = setting(0.35, 'white noise of the reported specific force', 'N/kN', 0.0, 100.0)
    force_delay_std: float = setting(0.15, 'prior std of the delay of the reported force', 's', 0.0, 1.0)
    force_skew: float = setting(0.015, 'jitter between the stamps of force and speed', 's', 0.0, 1.0)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their stated values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    drift_share: float = setting(
        0.03, 'drift in one hour, except of the force scale, std as a share of the prior std', '1', 0.0, 100.0
    )
    outlier_share: float = setting(0.01, 'share of outliers among the speeds', '1', 1e-6, 0.5)
    step_interval: float = setting(3600.0, 'mean time between steps of a or c', 's', 60.0, 1e7)
    step_a: float = setting(0.3, 'std of a step of a, to which 15 % of a are added', 'N/kN', 1e-3, 10.0)
    step_share_c: float = setting(0.2, 'std of a step of c as a share of c', '1', 1e-3, 10.0)
    hypotheses: int = setting(28, 'maximum number of hypotheses', '', 4, 1000)
    branch_interval: float = setting(10.0, 'driving time between branchings', 's', 1.0, 1000.0)
    patience: float = setting(10.0, 'minimum age of a hypothesis in the estimate', 's', 0.0, 1000.0)
    suspicion: float = setting(200.0, 'weight of young hypotheses in the stated covariance', '1', 1.0, 1000.0)
    wrong_prior: float = setting(0.01, 'prior odds that the train file is overconfident', '1', 0.0, 1.0)
    valid_std: float = setting(
        0.15, 'fit to use below this standard deviation, without suspected steps', 'N/kN', 1e-3, 10.0
    )
    valid_share: float = setting(0.05, 'or below this share of the resistance (root of squares)', '1', 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Tick:
    """One admitted sample.

    Attributes:
        stamp_ns: Time stamp [ns].
        dt: Time since the previous sample [s].
        speed: Measured speed [m/s].
        traction: Mean reported specific traction [N/kN].
        track: Mean gradient and known extra resistance [N/kN].
        curve: 600 m over the mean radius [1], 0 on straight track.
        variance: Variance of the measured speed [(m/s)^2].
        weighed: Whether the load is weighed.
        force_interval: Time between the force reports used for interpolation [s].

    """

    stamp_ns: int
    dt: float
    speed: float
    traction: float
    track: float
    curve: float
    variance: float
    weighed: bool
    force_interval: float


@dataclass(frozen=True, slots=True)
class FilterBankState:
    """Saved state of the filter bank."""

    bank: Hypotheses
    tachometer: SpeedNoise
    inflation: Inflation
    ticks: tuple[Tick, ...]
    driven: DrivenSpeeds
    running: bool
    stopped: bool
    stride: int
    rejected_s: float
    braked_ns: int
    advanced_ns: int
    innovation: float
    innovation_variance: float
    test_ratio: float
    converged: bool


class FilterBank:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples, one update per sample."""

    def __init__(self, train_file: TrainFile, config: FilterBankConfig) -> None:
        check_settings(config)
        self.config = config
        self._train = train_file.train
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        self._bank = Bank(bank_plan(train_file, config, self._known.inertia))
        self._clear()

    def _clear(self) -> None:
        self._tachometer = SpeedNoise.declared(self.config.speed_std, robust=True)
        self._inflation = Inflation()
        self._ticks: deque[Tick] = deque()
        self._stride = 1
        self._driven = DrivenSpeeds()
        self._running = self._stopped = self._converged = False
        self._rejected_s, self._admission.braked_ns, self._advanced_ns = 0.0, 0, 0
        self._innovation = self._innovation_variance = self._test_ratio = 0.0
        self._mixture: Mixture | None = None

    def reset(self) -> None:
        """Return to the prior."""
        self._bank.reset()
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
        self._tachometer.add(sample.speed, sample.dt)
        self._ticks.append(self._tick(sample))
        if len(self._ticks) <= _STEPS_AHEAD:  # the first samples of a drive set its stride
            self._stride = max(1, min(round(_SPACING_S / sample.dt), _MAX_TICKS // 4))
        while len(self._ticks) > (_STEPS_AHEAD + 1) * self._stride + 1:
            self._ticks.popleft()
        if len(self._ticks) > _STEPS_AHEAD * self._stride:
            return self._advance()
        return None

    def _tick(self, sample: Sample) -> Tick:
        return Tick(
            stamp_ns=sample.stamp_ns,
            dt=sample.dt,
            speed=sample.speed,
            traction=self._known.traction(sample.force_mean, sample),
            track=self._known.track(sample),
            curve=CURVE_RADIUS * sample.curvature,
            variance=self._tachometer.variance,
            weighed=sample.weighed,
            force_interval=sample.force_interval,
        )

    def _interrupt(self, sample: Sample) -> None:
        """End the drive, so that the next admitted sample starts a new one."""
        self._ticks.clear()
        self._running = False
        # NaN marks a gap: speed is zero without noise at rest, and has jerks under hard braking.
        self._tachometer.add(sample.speed, math.nan)
        self._stopped = self._stopped or sample.speed < STANDING

    def _advance(self) -> Rejection | None:
        """Move the filters over the newest interval with enough later force reports."""
        stride = self._stride
        tick, next_, last = (self._ticks[-1 - k * stride] for k in (2, 1, 0))
        if not self._running:
            self._depart(tick)
            return None
        before = self._ticks[max(-1 - 3 * stride, -len(self._ticks))]
        traction = (before.traction, tick.traction, next_.traction, last.traction)
        interval = Interval(
            dt=tick.dt,
            traction=traction,
            track=tick.track,
            curve=tick.curve,
            speed=tick.speed,
            speed_variance=tick.variance,
            spacing=stride * tick.dt,
            force_interval=tick.force_interval,
        )
        innovation = self._bank.advance(interval)
        self._mixture = None
        if not self._bank.is_finite():
            self._bank.reset()
            # The estimate is lost, so it is not fit to use, and the driven speeds are cleared.
            self._driven, self._inflation = DrivenSpeeds(), Inflation()
            self._running = self._converged = False
            return Rejection(tick.stamp_ns, Reason.NUMERICAL, innovation.value, math.nan)
        return self._account(tick, innovation)

    def _depart(self, tick: Tick) -> None:
        """Restart the speed; after a stop the load may have changed, after a long idle time also a and c."""
        idle_s = (tick.stamp_ns - self._advanced_ns) / NS_PER_S if self._advanced_ns else 0.0
        if idle_s > _IDLE_S:
            self._bank.idle(idle_s)
            self._converged = False
        if self._stopped:
            self._bank.widen_force_scale(scale_step(self._train, weighed=tick.weighed) ** 2)
            self._stopped = False
        self._bank.restart(tick.speed, tick.variance)
        self._running, self._rejected_s, self._advanced_ns = True, 0.0, tick.stamp_ns
        self._mixture = None

    def _account(self, tick: Tick, innovation: Innovation) -> Rejection | None:
        """Record the innovation as a resistance [N/kN]; return the rejection of an outlier."""
        nu, S = innovation.value, innovation.variance
        per_speed = self._known.inertia / tick.dt
        self._innovation, self._innovation_variance = -per_speed * nu, per_speed**2 * S
        self._test_ratio = nu * nu / (_GATE**2 * S)
        self._inflation.add(innovation.weight * nu / math.sqrt(S), 1.0, tick.dt)
        if self._test_ratio > 1.0:
            self._rejected_s += tick.dt
            self._running = self._rejected_s < _RESTART_AFTER_S - 0.5 * tick.dt
            return Rejection(tick.stamp_ns, Reason.OUTLIER, nu, _GATE * math.sqrt(S))
        self._rejected_s, self._advanced_ns = 0.0, tick.stamp_ns
        self._driven = self._driven.add(tick.speed)
        if self._driven.count % _JUDGED_EVERY == 0:
            self._judge()
        return None

    def _judge(self) -> None:
        """Decide whether w is fit to use at the driven speeds."""
        now, config = self._now(), self.config
        # A delay outside the range that can be estimated biases the other states.
        self._converged = not is_delay_at_end(float(now.mean[-1])) and is_fit_where_driven(
            now.theta,
            now.posterior[:3, :3],
            self._driven,
            config.valid_std,
            config.valid_share,
            was_fit=self._converged,
        )

    def _now(self) -> Mixture:
        """Return the mixture with covariances inflated for unmodelled errors and wheel diameter errors."""
        if self._mixture is None:
            found = self._bank.mixture()
            # A relative wheel diameter error r changes a by r a, c by -r c, and the force scale 1 + kappa by a share r.
            a, _, c, kappa, _ = found.mean.tolist()
            wheel = np.array([a, 0.0, -c, 1.0 + kappa, 0.0])
            by_wheels = _WHEEL_STD**2 * np.outer(wheel, wheel)
            stated, posterior = (self._inflation.factor * S + by_wheels for S in (found.covariance, found.posterior))
            self._mixture = Mixture(found.mean, stated, posterior)
        return self._mixture

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update and its variance before the measurement, as in the estimate."""
        return self._innovation, self._innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        now = self._now()
        a, b, c, kappa, delta = now.mean.tolist()
        S, (*_, scale_std, delay_std) = now.theta_covariance, now.stds
        phi = np.array([1.0, speed, speed * speed])
        return ResistanceEstimate(
            a=a,
            b=b,
            c=c,
            covariance=tuple(S.ravel().tolist()),
            resistance=a + speed * (b + c * speed),
            resistance_std=math.sqrt(max(float(phi @ S @ phi), 0.0)),
            speed=speed,
            innovation=self._innovation,
            innovation_variance=self._innovation_variance,
            test_ratio=self._test_ratio,
            speed_min=self._driven.slowest,
            speed_max=self._driven.fastest,
            force_scale=1.0 + kappa,
            force_scale_std=scale_std,
            force_delay=delta,
            force_delay_std=delay_std,
        )

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(
            FilterBankState(
                bank=self._bank.state,
                tachometer=replace(self._tachometer),
                inflation=replace(self._inflation),
                ticks=tuple(self._ticks),
                driven=self._driven,
                running=self._running,
                stopped=self._stopped,
                stride=self._stride,
                rejected_s=self._rejected_s,
                braked_ns=self._admission.braked_ns,
                advanced_ns=self._advanced_ns,
                innovation=self._innovation,
                innovation_variance=self._innovation_variance,
                test_ratio=self._test_ratio,
                converged=self._converged,
            )
        )

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        state = decode(text, FilterBankState)
        check_numbers(state, may_be_nan=('dt',))  # of the tachometer, after a gap
        check_restored(self._fits(state.bank), 'FilterBankState', 'bank')
        check_restored(state.tachometer.is_valid(), 'FilterBankState', 'tachometer')
        check_restored(state.inflation.is_valid(), 'FilterBankState', 'inflation')
        check_restored(state.driven.is_valid(), 'FilterBankState', 'driven')
        ticks = (
            len(state.ticks) <= _MAX_TICKS and all(map(_is_valid, state.ticks)) and 0 < state.stride <= _MAX_TICKS // 4
        )
        check_restored(ticks, 'FilterBankState', 'ticks')
        check_not_negative(
            'FilterBankState',
            rejected_s=state.rejected_s,
            innovation_variance=state.innovation_variance,
            test_ratio=state.test_ratio,
        )
        self._bank.state = state.bank
        self._tachometer, self._driven = state.tachometer, state.driven
        self._inflation = state.inflation
        self._ticks = deque(state.ticks)
        self._running, self._stopped, self._rejected_s = state.running, state.stopped, state.rejected_s
        self._stride = state.stride
        self._admission.braked_ns, self._advanced_ns = state.braked_ns, state.advanced_ns
        self._innovation, self._innovation_variance = state.innovation, state.innovation_variance
        self._test_ratio, self._converged = state.test_ratio, state.converged
        self._mixture = None

    def _fits(self, bank: Hypotheses) -> bool:
        """Return whether the hypotheses are a possible state of this bank."""
        n = bank.log_weight.size
        sized = bank.x.shape == (n, STATES) and bank.P.shape == (n, STATES, STATES)
        if not (n and sized and bank.log_weight.shape == bank.age.shape == bank.size.shape == (n,)):
            return False
        plan = self._bank.plan
        sizes = len(plan.gust_stds) * len(plan.map_stds)
        indexed = bool(np.isin(bank.size, np.arange(sizes)).all())
        weighed = bool((bank.log_weight <= 0.0).all() and bank.log_weight.max() == 0.0 and (bank.age >= 0.0).all())
        slow = bool((np.abs(bank.x[:, V]) < _MAX_SPEED).all())
        counted = bank.since_s >= 0.0 and bank.branchings >= 0
        return indexed and weighed and slow and counted and all(map(is_covariance_matrix, bank.P))


def _is_valid(tick: Tick) -> bool:
    return tick.dt > 0.0 and 0.0 <= tick.speed < _MAX_SPEED and tick.variance > 0.0 and tick.force_interval >= 0.0


def bank_plan(train_file: TrainFile, config: FilterBankConfig, inertia: float) -> BankPlan:
    """Return the settings of the bank for a train; inertia = 1000 (1 + gamma) / g [N/kN per m/s^2]."""
    davis, errors = train_file.resistance, force_errors(train_file, config.force_delay_std)
    mean, variance = np.zeros(STATES), np.zeros(STATES)
    mean[[A, B, C]] = davis.a, davis.b, davis.c
    variance[[A, B, C]] = prior_variances((davis.a, davis.b, davis.c), config)
    variance[[KAPPA, DELTA, KAPPA_R]] = errors.variances
    drift = drift_growth(config.drift_share) * variance
    drift[KAPPA] = 0.0  # kappa changes only at stops
    step_a, step_c = config.step_a + _STEP_SHARE_A * davis.a, max(config.step_share_c * davis.c, _MIN_STEP_C)
    gradient_std = train_file.line.gradient_std
    map_stds = tuple(size * gradient_std for size in _MAP_SIZES) if gradient_std > 0.0 else (0.0,)
    return BankPlan(
        mean=mean,
        variance=variance,
        gust_stds=tuple(size * config.gust_std for size in _GUST_SIZES),
        map_stds=map_stds,
        step_variances=(step_a**2, step_c**2),
        hazard=1.0 / config.step_interval,
        spacing=config.branch_interval,
        most=config.hypotheses,
        patience=config.patience,
        youth=_YOUTH_S,
        suspicion=config.suspicion,
        wrong_prior=config.wrong_prior,
        drift=drift,
        noise=_process_noise(config, inertia),
    )


def _process_noise(config: FilterBankConfig, inertia: float) -> ProcessNoise:
    return ProcessNoise(
        inertia=inertia,
        gust_time=config.gust_time,
        map_length=config.map_length,
        force_density=config.force_noise**2 * _FORCE_INTERVAL_S,
        skew=config.force_skew,
        outliers=config.outlier_share,
    )
