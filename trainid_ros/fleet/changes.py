# SPDX-License-Identifier: Apache-2.0
"""When a train has changed: sequential test of steps in several channels.

In each channel the values of a train, less what trains have in common, lie around a level: errors are Student's t, the
level is normal around that of the fleet. At a change the level moves by a normal step. Levels are integrated out on a
grid, so that the evidence of a step on day k, seen on day n, is the Bayes factor

    B_k(n) = p(y_1..y_n | step on day k) / p(y_1..y_n | no step)
    B_k(n) = prod_channels (1 - q + q B_k,channel(n)),                a step shows in each channel with probability q
    R(n)   = sum_{k <= n} B_k(n)                                      (Shiryaev-Roberts statistic)

Without a change R(n) - n is a martingale, so an alarm at R >= C comes less often than once in C days (Pollak, Ann.
Statist. 13 (1985) 206): C is the number of train-days for one false alarm. After an alarm the test goes on from the
step found, so that a repair is a change too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.special import ndtr

from trainid_ros.fleet.mixed_model import log_t

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_SHARE: Final = 0.5  # q
# A step is looked for among so many days before the newest, and needs so many days of data after it.
_WINDOW: Final = 60
_LEAST_AFTER: Final = 2
# Points of the grid for one standard deviation of a day, beyond the outermost value, and at most.
_DENSITY, _MARGIN, _MOST = 6.0, 6.0, 600
_FAR: Final = 0.01
_TINY: Final = 1e-300


class Series(NamedTuple):
    """Values of one train in one channel by day, less what trains have in common; NaN where there is none.

    Attributes:
        value: Shape (days,).
        std: Scale of the errors, shape (days,).
        degrees: Degrees of freedom of the errors.
        level_std: Standard deviation of the level among trains.
        step_std: Standard deviation of a step that matters.

    """

    value: Array
    std: Array
    degrees: float
    level_std: float
    step_std: float


class Level(NamedTuple):
    """Mean and standard deviation of the level of a channel."""

    mean: float
    std: float


class Step(NamedTuple):
    """Levels before and after a change, and ln of the channel's Bayes factor."""

    before: Level
    after: Level
    evidence: float

    @property
    def size(self) -> float:
        """Size of the step."""
        return self.after.mean - self.before.mean

    @property
    def std(self) -> float:
        """Standard deviation of the size."""
        return math.hypot(self.before.std, self.after.std)


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a train.

    Attributes:
        day: First day after it.
        alarm: Day on which it was certain enough.
        evidence: ln R at the newest day of this segment.
        steps: Steps by channel, None where the channel has no data.

    """

    day: int
    alarm: int
    evidence: float
    steps: tuple[Step | None, ...]


class _Segment:
    """Likelihood of the levels of one channel from a first day on."""

    def __init__(self, series: Series, level_std: float) -> None:
        known = np.isfinite(series.value)
        spread = float(np.median(series.std[known]))
        low, high = float(series.value[known].min()), float(series.value[known].max())
        room = _MARGIN * spread
        count = int(min(_MOST, max(60.0, _DENSITY * (high - low + 2.0 * room) / spread)))
        self.level = np.linspace(low - room, high + room, count)
        kernel = _weights(self.level[:, None] - self.level[None, :], series.step_std)
        # A few trains are far from the others.
        far = _weights(self.level, math.hypot(level_std, series.step_std))
        self.prior = (1.0 - _FAR) * _weights(self.level, level_std) + _FAR * far
        z2 = ((series.value[:, None] - self.level) / series.std[:, None]) ** 2
        each = np.where(known[:, None], log_t(z2, series.degrees), 0.0)
        self.total = np.vstack([np.zeros(count), np.cumsum(each, axis=0)])  # of the first n days, (days + 1, grid)
        self.known = np.concatenate(([0], np.cumsum(known)))
        before, self._log_before = _posterior(self.prior, self.total)
        self.after_prior = before @ kernel.T  # of the level after a step on day k, (days + 1, grid)

    def log_bayes(self, n: int, first: int) -> Array:
        """Return ln B_k after n days for k from ``first`` on, shape (n - first,); 0 with too few days after k."""
        ks = np.arange(first, n)
        gained = self.total[n] - self.total[ks]
        top = gained.max(axis=1, keepdims=True)
        after = _log((self.after_prior[ks] * np.exp(gained - top)).sum(axis=1)) + top[:, 0]
        found: Array = self._log_before[ks] + after - self._log_before[n]
        return np.where(self.known[n] - self.known[ks] >= _LEAST_AFTER, found, 0.0)

    def step(self, k: int, n: int, evidence: float) -> Step | None:
        """Return the step on day k, seen after n days."""
        if not 0 < self.known[k] < self.known[n]:
            return None
        before, _ = _posterior(self.prior, self.total[k : k + 1])
        after, _ = _posterior(self.after_prior[k], (self.total[n] - self.total[k])[None, :])
        return Step(self._moments(before[0]), self._moments(after[0]), evidence)

    def _moments(self, weight: Array) -> Level:
        mean = float(weight @ self.level)
        return Level(mean, math.sqrt(max(0.0, float(weight @ (self.level - mean) ** 2))))


def find_changes(channels: Sequence[Series], limit: float) -> list[Change]:
    """Return the changes of a train, in order; the channels have the same days."""
    changes: list[Change] = []
    first, count = 0, channels[0].value.size
    while first < count:
        found = _next_change(channels, first, limit, is_first=first == 0)
        if found is None:
            break
        changes.append(found)
        first = found.day
    return changes


def _next_change(channels: Sequence[Series], first: int, limit: float, *, is_first: bool) -> Change | None:
    """Return the first change after a day, None if there is none."""
    parts: list[_Segment | None] = []
    for series in channels:
        rest = series._replace(value=series.value[first:], std=series.std[first:])
        level_std = series.level_std if is_first else math.hypot(series.level_std, series.step_std)
        parts.append(_Segment(rest, level_std) if np.isfinite(rest.value).any() else None)
    count = channels[0].value.size - first
    for n in range(_LEAST_AFTER + 1, count + 1):
        if _log_r(parts, n)[0] >= math.log(limit):
            return _change(parts, first, n, count)
    return None


def _log_r(parts: Sequence[_Segment | None], n: int) -> tuple[float, Array, list[Array | None]]:
    """Return ln R(n), ln B_k(n) for the days of the window, and those of each channel."""
    begin = max(1, n - _WINDOW)
    each = [None if part is None else part.log_bayes(n, begin) for part in parts]
    joint = np.zeros(n - begin)
    for found in each:
        if found is not None:
            joint += np.logaddexp(math.log(1.0 - _SHARE), math.log(_SHARE) + found)
    return float(np.logaddexp.reduce(joint)), joint, each


def _change(parts: Sequence[_Segment | None], first: int, alarm: int, count: int) -> Change:
    """Return the change of an alarm after a number of days of the segment, by all data until it becomes unlikely.

    Later data move its day only among those before the alarm: a change after that is another one.
    """
    last = alarm - _LEAST_AFTER
    end, evidence, k, each = alarm, -math.inf, 0, tuple[float | None, ...]()
    for n in range(alarm, count + 1):
        begin = max(1, n - _WINDOW)
        _, joint, parted = _log_r(parts, n)
        joint = joint[: last + 1 - begin]
        if not joint.size or (total := float(np.logaddexp.reduce(joint))) < evidence:
            break
        best = int(np.argmax(joint))
        end, evidence, k = n, total, begin + best
        each = tuple(None if found is None else float(found[best]) for found in parted)
    steps = tuple(
        None if part is None or found is None else part.step(k, end, found)
        for part, found in zip(parts, each, strict=True)
    )
    return Change(first + k, first + alarm - 1, evidence, steps)


def _weights(at: Array, std: float) -> Array:
    """Return the probabilities of the cells of a grid, whose last axis or diagonal is even, under a normal density."""
    half = 0.5 * abs(float(at.flat[1] - at.flat[0])) / std
    found: Array = ndtr(at / std + half) - ndtr(at / std - half)
    return found


def _log(x: Array) -> Array:
    found: Array = np.log(np.maximum(x, _TINY))
    return found


def _posterior(prior: Array, log_likelihood: Array) -> tuple[Array, Array]:
    """Return weights of the grid after data, shape (rows, grid), and ln of the evidence, shape (rows,)."""
    top = log_likelihood.max(axis=1, keepdims=True)
    weight = prior * np.exp(log_likelihood - top)
    total = np.maximum(weight.sum(axis=1, keepdims=True), _TINY)
    return weight / total, _log(total[:, 0]) + top[:, 0]
