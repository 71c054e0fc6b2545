# SPDX-License-Identifier: Apache-2.0
"""A belief that follows steps of the parameters and forgets nothing else.

Forgetting factors buy speed after a step with noise at all other times. Here one long memory (multi-innovation
least squares) runs beside a few watchers, each of which supposes that the parameters stepped when it was born: it
started from the belief of that time, widened by the doubt of a step. Each keeps the score of its predictions against
those of the long memory: the logarithm of a Bayes factor. What is told is the mixture of all by their
probability; as soon as the long memory has none left, the likeliest watcher takes its place.
This is Bayesian detection of change points (Adams and MacKay 2007) with few run lengths.

Outliers fade for each by its own prediction, so a burst that tempts a young watcher does not reach the memory;
watchers count only after some ``patience``, longer than bursts. A step so large that nobody follows shows by
weights that stay low: then a robust fit of the latest observations begins a new memory.
"""

from __future__ import annotations

import math
import operator
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from trainid_ros.core.soundness import is_covariance
from trainid_ros.estimators.resistance.multi_innovation import (
    NOTHING,
    belief_of,
    information_of,
    is_definite,
    mils_step,
)
from trainid_ros.estimators.resistance.robust import drifted, mixed, soft_update, widened
from trainid_ros.estimators.resistance.robust_fit import LEAST_ROWS, robust_fit

if TYPE_CHECKING:
    from trainid_ros.estimators.resistance.multi_innovation import MilsState
    from trainid_ros.estimators.resistance.robust import Belief

# Odds against the long memory at which it is given up.
_GIVEN_UP: Final = math.log(1e3)
# Mean weight of the observations below which the belief is locked out.
_LOCKED_OUT: Final = 0.4
# Scores beyond this decide all the same.
_MOST_EVIDENCE: Final = 300.0


@dataclass(frozen=True, slots=True)
class RunLengths:
    """How steps are looked for.

    Attributes:
        p: Innovation length of the long memory.
        outliers: Share of observations that may be anything.
        step_variances: Doubt that a step adds to a, b, c.
        hazard: Probability of a step at each observation.
        spacing: Observations between the births of two watchers.
        watchers: Most watchers at a time.
        patience: Observations after which a watcher counts.
        lockout: Observations over which weights are averaged to notice a lock-out, and kept for a new beginning.

    """

    p: int
    outliers: float
    step_variances: tuple[float, float, float]
    hazard: float
    spacing: int
    watchers: int
    patience: int
    lockout: int


@dataclass(frozen=True, slots=True)
class TrackerState:
    """All that a tracker remembers; a watcher is its belief, its evidence and its age."""

    memory: tuple[float, ...]
    parts: tuple[tuple[float, ...], ...]
    watchers: tuple[tuple[float, ...], ...]
    rows: tuple[tuple[float, ...], ...]
    mean_weight: float
    count: int
    steps_found: int

    def is_sound(self) -> bool:
        """True if all its parts, finite ones, are of the right size and within their bounds."""
        sizes = ((self.memory,), 18), (self.parts, 9), (self.watchers, 11), (self.rows, 5)
        if not all(len(item) == size for items, size in sizes for item in items):
            return False
        after = tuple(map(operator.add, self.memory[:9], self.memory[9:]))
        informed = is_definite(self.memory) and is_definite(after)
        believed = all(is_covariance(item[3:9]) and item[9] <= _MOST_EVIDENCE for item in self.watchers)
        # (v, s, y, R, slow)
        observed = all(row[3] > 0.0 and row[4] > 0.0 for row in self.rows)
        return informed and believed and observed and 0.0 <= self.mean_weight <= 1.0 and self.count >= 0


class Tracker:
    """Belief in a, b, c of w = a + b v + c v^2, observation by observation.

    Attributes:
        belief: Mixture of the long memory and the watchers: a, b, c and the upper triangle of their covariance.
        steps_found: How often the parameters were found to have stepped.
        change_probability: Probability that they stepped since the long memory began, below 0.001 when settled.

    """

    def __init__(self, prior: Belief, plan: RunLengths) -> None:
        self.plan = plan
        self._prior = prior
        self._log_hazard = math.log(plan.hazard * plan.spacing)
        self.reset()

    def reset(self) -> None:
        """Go back to the prior."""
        self.restore(TrackerState((*information_of(self._prior), *NOTHING), (), (), (), 1.0, 0, 0))

    def state(self) -> TrackerState:
        """Return all that is remembered."""
        return TrackerState(
            self._memory,
            tuple(self._parts),
            tuple(self._watchers),
            tuple(self._rows),
            self._mean_weight,
            self._count,
            self.steps_found,
        )

    def restore(self, state: TrackerState) -> None:
        """Take over what was remembered."""
        self._memory: MilsState = state.memory
        self._parts = deque(state.parts, maxlen=self.plan.p)
        self._watchers = list(state.watchers)
        self._rows = deque(state.rows, maxlen=self.plan.lockout)
        self._mean_weight = state.mean_weight
        self._count, self.steps_found = state.count, state.steps_found
        self._mix()

    def begin(self, belief: Belief) -> None:
        """Start a new long memory from a belief; watchers of the old one go."""
        self._memory = (*information_of(belief), *NOTHING)
        self._parts.clear()
        self._watchers = []
        self._mean_weight = 1.0
        self._mix()

    def update(self, v: float, s: float, y: float, R: float, slow: float = 1.0) -> float:
        """Take in one observation y = a + b v + c s + noise; return its weight in the long memory.

        Args:
            v: Speed in it [m/s].
            s: Mean square of the speed in it.
            y: Observed resistance [N/kN].
            R: Variance of the noise.
            slow: How many times R an observation counts in the mean of many; 1 if the noise is white.

        """
        plan = self.plan
        if self._count % plan.spacing == 0 and self._count > 0:
            self._bear()
        self._count += 1
        self._rows.append((v, s, y, R, slow))
        oldest = self._parts.popleft() if len(self._parts) == plan.p else NOTHING
        self._memory, newest, weight, score = mils_step(self._memory, oldest, v, s, y, R, slow, plan.outliers, plan.p)
        self._parts.append(newest)
        self._watch(v, s, y, R, slow, score)
        self._mean_weight += (weight - self._mean_weight) / plan.lockout
        if self._mean_weight < _LOCKED_OUT:
            self._begin_anew()
        self._mix()
        return weight

    def drift(self, rates: tuple[float, float, float], elapsed_s: float, most: tuple[float, float, float]) -> None:
        """Let the parameters have wandered, see :func:`robust.drifted`."""
        belief = drifted(belief_of(self._memory[:9]), rates, elapsed_s, most)
        self._memory = (*information_of(belief), *self._memory[9:])
        self._watchers = [(*drifted(item[:9], rates, elapsed_s, most), *item[9:]) for item in self._watchers]
        self._mix()

    def _bear(self) -> None:
        """Add a watcher; where there is no room, the one that the evidence speaks against most goes."""
        if not self.plan.watchers:
            return
        if len(self._watchers) >= self.plan.watchers:
            self._watchers.remove(min(self._watchers, key=lambda item: item[9]))
        born = widened(belief_of(self._memory[:9]), self.plan.step_variances)
        self._watchers.append((*born, 0.0, 0.0))

    def _watch(self, v: float, s: float, y: float, R: float, slow: float, score: float) -> None:
        """Let all watchers learn, and count what they predicted better; the likeliest may take over."""
        best, most = None, _GIVEN_UP - self._log_hazard
        for i, item in enumerate(self._watchers):
            belief, _, found = soft_update(item[:9], v, s, y, R, slow, self.plan.outliers)
            # Noise that hangs together says the same thing several times.
            evidence = min(item[9] + (found - score) / max(slow, 1.0), _MOST_EVIDENCE)
            self._watchers[i] = (*belief, evidence, item[10] + 1.0)
            if item[10] >= self.plan.patience and evidence > most:
                best, most = i, evidence
        if best is not None:
            self._take_over(best)

    def _take_over(self, index: int) -> None:
        chosen = self._watchers[index]
        younger = [item for item in self._watchers if item[10] < chosen[10]]
        self.begin(chosen[:9])
        self._watchers = [(*item[:9], item[9] - chosen[9], item[10]) for item in younger]
        self.steps_found += 1

    def _begin_anew(self) -> None:
        """Most observations contradict the belief: learn from the latest alone, if they agree among themselves."""
        if len(self._rows) < LEAST_ROWS:
            return
        fit = robust_fit(tuple(self._rows), self._prior)
        if fit is not None:
            self.begin(fit)
            self.steps_found += 1

    def _mix(self) -> None:
        """Weigh all beliefs by their probability."""
        beliefs, odds = [belief_of(self._memory[:9])], [1.0]
        for item in self._watchers:
            if item[10] > self.plan.patience and item[9] + self._log_hazard > -_GIVEN_UP:
                beliefs.append(item[:9])
                odds.append(math.exp(item[9] + self._log_hazard))
        self.change_probability = 1.0 - 1.0 / math.fsum(odds)
        self.belief: Belief = mixed(beliefs, odds) if len(beliefs) > 1 else beliefs[0]
