# SPDX-License-Identifier: Apache-2.0
"""V-MILS: Davis parameters by interval-varying multi-innovation least squares, robust and aware of steps.

After Liu et al. 2018 (sections 3 and 4.2), with these corrections:

* y carries rotating mass, gradient and traction instead of eq. (5), see :mod:`speed_window`;
* regularisation is a Gaussian prior (P(0), theta(0)), which equals ridge regression (7) at every step,
  instead of (12)-(16), whose penalty grows with time;
* the p innovations of a step have p times their noise variance, so that all uses of an observation together weigh
  exactly once and P is a covariance, see :mod:`multi_innovation`;
* "interval-varying": only good observations enter the p of a step. How good one is tells a soft gate;
* what hangs together in the noise is learned, see :mod:`slow_noise`, and so is the noise of speed;
* a step of the parameters is found and followed, see :mod:`run_lengths`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.codec import decode, encode
from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S
from trainid_ros.core.results import Refusal, ResistanceEstimate
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.core.soundness import check_numbers
from trainid_ros.estimators.admission import Admission
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.prior import prior_variances
from trainid_ros.estimators.resistance.fitness import drift_rates, is_fit
from trainid_ros.estimators.resistance.robust import drifted, predict
from trainid_ros.estimators.resistance.run_lengths import RunLengths, Tracker
from trainid_ros.estimators.resistance.speed_window import Tick
from trainid_ros.estimators.resistance.window_learner import LearnerState, WindowLearner, WindowPlan

if TYPE_CHECKING:
    from trainid_ros.core.samples import Sample
    from trainid_ros.estimators.resistance.robust import Belief
    from trainid_ros.physics.train_file import TrainFile

_SAMPLES_PER_S: Final = 5.0
# Drift enters the memory, and an estimate without news is judged again, after this time [s].
_DRIFT_LUMP_S: Final = 60.0
# Observations between the births of two watchers, and most of them at a time.
_SPACING: Final = 6
_WATCHERS: Final = 5
# Observations over which a lock-out shows, and that a new beginning learns from.
_LOCKOUT: Final = 30


@dataclass(frozen=True, slots=True)
class VMilsConfig:
    """Settings of V-MILS."""

    innovation_length: int = setting(4, 'innovation length p', 'observations', 1, 50)
    window: int = setting(25, 'samples in a speed window', 'samples', 5, 200)
    hop: int = setting(6, 'samples between windows', 'samples', 1, 200)
    min_speed: float = setting(1.0, 'slowest speed to learn from', 'm/s', 0.0, 50.0)
    speed_std: float = setting(0.025, 'noise of measured speed at the start (then learned)', 'm/s', 1e-4, 2.0)
    disturbance_std: float = setting(0.12, 'unmodelled resistance at the start (then learned)', 'N/kN', 0.0, 10.0)
    disturbance_time: float = setting(12.0, 'its correlation time at the start (then learned)', 's', 0.0, 600.0)
    force_error: float = setting(0.005, 'relative error of the traction force', '1', 0.0, 0.5)
    force_skew: float = setting(0.06, 'unknown delay of the reported force', 's', 0.0, 5.0)
    prior_share: float = setting(0.5, 'prior std of a, b, c as a share of their believed values', '1', 0.0, 10.0)
    prior_std_a: float = setting(0.6, 'added to the prior std of a (root of squares)', 'N/kN', 1e-6, 100.0)
    prior_std_b: float = setting(0.02, 'added to the prior std of b', 'N/kN per m/s', 1e-8, 10.0)
    prior_std_c: float = setting(0.0006, 'added to the prior std of c', 'N/kN per (m/s)^2', 1e-9, 1.0)
    drift_share: float = setting(0.08, 'drift in one hour, std as a share of the prior std', '1', 0.0, 100.0)
    outlier_share: float = setting(0.05, 'share of observations that may be anything', '1', 0.0, 0.5)
    step_interval: float = setting(3600.0, 'mean time between steps of the parameters', 's', 60.0, 1e7)
    step_share: float = setting(0.5, 'doubt added by a step, std as a share of the prior std', '1', 0.01, 10.0)
    step_patience: int = setting(12, 'observations before a step is believed', 'observations', 1, 1000)
    valid_std: float = setting(0.15, 'resistance is fit to use below this standard deviation', 'N/kN', 1e-3, 10.0)


@dataclass(frozen=True, slots=True)
class VMilsState:
    """All that V-MILS remembers; tuples only, so that it saves as JSON."""

    learner: LearnerState
    stamp_ns: int
    drifted_ns: int
    judged_ns: int
    braked_ns: int
    converged: bool


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
        theta = (davis.a, davis.b, davis.c)
        a, b, c = self._most_doubt = prior_variances(theta, config)
        self._drift_rates = drift_rates(config.drift_share, self._most_doubt)
        tracker = Tracker((*theta, a, 0.0, 0.0, b, 0.0, c), run_lengths(config, self._most_doubt))
        self.learner = WindowLearner(tracker, window_plan(config, self._known.inertia))
        self._forget()

    def _forget(self) -> None:
        self._stamp_ns = self._drifted_ns = self._judged_ns = self._admission.braked_ns = 0
        self._converged = False

    def reset(self) -> None:
        """Go back to the prior."""
        self.learner.reset()
        self._forget()

    @property
    def state(self) -> VMilsState:
        """All that is remembered."""
        return VMilsState(
            learner=self.learner.state(),
            stamp_ns=self._stamp_ns,
            drifted_ns=self._drifted_ns,
            judged_ns=self._judged_ns,
            braked_ns=self._admission.braked_ns,
            converged=self._converged,
        )

    def save(self) -> str:
        """Return the whole state as JSON text."""
        return encode(self.state)

    def restore(self, text: str) -> None:
        """Take over a saved state; InputError if it does not fit."""
        state = decode(text, VMilsState)
        check_numbers(state, may_be_nan=('dt',))  # of the tachometer, after a gap
        state.learner.check()
        self.learner.restore(state.learner)
        self._stamp_ns, self._drifted_ns, self._judged_ns = state.stamp_ns, state.drifted_ns, state.judged_ns
        self._admission.braked_ns = state.braked_ns
        self._converged = state.converged

    @property
    def converged(self) -> bool:
        """True while the resistance is known well enough at the speeds seen."""
        return self._converged

    def step(self, sample: Sample) -> ResistanceEstimate | Refusal:
        """Take one sample in; every ``hop`` good samples make one observation and one update."""
        self._stamp_ns = sample.stamp_ns
        if (refusal := self._admission.refuse(sample)) is not None:
            self.learner.interrupt(sample.speed)
            self._judge(news=False)
            return refusal
        self._drift()
        before = self.learner.observations
        traction = self._known.traction(sample.force_mean, sample)
        known_force = traction - self._known.track(sample)
        refusal = self.learner.push(Tick(sample.stamp_ns, sample.dt, sample.speed, known_force, traction))
        self._judge(news=self.learner.observations != before)
        return refusal or self.estimate(sample.speed)

    def _drift(self) -> None:
        """Let the memory drift, in lumps."""
        elapsed_s = (self._stamp_ns - self._drifted_ns) / NS_PER_S
        if self._drifted_ns == 0 or elapsed_s < 0.0:
            self._drifted_ns = self._stamp_ns
        elif elapsed_s >= _DRIFT_LUMP_S:
            self.learner.tracker.drift(self._drift_rates, elapsed_s, self._most_doubt)
            self._drifted_ns = self._stamp_ns

    def _now(self) -> Belief:
        """Return the belief after the drift since the last lump; never more doubt than at first."""
        belief = self.learner.tracker.belief
        if self._drifted_ns == 0 or self._stamp_ns <= self._drifted_ns:
            return belief
        elapsed_s = (self._stamp_ns - self._drifted_ns) / NS_PER_S
        return drifted(belief, self._drift_rates, elapsed_s, self._most_doubt)

    def _judge(self, *, news: bool) -> None:
        """Judge whether w is fit to use: after news, and from time to time without."""
        learner = self.learner
        waited_s = (self._stamp_ns - self._judged_ns) / NS_PER_S
        if not learner.observations or not (news or waited_s < 0.0 or waited_s >= _DRIFT_LUMP_S):
            return
        self._judged_ns = self._stamp_ns
        belief, speeds = self._now(), (learner.speed_min, learner.speed_max)
        self._converged = is_fit(
            lambda v: predict(belief, v, v * v)[1], speeds, self.config.valid_std, was_fit=self._converged
        )

    def estimate(self, speed: float) -> ResistanceEstimate:
        """Return the parameters and the resistance at a speed [m/s]."""
        learner, belief = self.learner, self._now()
        a, b, c, A, B, C, D, E, F = belief
        resistance, variance = predict(belief, speed, speed * speed)
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
            speed_min=learner.speed_min,
            speed_max=learner.speed_max,
        )


def run_lengths(config: VMilsConfig, prior_variances: tuple[float, float, float]) -> RunLengths:
    """Return how V-MILS looks for steps."""
    share = config.step_share**2
    a, b, c = prior_variances
    return RunLengths(
        p=config.innovation_length,
        outliers=config.outlier_share,
        step_variances=(share * a, share * b, share * c),
        hazard=config.hop / _SAMPLES_PER_S / config.step_interval,
        spacing=_SPACING,
        watchers=_WATCHERS,
        patience=config.step_patience,
        lockout=_LOCKOUT,
    )


def window_plan(config: VMilsConfig, inertia: float) -> WindowPlan:
    """Return how V-MILS cuts windows; inertia as in :func:`observe_resistance`."""
    return WindowPlan(
        window=config.window,
        hop=config.hop,
        inertia=inertia,
        speed_std=config.speed_std,
        disturbance_std=config.disturbance_std,
        disturbance_time=config.disturbance_time,
        force_error=config.force_error,
        force_skew=config.force_skew,
        outliers=config.outlier_share,
    )
