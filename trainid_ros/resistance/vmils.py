# SPDX-License-Identifier: Apache-2.0
"""V-MILS: Davis parameters by interval-varying multi-innovation least squares, robust and with step detection.

After Liu et al. 2018. (n) is an equation of the paper, whose multi-innovation equations have no numbers: "MILS" are
those of section 3, "V-MILS" those of section 4.2. [n] marks the same step in the code: here and in
:mod:`window_learner` and :mod:`change_points`. theta = [a, b, c, kappa, delta, kappa_curve]: the resistance
w(v) = a + b v + c v^2, and the errors of the known forces, see :mod:`davis_posterior`.

    [1]  theta = theta(0), P = P(0): the regularisation                                   (7): P(0)^-1 for lambda I
    for each sample without braking:
    [2]      add it to the window; every hop seconds the window is fitted                 Fig. 2: segments
    [3]      slope of v - v_u by least squares, v_u = speed by the known force alone      (6)
    [4]      y = -m slope,  m = 1000 (1 + gamma) / g0                                     (3), (4), (5)
    [5]      phi = [1, v, v^2, -Tw, -Dw, (600/R)w], averaged over the window              (2)
    [6]      R = variance of y; slow R = that of the mean of many y, whose noise is correlated
    [7]      e = y - phi' theta, S = phi' P phi + R                                       (9)
    [8]      w = probability that y is good, given e: t_s, weighted instead of chosen     V-MILS: t_s
    [9]      Phi = [phi(t), ..., phi(t-p+1)], Y = [y(t), ..., y(t-p+1)]                   V-MILS: Phi(p, t_s), Y(p, t_s)
    [10]     P^-1 = P^-1 + Phi D Phi',  P^-1 theta = P^-1 theta + Phi D Y,                V-MILS: L, P, theta
             D = diag(w / (p slow R)): the printed L = P Phi (D^-1 + Phi' P Phi)^-1 in information form
    [11]     hypotheses: "a, b, c stepped k observations ago", each updated by eqs. (9)-(11)
    [12]     one that is 1000 times as likely replaces the long memory of [10]
    [13]     if most y contradict the long memory: restart from a robust fit of the latest
    [14]     estimate = mixture of long memory and hypotheses; its stated P is that of hypotheses, which count more,
             and of the walk W: a, b, c that step all the time, updated by eqs. (9)-(11)
    [15]     learn the variance of disturbances and slow from e, the inflation of P from the e of the walk
    [16] at each departure: P_kappa = P_kappa + variance of a change of load; each minute: drift of a, b, c, steps of W
    [17] publish: P = inflation P + (model error)^2 theta theta'

The same in plain numpy, [3]-[5] and [7]-[10], is ``test/resistance/reference_vmils.py``. Differences from the paper:

* y includes rotating mass, gradient and traction instead of (5), which has g0 = 10 m/s^2 and coasting on straight
  track;
* the regularisation is a Gaussian prior with a mean and a diagonal P(0)^-1 of unequal entries: generalised ridge
  regression at every step. (7) has lambda I and zero mean; eqs. (12)-(16), whose penalty grows with time, are replaced;
* the p innovations of a step have p times their noise variance, so that all uses of an observation together have its
  weight exactly once and P is a covariance;
* "interval-varying": good observations enter the p of a step. A soft gate weights them instead of choosing;
* traction is not exact: its scale and delay are estimated too, and so is the curve resistance;
* the correlation of the noise is learned, see :mod:`window_learner`, and so is the speed noise;
* steps of a, b, c are detected and followed, see :mod:`change_points`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar, Final

import numpy as np

from trainid_ros.estimators.settings import VMilsConfig, prior_variances
from trainid_ros.interface.errors import InputError, check_settings
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Rejection, ResistanceEstimate
from trainid_ros.interface.scalars import seconds
from trainid_ros.interface.state import State, declare, encode, restore
from trainid_ros.resistance.change_points import Array, ChangePointConfig, Tracker, independent
from trainid_ros.resistance.davis_posterior import (
    CURVE_RADIUS,
    DavisPosterior,
    drift_rates,
    drifted,
    force_variances,
    is_fit_to_use,
    resistance_estimate,
    scale_step,
)
from trainid_ros.resistance.suggested_drive import STEP_S, Run
from trainid_ros.resistance.window_learner import WindowLearner, WindowSample
from trainid_ros.stream.known_force import Admission, KnownForce
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

# Interval at which drift is added, and the estimate is tested again without new observations [s].
_DRIFT_LUMP_S: Final = 60.0
# Speed below which the train is at a stop [m/s].
_STOPPED: Final = 0.3
# Indices of kappa and delta in theta.
_KAPPA, _DELTA = 3, 4


class VMils:
    """Estimate a, b, c of w(v) = a + b v + c v^2 [N/kN] from aligned samples."""

    STATE: ClassVar[State] = declare(
        'learner', '_stamp_ns', '_speed', '_drifted_ns', '_validity_checked_ns', '_admission', '_standing', '_converged'
    )

    def __init__(self, train_file: TrainFile, config: VMilsConfig) -> None:
        check_settings(config)
        if config.hop > config.window:
            raise InputError(f'hop = {config.hop:g} s must not exceed window = {config.window:g} s')
        self.config = config
        self._known = KnownForce(train_file)
        self._admission = Admission(self._known, config.min_speed)
        davis, force = train_file.resistance, force_variances(train_file, config.force_delay_std)
        tracker = tracker_of((davis.a, davis.b, davis.c), force, config)
        a, b, c, *_ = tracker.prior.P.diagonal().tolist()
        self._prior_variances = a, b, c
        self._rates = drift_rates(config.drift_share, self._prior_variances)
        (drift_a, drift_b, drift_c), T = self._rates, config.step_interval
        step_a, step_b, step_c, *_ = tracker.plan.step_variances
        self._walk_rates = drift_a + step_a / T, drift_b + step_b / T, drift_c + step_c / T
        self._limits = tracker.prior.P.diagonal().copy()  # Upper limits of the variances of theta
        self.learner = WindowLearner(tracker, config, self._known.inertia, train_file.line.gradient_std)
        self._clear()

    def _clear(self) -> None:
        self._stamp_ns = self._drifted_ns = self._validity_checked_ns = self._admission.braked_ns = 0
        self._speed, self._converged = 0.0, False
        self._standing = False
        # Of the newest sample, for drives that are foreseen; not saved.
        self._sampled_s, self._weighed = STEP_S, False

    def reset(self) -> None:
        """Return to the prior."""
        self.learner.reset()
        self._clear()

    def save(self) -> str:
        """Return the state as JSON text."""
        return encode(self)

    def restore(self, text: str) -> None:
        """Restore a saved state; raise InputError if it is invalid."""
        restore(self, text)
        self.learner.tracker.refresh()

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough over the driven speeds."""
        return self._converged

    def step(self, sample: Sample) -> Rejection | None:
        """Process one sample; every ``hop`` seconds of good samples give one observation and one update."""
        self._stamp_ns, self._speed = sample.stamp_ns, sample.speed
        self._inflate_at_departures(sample)
        if (rejection := self._admission.reject(sample)) is not None:
            self.learner.interrupt(sample.speed)
            self._check_validity(updated=False)
            return rejection
        self._drift()
        self._sampled_s, self._weighed = sample.dt, sample.weighed
        before = self.learner.driven.count
        traction = self._known.traction(sample.force_mean, sample)
        used = WindowSample(
            stamp_ns=sample.stamp_ns,
            dt=sample.dt,
            speed=sample.speed,
            known_force=traction - self._known.track(sample),
            traction=traction,
            curve=CURVE_RADIUS * sample.curvature,
        )
        # [2]-[15]
        rejection = self.learner.push(used)
        self._check_validity(updated=self.learner.driven.count != before)
        return rejection

    def _inflate_at_departures(self, sample: Sample) -> None:
        """Add the variance of a step of kappa at each departure: the load has changed, and may have been weighed."""
        if sample.speed < _STOPPED:
            self._standing = True
        elif self._standing and sample.speed >= self.config.min_speed:
            self._standing = False
            # [16]
            step = np.zeros(len(self._limits))
            step[_KAPPA] = scale_step(self._known.train_file.train, weighed=sample.weighed) ** 2
            self.learner.tracker.inflate_variance(step, self._limits + step)

    def idle(self, seconds: float) -> None:
        """Let the drift of a, b, c go on over a time without samples [s]."""
        if self._stamp_ns:
            self._stamp_ns += round(seconds * NS_PER_S)
            self._check_validity(updated=True)

    def _drift(self) -> None:
        """Add the drift variance of a, b, c at intervals."""
        elapsed_s = seconds(self._stamp_ns - self._drifted_ns)
        if self._drifted_ns == 0 or elapsed_s < 0.0:
            self._drifted_ns = self._stamp_ns
        elif elapsed_s >= _DRIFT_LUMP_S:
            # [16]
            grown = np.array([*self._rates, 0.0, 0.0, 0.0]) * elapsed_s
            self.learner.tracker.inflate_variance(grown, self._limits, elapsed_s / self.config.step_interval)
            self._drifted_ns = self._stamp_ns

    def _published(self, P: Array, rates: tuple[float, float, float]) -> DavisPosterior:
        """Return the posterior as published, of a covariance of theta and the rates at which it grows between lumps."""
        now = self._davis(P)
        if 0 < self._drifted_ns < self._stamp_ns:
            now = drifted(now, rates, seconds(self._stamp_ns - self._drifted_ns), self._prior_variances)
        return self._inflated(now, self.learner.inflation.factor)

    def _davis(self, P: Array) -> DavisPosterior:
        """Return the posterior of a, b, c, of a covariance of theta of shape (n, n)."""
        (A, B, C), (_, D, E), (_, _, F) = P[:3, :3].tolist()
        a, b, c = self.learner.tracker.estimate.theta[:3].tolist()
        return a, b, c, A, B, C, D, E, F

    def _inflated(self, now: DavisPosterior, factor: float) -> DavisPosterior:
        """Return a posterior with inflated covariance, and (e w)^2 added to the variance of w, e the model error."""
        a, b, c, *P = now
        # [17]
        e2 = self.config.model_error**2
        squares = (a * a, a * b, a * c, b * b, b * c, c * c)
        return (a, b, c, *(factor * x + e2 * square for x, square in zip(P, squares, strict=True)))

    def _check_validity(self, *, updated: bool) -> None:
        """Decide whether w is fit to use: after a new observation, and at intervals without one."""
        learner = self.learner
        waited_s = seconds(self._stamp_ns - self._validity_checked_ns)
        if not learner.driven.count or not (updated or waited_s < 0.0 or waited_s >= _DRIFT_LUMP_S):
            return
        self._validity_checked_ns = self._stamp_ns
        self._converged = is_fit_to_use(
            self._published(learner.tracker.estimate.P, self._rates),
            self._published(learner.tracker.stated.P, self._walk_rates),
            learner.driven,
            self._speed,
            (self.config.valid_std, self.config.valid_share),
            was_fit=self._converged,
        )

    @property
    def innovation(self) -> tuple[float, float]:
        """Innovation of the last update [N/kN] and its variance before it [(N/kN)^2], as in the estimate."""
        return self.learner.innovation, self.learner.innovation_variance

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters for v in m/s and the resistance [N/kN] at a speed [m/s]."""
        P = self.learner.tracker.stated.P
        return self._estimate(self._published(P, self._walk_rates), self.learner.inflation.factor * P.diagonal(), speed)

    def foreseen(self, run: Run, times: int) -> Iterator[ResistanceEstimate]:
        """Yield the estimates on average after one, two, ... of a number of runs, each from a stop."""
        P = self.learner.tracker.stated.P
        information = self.learner.foreseen_information(self._planned(run), self._sampled_s)
        step = scale_step(self._known.train_file.train, weighed=self._weighed) ** 2
        # A step may come at any time of a run: half of it before what the run tells, half after.
        most, drift = self._limits[_KAPPA] + step, 0.5 * np.array(self._walk_rates) * run.duration_s
        for k in range(1, times + 1):
            P[[0, 1, 2], [0, 1, 2]] += drift
            P[_KAPPA, _KAPPA] = max(P[_KAPPA, _KAPPA], min(P[_KAPPA, _KAPPA] + step, most))
            P[:] = np.linalg.inv(np.linalg.inv(P) + information)
            P[[0, 1, 2], [0, 1, 2]] += drift
            factor = self.learner.inflation.foreseen(k * len(run.steps) * STEP_S)
            published = self._inflated(self._davis(P), factor)
            yield self._estimate(published, factor * P.diagonal(), run.steps[-1].speed)

    def _planned(self, run: Run) -> list[WindowSample]:
        """Return the part of a run from which is learned."""
        scale = 1.0 + float(self.learner.tracker.estimate.theta[_KAPPA])
        first = run.first_learned(self._known.settling, self.config.min_speed)
        return [
            WindowSample(round(k * STEP_S * NS_PER_S), STEP_S, step.speed, scale * step.traction, step.traction)
            for k, step in enumerate(run.steps)
            if k >= first and step.speed >= self.config.min_speed
        ]

    def _estimate(self, published: DavisPosterior, variances: Array, speed: float) -> ResistanceEstimate:
        """Return the estimate of a posterior, and of variances of theta."""
        learner = self.learner
        scale, delay = learner.tracker.estimate.theta[_KAPPA : _DELTA + 1].tolist()
        scale_std, delay_std = (math.sqrt(x) for x in variances[_KAPPA : _DELTA + 1].tolist())
        return resistance_estimate(
            published,
            speed,
            (learner.innovation, learner.innovation_variance, learner.test_ratio),
            (learner.driven.slowest, learner.driven.fastest),
            (1.0 + scale, scale_std, delay, delay_std),
        )


def tracker_of(davis: tuple[float, float, float], of_force: tuple[float, float, float], config: VMilsConfig) -> Tracker:
    """Return the tracker of theta = [a, b, c, kappa, delta, kappa_curve] before the first observation.

    Its prior means are a, b, c [N/kN, v in m/s] and 0 for the force errors, whose prior variances are given.
    """
    variances = prior_variances(davis, config)
    share = config.step_share**2
    a, b, c = (share * variance for variance in variances)
    # [1] The regularisation of eq. (7) as a Gaussian prior.
    prior = independent((*davis, 0.0, 0.0, 0.0), (*variances, *of_force))
    plan = ChangePointConfig(
        p=config.innovation_length,
        outliers=config.outlier_share,
        step_variances=(a, b, c, 0.0, 0.0, 0.0),
        hazard=config.hop / config.step_interval,
        min_age=config.step_min_age,
        step_weight=100.0,  # a step of 1 % probability counts as much as none
    )
    return Tracker(prior, plan)
