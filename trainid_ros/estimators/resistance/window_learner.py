# SPDX-License-Identifier: Apache-2.0
"""From the speeds of a train and the forces known to act on it to a belief in its resistance.

Speed windows make observations of the resistance; the tracker learns from them. Both need to know their noise:
that of the speed, and what disturbances (gusts, map errors) add to one observation and to the mean of many. All of
it is learned on the way, within bounds around what is declared.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from trainid_ros.core.codec import check_restored
from trainid_ros.core.results import Reason, Refusal
from trainid_ros.core.soundness import check_not_negative
from trainid_ros.estimators.resistance.robust import gate, predict
from trainid_ros.estimators.resistance.run_lengths import TrackerState
from trainid_ros.estimators.resistance.slow_noise import SlowNoise
from trainid_ros.estimators.resistance.speed_window import Tick, WindowResult, observe_resistance, overlap_factor
from trainid_ros.estimators.resistance.tachometer import Tachometer

if TYPE_CHECKING:
    from trainid_ros.estimators.resistance.run_lengths import Tracker

_DISTURBANCE_MEMORY: Final = 0.03
_DISTURBANCE_RANGE: Final = (0.3, 3.0)
_SLOW_RANGE: Final = (0.2, 5.0)
# One innovation cannot tell much more disturbance than is known: slip is none.
_MOST_SIGMAS: Final = 3.0
# An innovation that may stem from a step tells nothing of the noise of one observation.
_DOUBTFUL: Final = 0.1
# An observation of less weight is refused.
_LEAST_WEIGHT: Final = 0.5


@dataclass(frozen=True, slots=True)
class WindowPlan:
    """How windows are cut, and what noise is declared; see VMilsConfig."""

    window: int
    hop: int
    inertia: float
    speed_std: float
    disturbance_std: float
    disturbance_time: float
    force_error: float
    force_skew: float
    outliers: float


@dataclass(frozen=True, slots=True)
class LearnerState:
    """All that a learner remembers beside its tracker."""

    tracker: TrackerState
    tachometer: Tachometer
    slow: SlowNoise
    ticks: tuple[Tick, ...]
    fresh: int
    disturbance_variance: float
    innovation: float
    innovation_variance: float
    test_ratio: float
    speed_min: float
    speed_max: float
    observations: int

    def check(self) -> None:
        """Raise InputError unless these numbers, finite ones, can be gone on from."""
        check_restored(self.tracker.is_sound(), 'LearnerState', 'tracker')
        check_restored(self.tachometer.is_sound(), 'LearnerState', 'tachometer')
        check_restored(self.slow.is_sound(), 'LearnerState', 'slow')
        check_restored(all(tick.dt > 0.0 for tick in self.ticks), 'LearnerState', 'ticks')
        check_not_negative(
            'LearnerState',
            disturbance_variance=self.disturbance_variance,
            innovation_variance=self.innovation_variance,
            test_ratio=self.test_ratio,
        )


class WindowLearner:
    """Learns from ticks; whoever knows that a tick tells nothing calls :meth:`interrupt` instead.

    Attributes:
        tracker: The belief.
        innovation: Of the last observation [N/kN].
        innovation_variance: Its variance if the observation is good; 0 before the first.
        test_ratio: Its square over that variance and the square of the gate; an observation above 1 counts for less
            than half.
        speed_min: Slowest speed learned from [m/s].
        speed_max: Fastest speed learned from [m/s].
        observations: Number of windows learned from.

    """

    def __init__(self, tracker: Tracker, plan: WindowPlan) -> None:
        self.tracker = tracker
        self._plan = plan
        self._overlap = overlap_factor(plan.window, plan.hop)
        self._gate = gate(plan.outliers)
        self._forget()

    def _forget(self) -> None:
        self._tachometer = Tachometer(self._plan.speed_std, self._plan.speed_std**2)
        self._slow = SlowNoise()
        self._ticks: deque[Tick] = deque(maxlen=self._plan.window)
        self._fresh = 0
        self._disturbance = self._plan.disturbance_std**2
        self.innovation = self.innovation_variance = self.test_ratio = 0.0
        self.speed_min = self.speed_max = 0.0
        self.observations = 0

    def reset(self) -> None:
        """Go back to the prior."""
        self.tracker.reset()
        self._forget()

    def state(self) -> LearnerState:
        """Return all that is remembered."""
        return LearnerState(
            tracker=self.tracker.state(),
            tachometer=replace(self._tachometer),
            slow=replace(self._slow),
            ticks=tuple(self._ticks),
            fresh=self._fresh,
            disturbance_variance=self._disturbance,
            innovation=self.innovation,
            innovation_variance=self.innovation_variance,
            test_ratio=self.test_ratio,
            speed_min=self.speed_min,
            speed_max=self.speed_max,
            observations=self.observations,
        )

    def restore(self, state: LearnerState) -> None:
        """Take over what was remembered."""
        self.tracker.restore(state.tracker)
        self._tachometer, self._slow = replace(state.tachometer), replace(state.slow)
        self._ticks = deque(state.ticks, maxlen=self._plan.window)
        self._fresh = state.fresh
        self._disturbance = state.disturbance_variance
        self.innovation, self.innovation_variance = state.innovation, state.innovation_variance
        self.test_ratio = state.test_ratio
        self.speed_min, self.speed_max = state.speed_min, state.speed_max
        self.observations = state.observations

    def interrupt(self, speed: float) -> None:
        """Begin a new window after a tick that tells nothing."""
        self._ticks.clear()
        self._fresh = 0
        self._tachometer.add(speed, math.nan)

    def push(self, tick: Tick) -> Refusal | None:
        """Take a tick in; every ``hop`` ticks make an observation. Return why it was refused, if it was."""
        self._ticks.append(tick)
        self._fresh += 1
        self._tachometer.add(tick.speed, tick.dt)
        if len(self._ticks) < self._plan.window or self._fresh < self._plan.hop:
            return None
        self._fresh = 0
        observed = observe_resistance(list(self._ticks), self._plan.inertia, self._tachometer.std)
        return observed if isinstance(observed, Refusal) else self._learn(observed, tick.stamp_ns)

    def _learn(self, observed: WindowResult, stamp_ns: int) -> Refusal | None:
        tracker = self.tracker
        _, v, s = observed.phi
        expected, doubt = predict(tracker.belief, v, s)
        nu, noise, slow = observed.y - expected, *self._noise_of(observed)
        S = doubt + noise
        if not math.isfinite(nu * nu / S):
            return Refusal(stamp_ns, Reason.NUMERICAL, nu, math.nan)
        weight = tracker.update(v, s, observed.y, noise, slow)
        self.innovation, self.innovation_variance = nu, S
        self.test_ratio = nu * nu / (self._gate**2 * S)
        if tracker.change_probability < _DOUBTFUL:
            self._learn_disturbance(nu, S)
        self._slow.add(weight * nu, doubt, slow * noise, _SLOW_RANGE)
        if weight < _LEAST_WEIGHT:
            return Refusal(stamp_ns, Reason.OUTLIER, nu, self._gate * math.sqrt(S))
        slow_speed, fast_speed = observed.speed_min, observed.speed_max
        self.speed_min = min(self.speed_min, slow_speed) if self.observations else slow_speed
        self.speed_max = max(self.speed_max, fast_speed)
        self.observations += 1
        return None

    def _noise_of(self, item: WindowResult) -> tuple[float, float]:
        """Return the variance of one observation, and how many times that it counts in the mean of many."""
        plan = self._plan
        force = (plan.force_error * item.traction) ** 2 + (plan.force_skew * item.force_rate) ** 2
        one = item.noise_std**2 + self._disturbance + force
        hop_s = item.duration * plan.hop / (plan.window - 1)
        together = max(1.0, 2.0 * plan.disturbance_time / hop_s)
        mean = self._overlap * item.noise_std**2 + together * plan.disturbance_std**2 + force
        return one, self._slow.factor * mean / one

    def _learn_disturbance(self, nu: float, S: float) -> None:
        """Learn what innovations hold beyond the noise and doubt that are known, within bounds."""
        low, high = ((factor * self._plan.disturbance_std) ** 2 for factor in _DISTURBANCE_RANGE)
        bounded = min(nu * nu, _MOST_SIGMAS**2 * S)
        # The noisier one innovation, the less it tells of what little lies beneath.
        gain = _DISTURBANCE_MEMORY * min(1.0, high / S)
        self._disturbance = min(max(self._disturbance + gain * (bounded - S), low), high)
