# SPDX-License-Identifier: Apache-2.0
"""V-MILS: Davis parameters by interval-varying multi-innovation least squares, robust and with step detection.

theta = [a, b, c, kappa, delta, kappa_curve]: the resistance w(v) = a + b v + c v^2, and the errors of the known forces,
see :mod:`force_errors`. After Liu et al. 2018 (sections 3 and 4.2), with these corrections:

* y includes rotating mass, gradient and traction instead of eq. (5), see :mod:`speed_window`;
* regularisation is a Gaussian prior (P(0), theta(0)), which equals ridge regression (7) at every step,
  instead of (12)-(16), whose penalty grows with time;
* the p innovations of a step have p times their noise variance, so that all uses of an observation together have its
  weight exactly once and P is a covariance, see :mod:`multi_innovation`;
* "interval-varying": only good observations enter the p of a step. A soft gate weights them;
* traction is not exact: its scale and delay are estimated too, and so is the curve resistance;
* the correlation of the noise is learned, see :mod:`slow_noise`, and so is the speed noise;
* steps of a, b, c are detected and followed, see :mod:`change_points`;
* the published covariance is P times the factor of :mod:`inflation`, plus a share of w for wheel diameter errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.errors import InputError
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import prior_variances
from trainid_ros.records import NS_PER_S
from trainid_ros.resistance.change_points import ChangePointConfig, Tracker
from trainid_ros.resistance.fitness import drift_rates, is_fit_where_driven
from trainid_ros.resistance.force_errors import CURVE_RADIUS, ForceErrors, force_errors, scale_step
from trainid_ros.resistance.normal import independent
from trainid_ros.resistance.robust import drifted, predict
from trainid_ros.resistance.speed_window import Tick
from trainid_ros.resistance.window_learner import LearnerState, WindowLearner, WindowPlan
from trainid_ros.results import Rejection, ResistanceEstimate
from trainid_ros.settings import check_settings, setting
from trainid_ros.state import check_numbers, decode, encode

if TYPE_CHECKING:
    from trainid_ros.resistance.normal import Array
    from trainid_ros.resistance.robust import DavisPosterior
    from trainid_ros.stream.samples import Sample
    from trainid_ros.train.train_file import TrainFile

# Interval at which drift is added, and the estimate is tested again without new observations [s].
_DRIFT_LUMP_S: Final = 60.0
# Observations between the creation of two hypotheses, and maximum number of hypotheses.
_SPACING: Final = 6
_HYPOTHESES: Final = 5
# Observations over which a lock-out is detected and from which the estimate restarts.
_LOCKOUT: Final = 30
# Speed below which the train is at a stop, where the passenger load changes [m/s].
_STANDING: Final = 0.3
# Index of kappa and delta in theta.
_KAPPA, _DELTA = 3, 4


@dataclass(frozen=True, slots=True)
class VMilsConfig:
    """Settings of V-MILS."""

    innovation_length: int = setting(4, 'innovation length p', 'observations', 1, 50)
    window: float = setting(4.8, 'duration of a speed window, of 8 samples or more', 's', 0.5, 60.0)
    hop: float = setting(1.2, 'time between windows', 's', 0.02, 60.0)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(
        0.11, 'unmodelled resistance without map errors at the start (then learned)', 'N/kN', 0.0, 10.0
    )
    disturbance_time: float = setting(12.0, 'its correlation time at the start (then learned)', 's', 0.0, 600.0)
    force_error: float = setting(0.003, 'relative error of the traction force besides its scale', '1', 0.0, 0.5)
    force_skew: float = setting(0.03, 'timing error of the force besides its delay', 's', 0.0, 5.0)
    force_delay_std: float = setting(0.15, 'prior std of the delay of the reported force', 's', 0.0, 5.0)
    model_error: float = setting(0.006, 'unmodelled error of w, as a share of w', '1', 0.0, 0.5)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their stated values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    drift_share: float = setting(0.08, 'drift in one hour, std as a share of the prior std', '1', 0.0, 100.0)
    outlier_share: float = setting(0.05, 'share of outliers among the observations', '1', 0.0, 0.5)
    step_interval: float = setting(3600.0, 'mean time between steps of the parameters', 's', 60.0, 1e7)
    step_share: float = setting(0.5, 'std of a step as a share of the prior std', '1', 0.01, 10.0)
    step_patience: int = setting(12, 'observations after which a step hypothesis counts', 'observations', 1, 1000)
    valid_std: float = setting(0.15, 'fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)
    valid_share: float = setting(0.05, 'or below this share of the resistance (root of squares)', '1', 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class VMilsState:
    """Saved state of V-MILS; tuples only, so that it can be saved as JSON."""

    learner: LearnerState
    stamp_ns: int
    drifted_ns: int
    judged_ns: int
    braked_ns: int
    standing: bool
    converged: bool


class VMils:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples."""

    def __init__(self, train_file: TrainFile, config: VMilsConfig) -> None:
        check_settings(config)
        if config.hop > config.window:
            msg = f'hop = {config.hop:g} s must not exceed window = {config.window:g} s'
            raise InputError(msg)
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis, errors = train_file.resistance, force_errors(train_file, config.force_delay_std)
        tracker = tracker_of((davis.a, davis.b, davis.c), errors, config)
        a, b, c, *_ = tracker.prior.P.diagonal().tolist()
        self._most = a, b, c
        self._rates = drift_rates(config.drift_share, self._most)
        plan = window_plan(config, self._known.inertia, train_file.line.gradient_std)
        self.learner = WindowLearner(tracker, plan)
        self._clear()

    def _clear(self) -> None:
        self._stamp_ns = self._drifted_ns = self._judged_ns = self._admission.braked_ns = 0
        self._converged = False
        # The prior already includes the change of load at the first stop.
        self._standing = True

    def reset(self) -> None:
        """Return to the prior."""
        self.learner.reset()
        self._clear()

    @property
    def state(self) -> VMilsState:
        """The state to save."""
        return VMilsState(
            learner=self.learner.state(),
            stamp_ns=self._stamp_ns,
            drifted_ns=self._drifted_ns,
            judged_ns=self._judged_ns,
            braked_ns=self._admission.braked_ns,
            standing=self._standing,
            converged=self._converged,
        )

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        state = decode(text, VMilsState)
        check_numbers(state, may_be_nan=('dt',))  # of the tachometer, after a gap
        state.learner.check(len(self.learner.tracker.prior.theta))
        self.learner.restore(state.learner)
        self._stamp_ns, self._drifted_ns, self._judged_ns = state.stamp_ns, state.drifted_ns, state.judged_ns
        self._admission.braked_ns = state.braked_ns
        self._standing, self._converged = state.standing, state.converged

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the driven speeds."""
        return self._converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; every ``hop`` seconds of good samples give one observation and one update."""
        self._stamp_ns = sample.stamp_ns
        self._widen_at_stops(sample)
        if (rejection := self._admission.reject(sample)) is not None:
            self.learner.interrupt(sample.speed)
            self._judge(updated=False)
            return rejection
        self._drift()
        before = self.learner.driven.count
        traction = self._known.traction(sample.force_mean, sample)
        tick = Tick(
            stamp_ns=sample.stamp_ns,
            dt=sample.dt,
            speed=sample.speed,
            known_force=traction - self._known.track(sample),
            traction=traction,
            curve=CURVE_RADIUS * sample.curvature,
        )
        rejection = self.learner.push(tick)
        self._judge(updated=self.learner.driven.count != before)
        return rejection

    def _widen_at_stops(self, sample: Sample) -> None:
        """Add the variance of a step of kappa at each standstill, where the passenger load changes."""
        if self._standing:
            self._standing = sample.speed < self.config.min_speed
        elif sample.speed < _STANDING:
            self._standing = True
            step = scale_step(self._known.train_file.train, weighed=sample.weighed) ** 2
            variances = np.zeros(len(self.learner.tracker.prior.theta))
            variances[_KAPPA] = step
            self.learner.tracker.widen(variances, self._limits())

    def _limits(self) -> Array:
        """Return the upper limits of the variances of theta: the prior ones, plus one step of kappa."""
        limits = self.learner.tracker.prior.P.diagonal().copy()
        limits[_KAPPA] += scale_step(self._known.train_file.train, weighed=False) ** 2
        return limits

    def _drift(self) -> None:
        """Add the drift variance of a, b, c at intervals."""
        elapsed_s = (self._stamp_ns - self._drifted_ns) / NS_PER_S
        if self._drifted_ns == 0 or elapsed_s < 0.0:
            self._drifted_ns = self._stamp_ns
        elif elapsed_s >= _DRIFT_LUMP_S:
            limits = self._limits()
            variances = np.zeros(len(limits))
            variances[:3] = np.array(self._rates) * elapsed_s
            self.learner.tracker.widen(variances, limits)
            self._drifted_ns = self._stamp_ns

    def _published(self) -> DavisPosterior:
        """Return a, b, c and the upper triangle of their covariance as published.

        This includes the drift since it was last added. P is multiplied by the inflation factor of the innovations,
        and (e w)^2 with e the model error is added to the variance of w at every speed:

            P_published = factor P + e^2 theta theta'.
        """
        learner, estimate = self.learner, self.learner.tracker.estimate
        (A, B, C), (_, D, E), (_, _, F) = estimate.P[:3, :3].tolist()
        theta = estimate.theta[:3].tolist()
        now: DavisPosterior = (*theta, A, B, C, D, E, F)
        if 0 < self._drifted_ns < self._stamp_ns:
            now = drifted(now, self._rates, (self._stamp_ns - self._drifted_ns) / NS_PER_S, self._most)
        a, b, c, *P = now
        factor, e2 = learner.inflation.factor, self.config.model_error**2
        squares = (a * a, a * b, a * c, b * b, b * c, c * c)
        return (a, b, c, *(factor * x + e2 * square for x, square in zip(P, squares, strict=True)))

    def _judge(self, *, updated: bool) -> None:
        """Decide whether w is fit to use: after a new observation, and at intervals without one."""
        learner = self.learner
        waited_s = (self._stamp_ns - self._judged_ns) / NS_PER_S
        if not learner.driven.count or not (updated or waited_s < 0.0 or waited_s >= _DRIFT_LUMP_S):
            return
        self._judged_ns = self._stamp_ns
        a, b, c, A, B, C, D, E, F = self._published()
        self._converged = is_fit_where_driven(
            np.array([a, b, c]),
            np.array([[A, B, C], [B, D, E], [C, E, F]]),
            learner.driven,
            self.config.valid_std,
            self.config.valid_share,
            was_fit=self._converged,
        )

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update and its variance before the measurement, as in the estimate."""
        return self.learner.innovation, self.learner.innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        learner, published = self.learner, self._published()
        a, b, c, A, B, C, D, E, F = published
        resistance, variance = predict(published, speed, speed * speed)
        scale, delay = learner.tracker.estimate.theta[_KAPPA : _DELTA + 1].tolist()
        factor, variances = learner.inflation.factor, learner.tracker.estimate.P.diagonal()
        scale_std, delay_std = (math.sqrt(factor * x) for x in variances[_KAPPA : _DELTA + 1].tolist())
        return ResistanceEstimate(
            a=a,
            b=b,
            c=c,
            covariance=(A, B, C, B, D, E, C, E, F),
            resistance=resistance,
            resistance_std=math.sqrt(variance),
            speed=speed,
            innovation=learner.innovation,
            innovation_variance=learner.innovation_variance,
            test_ratio=learner.test_ratio,
            speed_min=learner.driven.slowest,
            speed_max=learner.driven.fastest,
            force_scale=1.0 + scale,
            force_scale_std=scale_std,
            force_delay=delay,
            force_delay_std=delay_std,
        )


def tracker_of(davis: tuple[float, float, float], errors: ForceErrors, config: VMilsConfig) -> Tracker:
    """Return the tracker of theta = [a, b, c, kappa, delta, kappa_curve] before the first observation.

    Args:
        davis: Prior means of a, b, c [N/kN, v in m/s].
        errors: Prior standard deviations of the force errors, whose means are 0.
        config: Settings of V-MILS.

    """
    variances = prior_variances(davis, config)
    share = config.step_share**2
    a, b, c = (share * variance for variance in variances)
    prior = independent((*davis, 0.0, 0.0, 0.0), (*variances, *errors.variances))
    return Tracker(prior, change_point_config(config, (a, b, c, 0.0, 0.0, 0.0)))


def change_point_config(config: VMilsConfig, step_variances: tuple[float, ...]) -> ChangePointConfig:
    """Return the settings of the step detection of V-MILS."""
    return ChangePointConfig(
        p=config.innovation_length,
        outliers=config.outlier_share,
        step_variances=step_variances,
        hazard=config.hop / config.step_interval,
        spacing=_SPACING,
        hypotheses=_HYPOTHESES,
        patience=config.step_patience,
        lockout=_LOCKOUT,
    )


def window_plan(config: VMilsConfig, inertia: float, gradient_std: float) -> WindowPlan:
    """Return the window lengths and declared noise of V-MILS.

    Args:
        config: Settings of V-MILS.
        inertia: As in :func:`observe_resistance` [N/kN per m/s^2].
        gradient_std: Standard deviation of the gradients of the map [per mille].

    """
    return WindowPlan(
        window=config.window,
        hop=config.hop,
        inertia=inertia,
        speed_std=config.speed_std,
        # A gradient of 1 per mille is 1 N/kN.
        disturbance_std=math.hypot(config.disturbance_std, gradient_std),
        disturbance_time=config.disturbance_time,
        force_error=config.force_error,
        force_skew=config.force_skew,
        outliers=config.outlier_share,
    )
