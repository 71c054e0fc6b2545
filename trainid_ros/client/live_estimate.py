# SPDX-License-Identifier: Apache-2.0
"""One estimate of the nodes: whether it may be used now, and its values, which move gradually.

A VALID or HOLDING estimate may be used until the next one is due. When a VALID estimate becomes CONVERGING, its last
valid values are kept, but their uncertainty is raised at once to that of the train file; they are given up when the
present estimate refutes them. Otherwise the train file applies: at most ``FALL_BACK_S`` after the reason for it, such
as a status, silence, or the end of the node.

Values never jump: a normal distribution moves to each new one at a bounded rate. On its way from (m0, P0) to (m, P),
with the share g of the way done, d = m - m0 and q = (1 - g)^2,

    mean = m0 + g d,        covariance = P + q (d d' + R),        R = positive part of P0 - P - d d'.

So the standard deviation covers what is left of the way in every direction. It rises at once by what it must cover,
and then falls gradually. The positive part is taken in units of the train file's standard deviations.

A move that must end within a stated time is one to the train file, which is less certain: the covariance goes straight
from P0 to P then, so that no bound is beyond both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import mul, sub
from typing import Final

import numpy as np

from trainid_ros.interface.results import Status
from trainid_ros.interface.scalars import seconds

MAX_RATE: Final = 0.25
"""Largest rate of change towards a live value, in standard deviations of the train file's value per second."""

ABSURD: Final = 1e6
"""Larger magnitudes are treated as invalid."""
_TINY: Final = 1e-9  # keeps divisors above zero
ROUNDING: Final = 1e-6  # error that a correlation may have [1]


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal distribution of n parameters."""

    mean: tuple[float, ...]  # shape (n,)
    covariance: tuple[float, ...]  # shape (n, n), row-major

    def along(self, direction: Sequence[float]) -> tuple[float, float]:
        """Return mean and variance of the parameters' sum with these weights, shape (n,)."""
        n = len(self.mean)
        mean = math.fsum(map(mul, direction, self.mean))
        row = (math.fsum(map(mul, self.covariance[n * i : n * i + n], direction)) for i in range(n))
        return mean, max(0.0, math.fsum(map(mul, row, direction)))

    def is_possible(self) -> bool:
        """Return whether no number is absurd, NaN included, and no weighted sum has a negative variance."""
        n = len(self.mean)
        if len(self.covariance) != n * n or not all(abs(x) < ABSURD for x in (*self.mean, *self.covariance)):
            return False
        P = np.reshape(self.covariance, (n, n))
        if np.diag(P).min() < 0.0:
            return False
        stds = np.sqrt(np.diag(P))
        most = np.outer(stds, stds)
        if np.any(np.abs(P) > (1.0 + ROUNDING) * most) or np.any(np.abs(P - P.T) > ROUNDING * most):
            return False
        units = np.where(most > 0.0, most, 1.0)
        return bool(np.linalg.eigvalsh(P / units)[0] >= -ROUNDING)


class RateLimitedValue:
    """Follows the newest distribution, from that of the train file on; the slowest of ``probes`` gives the duration."""

    def __init__(self, start: Normal, probes: Sequence[Sequence[float]]) -> None:
        self._file = self._to = start
        self._probes, self._power = probes, 2
        self._way: tuple[float, ...] = ()
        self._excess: tuple[float, ...] = ()
        self._begin_s = self._duration_s = 0.0
        self._unit = np.sqrt(np.array(start.covariance[:: len(start.mean) + 1])) + _TINY

    def left_s(self, time_s: float) -> float:
        """Return the time from a time [s] until the newest distribution is reached [s]."""
        return max(0.0, self._begin_s + self._duration_s - time_s)

    def go_to(self, target: Normal, time_s: float, max_duration_s: float = math.inf) -> None:
        """Move to a distribution from a time [s] on, within ``max_duration_s`` [s]."""
        start = self.at(time_s)
        self._to, self._begin_s = target, time_s
        self._duration_s = min(self._longest_way(start, target) / MAX_RATE, max_duration_s)
        self._way = tuple(map(sub, target.mean, start.mean))
        self._power = 2 if math.isinf(max_duration_s) else 1
        if self._duration_s > 0.0:
            straight = tuple(map(sub, start.covariance, target.covariance))
            self._excess = self._uncovered(start) if self._power == 2 else straight

    def at(self, time_s: float) -> Normal:
        """Return the distribution at a time [s], which is not before the last :meth:`go_to`."""
        left = self.left_s(time_s) / self._duration_s if self._duration_s > 0.0 else 0.0
        if left <= 0.0:
            return self._to
        left = min(left, 1.0)
        mean = tuple(map(lambda value, step: value - left * step, self._to.mean, self._way))
        q = left**self._power
        return Normal(mean, tuple(map(lambda P, X: P + q * X, self._to.covariance, self._excess)))

    def _uncovered(self, start: Normal) -> tuple[float, ...]:
        """Return d d' + R, row-major."""
        d, n = np.array(self._way), len(self._way)
        square = np.outer(d, d)
        more = np.reshape(start.covariance, (n, n)) - np.reshape(self._to.covariance, (n, n)) - square
        values, vectors = np.linalg.eigh(more / np.outer(self._unit, self._unit))
        root = self._unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return tuple((square + root @ root.T).ravel().tolist())

    def _longest_way(self, start: Normal, target: Normal) -> float:
        """Return the longest way of a value, or down of its standard deviation, in those of the train file."""
        longest = 0.0
        for probe in self._probes:
            (before, old), (after, new), unit = (x.along(probe) for x in (start, target, self._file))
            change = max(abs(after - before), math.sqrt(old) - math.sqrt(new))
            # A train file may state a value without any uncertainty: moves are measured in 1 % of it then.
            longest = max(longest, change / max(math.sqrt(unit[1]), 0.01 * abs(unit[0]), _TINY))
        return longest


FALL_BACK_S: Final = 0.2
"""Time in which values go back to those of the train file [s]."""
MAX_AGE_S: Final = 0.75
"""Time without a new estimate after which the last one is not used any more [s]."""
WORDS: Final = {  # what statuses say that are not fit to use
    Status.UNINITIALIZED: 'UNINITIALIZED, the node has no sample yet',
    Status.CONVERGING: 'CONVERGING, not fit to use',
    Status.STALE: 'STALE, inputs of the node are missing',
    Status.FAULT: 'FAULT, the node has failed',
}
FAR: Final = 5.0
"""Distance from the train file's value beyond which an estimate is not credible [standard deviations of it]."""
LEAST_STD: Final = 0.01
"""Smallest credible standard deviation as a share of that of the train file [1]: drift between two stops is more."""
_REFUTED: Final = 'CONVERGING, the present estimate refutes the last valid value'


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameters that are estimated together."""

    file: Normal  # their distribution by the train file
    probes: tuple[tuple[float, ...], ...]  # directions in which their moves are measured
    minimum: float = -ABSURD  # least possible value of a parameter, and of a weighted sum along a probe
    maximum: float = ABSURD  # largest one
    max_std: float = ABSURD  # largest possible standard deviation along a probe

    def problem(self, name: str, found: Normal) -> str:
        """Return what is not possible or not credible of an estimate; empty if it is."""
        if found.is_possible():
            sums = [found.along(probe) for probe in self.probes]
            values = (*found.mean, *(value for value, _ in sums))
            stds_fit = all(variance <= self.max_std * self.max_std for _, variance in sums)
            if stds_fit and self.minimum <= min(values) and max(values) <= self.maximum:
                return self._doubt(name, sums)
        if len(found.mean) > 1:
            return f'{name} or their covariance are not possible'
        std = math.copysign(math.sqrt(abs(found.covariance[0])), found.covariance[0])
        return f'{name} = {found.mean[0]:g} with a std of {std:g} is not possible'

    def _doubt(self, name: str, sums: Sequence[tuple[float, float]]) -> str:
        """Return why means and variances along the probes are not credible beside the train file; empty if they are."""
        file = [self.file.along(probe) for probe in self.probes]
        if any(abs(x - y) > FAR * math.sqrt(P) for (x, _), (y, P) in zip(sums, file, strict=True) if P > 0.0):
            return f'{name}: more than {FAR:g} standard deviations of the train file from its value'
        if all(LEAST_STD**2 * prior > P for (_, P), (_, prior) in zip(sums, file, strict=True) if prior > 0.0):
            return f'{name}: a std below {LEAST_STD:.0%} of that of the train file is not credible'
        return ''

    def is_refuted(self, value: Normal, present: Normal) -> bool:
        """Return whether a value is more than 3 standard deviations of the present estimate from it along any probe."""
        for probe in self.probes:
            now, variance = present.along(probe)
            if abs(value.along(probe)[0] - now) > 3.0 * math.sqrt(variance):
                return True
        return False


class Stamps:
    """Stamps of the estimates of one topic.

    Those that go back, as when a bag starts again, count as new once they have risen for ``least_s`` [s].
    """

    def __init__(self, least_s: float) -> None:
        self._least_s, self._newest_ns = least_s, -1
        # First and last stamp of those that rise again after they went back [ns]; none if the newest is the last.
        self._back_ns: tuple[int, int] | None = None

    def are_newer(self, stamp_ns: int) -> bool:
        """Take in a stamp [ns]; return whether it counts as newer than those before."""
        if stamp_ns < self._newest_ns:
            first, last = self._back_ns or (stamp_ns, stamp_ns)
            self._back_ns = (first if stamp_ns > last else stamp_ns), stamp_ns
            if seconds(stamp_ns - self._back_ns[0]) < self._least_s:
                return False
        is_newer = stamp_ns != self._newest_ns
        self._newest_ns, self._back_ns = stamp_ns, None
        return is_newer


class LiveEstimate:
    """Parameters of one estimate by name; not used any more after ``max_age_s`` [s] without a new one."""

    def __init__(self, parameters: Mapping[str, Parameter], max_age_s: float) -> None:
        self._parameters = parameters
        self._file = {name: parameter.file for name, parameter in parameters.items()}
        self._valid = self._file
        self._values = {name: RateLimitedValue(x.file, x.probes) for name, x in parameters.items()}
        self._max_age_s = max_age_s
        self._heard_s = self._now_s = self._moving_until_s = -math.inf
        self._stamps = Stamps(max_age_s)
        self._is_refused = self._is_kept = False  # The newest estimate; a copy since the last one that came
        self._lost = ''
        self._status = Status.UNINITIALIZED
        self._problem = 'no estimate yet'

    @property
    def is_live(self) -> bool:
        """Whether the values are those of an estimate, or on the way to them."""
        return not self._problem

    def is_heard(self, time_s: float) -> bool:
        """Return whether an estimate, usable or not, has come lately."""
        return time_s - self._heard_s <= self._max_age_s

    def take_new(self, status: Status, values: Mapping[str, Normal], time_s: float, stamp_ns: int) -> bool:
        """Take in an estimate; one of no newer stamp [ns] only if it says that the previous must not be used.

        Returns whether its stamp counts as newer.
        """
        self._is_kept = self._is_refused = False
        is_news = self._stamps.are_newer(stamp_ns)
        if is_news or not (status.is_usable or status is self._status is Status.CONVERGING):
            self.take(status, values, time_s)
        return is_news

    def refuse(self, reason: str, time_s: float) -> None:
        """Use the train file although an estimate has arrived, for a reason."""
        self.go_on(time_s)
        self._heard_s, self._lost, self._is_refused = time_s, '', True
        self._fall_back(reason, time_s)

    def take(self, status: Status, values: Mapping[str, Normal], time_s: float) -> None:
        """Take in an estimate that arrived at a time [s]."""
        self.go_on(time_s)
        self._heard_s, before, self._status, self._lost = time_s, self._status, status, ''
        if status is Status.CONVERGING and self.is_live:
            refuted = (self._parameters[name].is_refuted(self._valid[name], now) for name, now in values.items())
            if not self._find_problem(values) and any(refuted):
                self._fall_back(_REFUTED, time_s)
            elif before is not status:
                # Keep the last valid values, or the way to them, with the uncertainty of the train file.
                for name, value in self._values.items():
                    value.go_to(Normal(self._valid[name].mean, self._file[name].covariance), self._now_s)
        elif not status.is_usable:
            is_known = status is Status.CONVERGING and self._problem == _REFUTED
            self._fall_back(_REFUTED if is_known else WORDS[status], time_s)
        elif problem := self._find_problem(values):
            self._fall_back(problem, time_s)
        else:
            self._problem = ''
            self._valid = {name: values.get(name, self._file[name]) for name in self._file}
            for name, value in self._values.items():
                value.go_to(self._valid[name], self._now_s)
            # A move that takes more than a second is reported, until the rest takes less than FALL_BACK_S.
            left_s = max(value.left_s(self._now_s) for value in self._values.values())
            if left_s > 1.0 or self._now_s < self._moving_until_s:
                self._moving_until_s = self._now_s + left_s - FALL_BACK_S

    def take_latched(self, status: Status, values: Mapping[str, Normal], time_s: float) -> bool:
        """Take in the copy of the last valid estimate that is kept for those who join later; return if it counts.

        It does where nothing else is known, and as the last valid one where a CONVERGING one came before it. It comes
        once: further ones do not replace estimates that do not come, or that are refused.
        """
        is_heard = self.is_heard(time_s)
        if self._is_refused or self._is_kept or (is_heard and (self.is_live or self._status is not Status.CONVERGING)):
            return False
        self.take(status, values, time_s)
        if is_heard:
            self.take(Status.CONVERGING, {}, time_s)
        self._is_kept = True
        return True

    def _find_problem(self, values: Mapping[str, Normal]) -> str:
        found = (self._parameters[name].problem(name, normal) for name, normal in values.items())
        return next(filter(None, found), '')

    def mark_lost(self, reason: str, time_s: float) -> None:
        """Say why estimates will not come any more; what is still heard, perhaps of another publisher, goes on."""
        self.go_on(time_s)
        self._lost = reason
        if not self.is_heard(time_s):
            self._fall_back(reason, time_s)

    def go_on(self, time_s: float) -> None:
        """Advance to a time [s]; one that is before the last stands still."""
        due_s = self._heard_s + self._max_age_s
        if self.is_live and time_s > due_s:
            self._fall_back(self._lost or f'no new estimate for more than {self._max_age_s:g} s', due_s)
        self._now_s = max(self._now_s, time_s)

    def _fall_back(self, reason: str, time_s: float) -> None:
        if self.is_live:
            for name, value in self._values.items():
                value.go_to(self._file[name], max(time_s, self._now_s), FALL_BACK_S)
        self._problem = reason

    def normal(self, name: str) -> Normal:
        """Return a parameter now."""
        return self._values[name].at(self._now_s)

    def state(self) -> tuple[bool, str]:
        """Return whether the values are live, and how they are or why they are those of the train file."""
        if not self.is_live:
            return False, f'train file: {self._problem}'
        if self._status is Status.CONVERGING:
            return True, 'CONVERGING, the last valid value as uncertain as that of the train file'
        moving = self._now_s < self._moving_until_s
        return True, f'{self._status.name}, moving to the live value' if moving else self._status.name
