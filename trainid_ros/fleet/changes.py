# SPDX-License-Identifier: Apache-2.0
"""When a train has changed, what the change may be, and on which days it was away from its usual level.

In each channel the values of a train, less what trains have in common, lie around a level: errors are Student's t, the
level is normal around that of the fleet. At a change the level moves by a normal step. Levels are integrated out on a
grid, so that the evidence of a step on day k, seen on day n, is the Bayes factor

    B_k(n) = p(y_1..y_n | step on day k) / p(y_1..y_n | no step)
    B_k(n) = prod_channels (1 - q + q B_k,channel(n)),                a step shows in each channel with probability q
    R(n)   = sum_{k <= n} B_k(n)                                      (Shiryaev-Roberts statistic)

Without a change R(n) - n is a martingale, so an alarm at R >= C comes less often than once in C days (Pollak, Ann.
Statist. 13 (1985) 206): C is the number of train-days for one false alarm. After an alarm the test goes on from the
step found, so that a repair is a change too.

The channels that show a change hint at its cause. A cause of size theta changes channel c by theta d_c, as a share of
the mean of the fleet. With a normal prior of theta and a slack for what the directions leave out, the steps found are
normal, and Bayes' rule gives the probability of each cause; 'other' changes each channel on its own.

A departure from the usual level lasts from the first change away from it to the change back. The usual level is that
before the first change, unless the train was then far from the others and came near them later: a table may begin with
a fault. Parts between two changes that lie to the same side of the usual level belong to one departure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.special import ndtr

from trainid_ros.fleet.mixed_model import CHANNELS, Array, log_t

OTHER: Final = 'other'
"""Name of an unknown cause."""
MIN_AFTER: Final = 2
"""Minimum number of days with data after a step."""
_SHOWING: Final = 0.5  # Probability that a step shows in a channel, q [1]
_WINDOW: Final = 60  # Number of newest days in which a step is searched
_TINY: Final = 1e-300  # Lower limit of a density, so that its logarithm is finite
_BACK: Final = 0.4  # Share of a departure below which the train is back [1]


class Series(NamedTuple):
    """Values of one train in one channel by day, less what trains have in common; NaN where there is none."""

    value: Array  # Shape (days,)
    std: Array  # Scale of the errors, shape (days,)
    degrees: float  # Degrees of freedom of the errors
    level_std: float  # Standard deviation of the level among trains
    step_std: float  # Standard deviation of a step that matters


class Level(NamedTuple):
    """Level of a channel with its standard deviation."""

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
    """A change of a train."""

    day: int  # First day after it
    alarm: int  # Day of the alarm
    evidence: float  # ln R at the newest day of this segment
    steps: tuple[Step | None, ...]  # Steps by channel, None where the channel has no data


class _Segment:
    """Likelihood of the levels of one channel from a first day on."""

    def __init__(self, series: Series, level_std: float) -> None:
        known = np.isfinite(series.value)
        spread = float(np.median(series.std[known]))
        low, high = float(series.value[known].min()), float(series.value[known].max())
        room = 6.0 * spread  # beyond the outermost values
        count = int(min(600, max(60, 6.0 * (high - low + 2.0 * room) / spread)))  # six for one std of a day
        self.level = np.linspace(low - room, high + room, count)
        kernel = _weights(self.level[:, None] - self.level[None, :], series.step_std)
        far = _weights(self.level, math.hypot(level_std, series.step_std))
        # One train in a hundred may be far from the others.
        self.prior = (1.0 - 0.01) * _weights(self.level, level_std) + 0.01 * far
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
        density = (self.after_prior[ks] * np.exp(gained - top)).sum(axis=1)
        after = np.log(np.maximum(density, _TINY)) + top[:, 0]
        found: Array = self._log_before[ks] + after - self._log_before[n]
        return np.where(self.known[n] - self.known[ks] >= MIN_AFTER, found, 0.0)

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
    while (found := _next_change(channels, changes[-1].day if changes else 0, limit)) is not None:
        changes.append(found)
    return changes


def _next_change(channels: Sequence[Series], first: int, limit: float) -> Change | None:
    """Return the first change after a day, None if there is none."""
    parts: list[_Segment | None] = []
    for series in channels:
        rest = series._replace(value=series.value[first:], std=series.std[first:])
        level_std = math.hypot(series.level_std, series.step_std) if first else series.level_std
        parts.append(_Segment(rest, level_std) if np.isfinite(rest.value).any() else None)
    count = channels[0].value.size - first
    for n in range(MIN_AFTER + 1, count + 1):
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
            joint += np.logaddexp(math.log(1.0 - _SHOWING), math.log(_SHOWING) + found)
    return float(np.logaddexp.reduce(joint)), joint, each


def _change(parts: Sequence[_Segment | None], first: int, alarm: int, count: int) -> Change:
    """Return the change of an alarm after a number of days of the segment, by all data until it becomes unlikely.

    Later data move its day only among those before the alarm: a change after that is another one.
    """
    last = alarm - MIN_AFTER
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
    return np.asarray(ndtr(at / std + half) - ndtr(at / std - half))


def _posterior(prior: Array, log_likelihood: Array) -> tuple[Array, Array]:
    """Return weights of the grid after data, shape (rows, grid), and ln of the evidence, shape (rows,)."""
    top = log_likelihood.max(axis=1, keepdims=True)
    weight = prior * np.exp(log_likelihood - top)
    total = np.maximum(weight.sum(axis=1, keepdims=True), _TINY)
    return weight / total, np.log(total[:, 0]) + top[:, 0]


class Cause(NamedTuple):
    """A cause with its probability: name of the effect of the library, what it is in a depot, and what to do there."""

    effect: str
    title: str
    probability: float
    check: str = ''  # What to check in the depot


class _Kind(NamedTuple):
    """A cause of changes."""

    effect: str
    title: str
    directions: tuple[Mapping[str, float], ...]  # Its possible directions, each by channel
    size: float  # Standard deviation of theta [1]
    sign: int  # Of theta, 0 for both
    check: str  # What to check in the depot


# What drags after a release is not there while the brake acts, which then seems weaker: a usual w15 of 4 N/kN, or
# 0.04 m/s^2, is 5 % of a service braking of 0.8 m/s^2.
_AFTER_RELEASE: Final = {'w15': 1.0, 'brake_rate': -0.05}
_KINDS: Final = (
    _Kind(
        'dragging_brake', 'dragging brake or another added resistance', ({'w15': 1.0}, _AFTER_RELEASE), 0.3, 1,
        'check cylinder pressure and gap of the pads with brakes released, then heat of discs and axles after a run',
    ),
    _Kind(
        'resistance_step', 'less resistance than before, as after a repair', ({'w15': 1.0},), 0.3, -1,
        'ask what was repaired or changed that day, such as bearings, brakes or fairings',
    ),
    _Kind(
        'brake_scale', 'worn or glazed brake pads', ({'brake_rate': 1.0},), 0.1, -1,
        'check thickness and surface of the pads, cylinder pressure of each car, isolated brake units',
    ),
    _Kind(
        'brake_scale', 'brake stronger than before, as with new pads', ({'brake_rate': 1.0},), 0.1, 1,
        'ask whether pads were replaced, then fit the brake section anew',
    ),
    # A wheel that reads r times the true speed makes each force seem r times as strong, and each distance as long.
    _Kind(
        'wheel_diameter', 'wrong wheel diameter',
        ({'wheel_ratio': 1.0, 'force_scale': 1.0, 'brake_rate': 1.0},), 0.02, 0,
        'measure the wheels (re-profiled or changed?) and compare the diameter that the odometer is set to',
    ),
    # A train heavier than weighed reaches less acceleration with each force.
    _Kind(
        'mass_error', 'wrong weighing', ({'force_scale': 1.0, 'brake_rate': 1.0},), 0.08, 0,
        'weigh the empty train, then check pressure sensors of the air springs and scale of the weighing',
    ),
    _Kind(
        'traction_scale', 'traction force reported wrongly', ({'force_scale': 1.0},), 0.08, 0,
        'compare reported force and motor currents; check for isolated motors and new software of the drive',
    ),
    # The last one changes each channel on its own.
    _Kind(
        OTHER, 'no single known cause', (), 0.0, 0,
        'look at its bags first: trainid fleet report --explain 1 names a cause from them',
    ),
)  # fmt: skip


def causes_of(steps: Mapping[str, tuple[float, float] | None]) -> tuple[Cause, ...]:
    """Return the causes with a probability of 5 % or more, the most probable first.

    ``steps`` holds step and standard deviation as shares of the mean of the fleet by channel, None without data.
    """
    channels = [channel for channel in CHANNELS if steps.get(channel.name) is not None]
    names = tuple(channel.name for channel in channels)
    step, std = np.array([steps[name] for name in names]).reshape(-1, 2).T
    noise = np.diag(std**2 + np.array([channel.slack for channel in channels]) ** 2)
    found = []
    for kind in _KINDS[:-1]:  # whose directions are equally probable; that of a resistance needs it
        known = [way if 'w15' in names or 'w15' not in way else {} for way in kind.directions]
        ways = [np.array([way.get(name, 0.0) for name in names]) for way in known]
        each = [_log_evidence(kind, way, step, noise) for way in ways]
        found.append(float(np.logaddexp.reduce(each)) - math.log(len(each)))
    other = noise + np.diag([channel.change**2 for channel in channels])
    log_p = np.array([*found, _log_normal(step, other)])
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    causes = (Cause(kind.effect, kind.title, float(x), kind.check) for kind, x in zip(_KINDS, p, strict=True))
    return tuple(sorted((c for c in causes if c.probability >= 0.05), key=lambda cause: -cause.probability))


def _log_evidence(kind: _Kind, d: Array, step: Array, noise: Array) -> float:
    """Return ln p(steps | cause, direction); one of one sign has twice the density there and none on the other side."""
    if not d.any():
        return -math.inf
    log_p = _log_normal(step, noise + kind.size**2 * np.outer(d, d))
    if not kind.sign:
        return log_p
    # Posterior of theta: the share of it on the permitted side.
    weight = np.linalg.solve(noise, d)
    variance = 1.0 / (float(d @ weight) + kind.size**-2)
    z = kind.sign * variance * float(weight @ step) / math.sqrt(2.0 * variance)
    return log_p + math.log(max(_TINY, math.erfc(-z)))


def _log_normal(x: Array, covariance: Array) -> float:
    _, log_det = np.linalg.slogdet(covariance)
    return -0.5 * (float(log_det) + float(x @ np.linalg.solve(covariance, x)) + x.size * math.log(2.0 * math.pi))


@dataclass(frozen=True, slots=True)
class Departure:
    """Days on which a train was away from its usual level."""

    first: int  # First day; 0 if the table begins with it
    end: int | None  # First day after it, None if it has not ended
    alarm: int  # Day of the alarm; for a departure that began before the table, the day its end was detected
    evidence: float  # ln R of the most certain of its changes
    # From the usual level to that of its most certain part by channel, None where the channel has no data
    steps: tuple[Step | None, ...]


class _Part(NamedTuple):
    """Days between two changes, and levels by channel, None without data."""

    first: int
    end: int | None
    levels: tuple[Level | None, ...]


def usual_days(channels: Sequence[Series], changes: Sequence[Change]) -> tuple[float, float]:
    """Return the first day of the usual level of a train, and the first one after it."""
    if not changes:
        return 0.0, math.inf
    parts = _parts(changes)
    part = parts[_usual(channels, parts)]
    return float(part.first), math.inf if part.end is None else float(part.end)


def departures(channels: Sequence[Series], changes: Sequence[Change]) -> tuple[Departure, ...]:
    """Return the departures of a train by its values and changes, in order."""
    if not changes:
        return ()
    parts = _parts(changes)
    usual = _usual(channels, parts)
    steps = [tuple(map(_step, channels, parts[usual].levels, part.levels)) for part in parts]
    # In steps that matter; 0 where a channel has no data.
    sizes = [
        np.array([step.size / series.step_std if step else 0.0 for series, step in zip(channels, own, strict=True)])
        for own in steps
    ]
    groups: list[list[int]] = []
    away = False
    for k, size in enumerate(sizes):
        main = _main(steps, groups[-1]) if away else k
        if k == usual or (k != main and float(np.linalg.norm(size)) < _BACK * float(np.linalg.norm(sizes[main]))):
            away = False
        elif k != main and float(size @ sizes[main]) >= _BACK * float(sizes[main] @ sizes[main]):
            groups[-1].append(k)
        else:
            groups.append([k])
            away = True
    found = []
    for group in groups:
        # Change k - 1 begins part k; if the table begins with it, its end is what shows it.
        mine, main = [changes[max(k - 1, 0)] for k in group], _main(steps, group)
        evidence = max(change.evidence for change in mine)
        found.append(Departure(parts[group[0]].first, parts[group[-1]].end, mine[0].alarm, evidence, steps[main]))
    return tuple(found)


def _parts(changes: Sequence[Change]) -> list[_Part]:
    starts = [0, *(change.day for change in changes)]
    ends = [*starts[1:], None]
    first = tuple(step and step.before for step in changes[0].steps)
    levels = [first, *(tuple(step and step.after for step in change.steps) for change in changes)]
    return [_Part(*part) for part in zip(starts, ends, levels, strict=True)]


def _usual(channels: Sequence[Series], parts: Sequence[_Part]) -> int:
    """Return the number of the part with the usual level: the first, unless that is five std from the fleet."""
    distances = []  # largest one of the channels, in standard deviations among trains
    for part in parts:
        known = ((series, level) for series, level in zip(channels, part.levels, strict=True) if level is not None)
        each = (abs(level.mean) / math.hypot(series.level_std, level.std) for series, level in known)
        distances.append(max(each, default=0.0))
    return 0 if distances[0] < 5.0 else distances.index(min(distances))


def _step(series: Series, before: Level | None, after: Level | None) -> Step | None:
    """Return the step between two normal levels with ln of its Bayes factor, None without data."""
    if before is None or after is None:
        return None
    noise, total = before.std**2 + after.std**2, before.std**2 + after.std**2 + series.step_std**2
    square = (after.mean - before.mean) ** 2
    return Step(before, after, 0.5 * (square / noise - square / total - math.log(total / noise)))


def _main(steps: Sequence[tuple[Step | None, ...]], group: Sequence[int]) -> int:
    """Return the most certain part of a departure."""
    return max(group, key=lambda k: sum(step.evidence for step in steps[k] if step))
