# SPDX-License-Identifier: Apache-2.0
"""What to drive so that the resistance becomes known: the shortest drive that does it, and the std that it promises.

The promised standard deviations come from the estimator's own information matrix: the recursion of its covariance over
the planned drive, with the noise that it has learned (correlated gusts and map errors, noise of the speed).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.resistance.davis_posterior import SEEN_SHARE, resistance_std
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.planned_drive import KM_H, planned_runs, top_speed
from trainid_ros.resistance.vmils import VMils
from trainid_ros.train.train_file import Davis

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from trainid_ros.interface.results import ResistanceEstimate
    from trainid_ros.resistance.planned_drive import Run
    from trainid_ros.train.train_file import TrainFile

# Maximum number of repetitions of a run.
_MAX_TIMES: Final = 3
# Largest useful ratio of the standard deviations after and before a drive [1].
_MAX_STD_RATIO: Final = 0.9
# Smallest relative reduction of the standard deviation that justifies a longer drive [1].
_MIN_REDUCTION: Final = 0.03
# Tolerance of a standard deviation, as a multiple of its limit or of the present one [1].
_TOLERANCE: Final = 1.05
# Standard deviation from which a force scale counts as known [1].
_MIN_SCALE_STD: Final = 0.01
# Smallest plausible force scale [1].
_MIN_SCALE: Final = 0.1
# w must be known up to the top speed, checked at these shares of it.
_SHARES: Final = (0.25, 0.5, 0.75, 1.0)
_NUMBERS: Final = {1: 'once', 2: 'twice'}


@dataclass(frozen=True, slots=True)
class Wanted:
    """A quantity that should be known: its name, unit, standard deviation in an estimate, and the limit of that."""

    name: str
    unit: str
    std: Callable[[Any], float]
    limit: float


@dataclass(frozen=True, slots=True)
class Promise:
    """Standard deviation of a quantity before and after a drive, and up to which it is known, all in its unit."""

    wanted: Wanted
    now: float
    then: float

    @property
    def ratio(self) -> float:
        """Standard deviation after the drive over its limit [1]."""
        return self.then / self.wanted.limit

    @property
    def before(self) -> float:
        """Standard deviation before it over its limit [1]."""
        return self.now / self.wanted.limit

    @property
    def is_worse(self) -> bool:
        """Whether the quantity is known less well after the drive, and not well enough."""
        return self.ratio > _TOLERANCE * max(1.0, self.before)


@dataclass(frozen=True, slots=True)
class SuggestedDrive:
    """A drive and what it promises."""

    run: Run  # One run of it, from stop to stop
    times: int  # Number of runs
    least_known: Promise  # The quantity for which it is driven
    promises: tuple[Promise, ...]  # All quantities

    @property
    def duration_s(self) -> float:
        """Duration without dwells [s]."""
        return self.times * self.run.duration_s

    @property
    def text(self) -> str:
        """The drive in words, with what it promises."""
        wanted, promise = self.least_known.wanted, self.least_known
        times = _NUMBERS.get(self.times, f'{self.times} times')
        length = f'{self.times * self.run.length_m / 1000.0:.1f} km'
        std = f'{wanted.name} ± {promise.then:.2g}{f" {wanted.unit}" if wanted.unit else ""}, now ± {promise.now:.2g}'
        missed = '' if promise.ratio <= _TOLERANCE else f' (wanted ± {wanted.limit:.2g})'
        return f'{self.run.manoeuvre.text} {times} ({length}): {std}{missed}'

    @property
    def numbers(self) -> dict[str, object]:
        """The drive for JSON: the text, speeds [m/s], command [m/s^2], number of runs, times [s], length [m], stds."""
        manoeuvre, promise = self.run.manoeuvre, self.least_known
        return {
            'text': self.text,
            'from_speed': manoeuvre.start,
            'to_speed': 0.0 if manoeuvre.braking < 0.0 else manoeuvre.end,
            'held_s': manoeuvre.held_s,
            'brake_command': manoeuvre.braking,
            'times': self.times,
            'duration_s': self.duration_s,
            'length_m': self.times * self.run.length_m,
            'least_known': promise.wanted.name,
            'std': {item.wanted.name: _stds(item) for item in self.promises},
        }


class _Candidate(NamedTuple):
    """A run, how often it is driven, and what that promises."""

    run: Run
    times: int
    promises: tuple[Promise, ...]

    @property
    def duration_s(self) -> float:
        """Duration without dwells [s]."""
        return self.times * self.run.duration_s


def _stds(promise: Promise) -> dict[str, object]:
    wanted = promise.wanted
    return {'unit': wanted.unit, 'now': promise.now, 'then': promise.then, 'wanted': wanted.limit}


def suggested_drive(
    estimator: object, train_file: TrainFile, prior: ResistanceEstimate, now: ResistanceEstimate
) -> SuggestedDrive | None:
    """Return the shortest drive that makes known what is not, as far as any drive does.

    Args:
        estimator: The estimator of the resistance; only the filter bank and V-MILS can foresee their covariance.
        train_file: Train file.
        prior: Estimate before the first sample.
        now: Present estimate.

    Returns:
        None if all is known, if nothing was learned yet, or if no drive would help.
    """
    if not isinstance(estimator, FilterBank | VMils) or not now.speed_max > 0.0:
        return None
    config = estimator.config
    quantities = tuple(_quantities(train_file, prior, now, config.valid_std, config.valid_share))
    scale = now.force_scale if now.force_scale > _MIN_SCALE else 1.0  # it may be NaN
    runs = planned_runs(train_file, Davis(now.a, now.b, now.c), scale)
    return best_drive(quantities, now, runs, estimator.foreseen)


def best_drive(
    quantities: Sequence[Wanted], now: object, runs: Iterable[Run], foreseen: Callable[[Run, int], Iterable[object]]
) -> SuggestedDrive | None:
    """Return the shortest drive that makes known what is not, None if all is known or no drive would help.

    Args:
        quantities: What should be known.
        now: Present estimate.
        runs: Runs to compare.
        foreseen: Returns the estimates after one, two, ... of a number of runs.
    """
    if all(wanted.std(now) <= wanted.limit for wanted in quantities):
        return None
    drives = []
    for run in runs:
        for times, then in enumerate(foreseen(run, _MAX_TIMES), 1):
            promises = tuple(Promise(wanted, wanted.std(now), wanted.std(then)) for wanted in quantities)
            if not any(promise.is_worse for promise in promises):
                drives.append(_Candidate(run, times, promises))
    best = _shortest(sorted(drives, key=attrgetter('duration_s')))
    return best if best is not None and best.least_known.then < _MAX_STD_RATIO * best.least_known.now else None


def _shortest(drives: Sequence[_Candidate]) -> SuggestedDrive | None:
    """Return the best of the drives, shortest first: a longer one must be better.

    What counts is the quantity that is least known after the drive, of those that at least one drive makes known; or
    of those for which the drives are made if none does.
    """
    if not drives:
        return None
    first = drives[0].promises
    reached = [k for k in range(len(first)) if min(drive.promises[k].ratio for drive in drives) <= 1.0]
    unknown = [k for k, item in enumerate(first) if item.before > 1.0]
    counted = reached if set(reached) & set(unknown) else unknown
    best, least = drives[0], math.inf
    for drive in drives:
        ratio = max(drive.promises[k].ratio for k in counted)
        if ratio < (1.0 - _MIN_REDUCTION) * least:
            best, least = drive, ratio
        if least <= 1.0:
            break
    least_known = max((best.promises[k] for k in counted), key=attrgetter('before'))
    return SuggestedDrive(best.run, best.times, least_known, best.promises)


def _quantities(
    train_file: TrainFile, prior: ResistanceEstimate, now: ResistanceEstimate, valid_std: float, valid_share: float
) -> Iterator[Wanted]:
    """Yield what should be known: a, b and c as :func:`observe` demands, w up to the top speed, and the force scale."""
    units = ('N/kN', 'N/kN per m/s', 'N/kN per (m/s)^2')
    left = math.sqrt(1.0 - SEEN_SHARE)
    for k, (name, unit) in enumerate(zip('abc', units, strict=True)):
        yield Wanted(name, unit, partial(_parameter, k), left * _parameter(k, prior))
    for share in _SHARES:
        v = share * top_speed(train_file)
        w = now.a + v * (now.b + v * now.c)
        yield Wanted(f'w at {v / KM_H:.0f} km/h', 'N/kN', partial(_at, v), math.hypot(valid_std, valid_share * w))
    if not math.isnan(prior.force_scale_std):
        yield Wanted('force scale', '', _scale, max(_MIN_SCALE_STD, left * prior.force_scale_std))


# The standard deviations of an estimate: functions of the module, so that a drive can be sent to another process.


def _parameter(k: int, estimate: ResistanceEstimate) -> float:
    return math.sqrt(max(0.0, estimate.covariance[4 * k]))


def _at(v: float, estimate: ResistanceEstimate) -> float:
    return resistance_std(estimate.covariance, v)


def _scale(estimate: ResistanceEstimate) -> float:
    return estimate.force_scale_std
