# SPDX-License-Identifier: Apache-2.0
"""What to drive so that the resistance or the brake rate becomes known, and the std that this drive promises.

A drive starts at a stop, on level track: full traction, then coasting or holding the speed, then braking, from which no
resistance is learned. Speeds follow ``m dv/dt = kappa T - a - b v - c v^2`` with the reported specific traction T
[N/kN], its scale kappa [1] and m = 1000 (1 + gamma) / g0.

The shortest drive is suggested that makes known what is not. The estimator promises the standard deviations: it
continues its recursion over the planned drive, with the noise that it has learned.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from operator import attrgetter
from typing import Any, Final, Protocol, runtime_checkable

from trainid_ros.interface.records import KM_H
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate
from trainid_ros.resistance.davis_posterior import SEEN_SHARE, resistance_std
from trainid_ros.train.forces import lag_response, specific_force, specific_inertia
from trainid_ros.train.line import LineProfile, profile_of
from trainid_ros.train.train_file import Davis, TrainFile

STEP_S: Final = 0.4
"""Duration of a step of a plan [s]."""
ACCELERATION: Final = 0.9  # limit of a service start [m/s^2]
JERK: Final = 0.8  # limit of a service start [m/s^3]
DECELERATION: Final = 0.6  # of the brake command to the stop [m/s^2]
# Shortest run with enough data for a prediction, and longest practicable run or braking [s].
_MIN_RUN_S, _MAX_RUN_S = 60.0, 900.0
# Speeds at which coasting or holding begins, as shares of the top speed; coasting ends at these shares of that speed.
_STARTS, _ENDS = (1.0, 0.7, 0.45), (0.85, 0.7, 0.5, 0.3)
# Times for which a speed is held [s].
_HELD_S: Final = (60.0, 180.0)


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """What the driver does once the train has left a stop."""

    start: float  # Speed up to which it accelerates with full traction [m/s]
    end: float  # Speed down to which it then coasts [m/s]; equal to ``start`` if it does not
    held_s: float = 0.0  # Time for which it holds the speed ``start`` instead [s]
    braking: float = 0.0  # Command of the braking to the stop [m/s^2, < 0] if that is what the manoeuvre is for; else 0

    @property
    def coasts(self) -> bool:
        """Whether the train coasts."""
        return self.end < self.start

    def is_over(self, speed: float, held_s: float) -> bool:
        """Return whether the train brakes at a speed [m/s], a time [s] after it has reached the speed ``start``."""
        return speed <= self.end if self.coasts else held_s >= self.held_s

    @property
    def text(self) -> str:
        """The manoeuvre in words."""
        if self.coasts:
            return f'coast from {self.start * KM_H:.0f} to {self.end * KM_H:.0f} km/h'
        if self.braking < 0.0:
            return f'brake from {self.start * KM_H:.0f} km/h with {self.braking:g} m/s²'
        if self.held_s > 0.0:
            return f'hold {self.start * KM_H:.0f} km/h for {self.held_s:.0f} s'
        return f'accelerate with full traction to {self.start * KM_H:.0f} km/h'


@dataclass(frozen=True, slots=True)
class Step:
    """Planned motion over :data:`STEP_S`."""

    speed: float  # Speed at its end [m/s]
    traction: float  # Mean reported specific traction [N/kN]
    ramp: float  # Rate of change of that traction [N/kN per s]


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a manoeuvre."""

    manoeuvre: Manoeuvre  # The manoeuvre
    steps: tuple[Step, ...]  # Its steps before the braking
    braking: tuple[float, ...]  # Speeds at the ends of the steps of the braking to the stop [m/s]

    @property
    def speeds(self) -> tuple[float, ...]:
        """Speeds from stop to stop, one at the end of each step [m/s]."""
        return (*(step.speed for step in self.steps), *self.braking)

    @property
    def duration_s(self) -> float:
        """Time from stop to stop [s]."""
        return STEP_S * len(self.speeds)

    @property
    def length_m(self) -> float:
        """Length from stop to stop [m]."""
        return STEP_S * math.fsum(0.5 * (before + after) for before, after in pairwise((0.0, *self.speeds)))

    def first_learned(self, settling_s: float, slowest: float) -> int:
        """Return the index of the first step from which is learned; the number of steps if there is none.

        The brake takes ``settling_s`` [s] to release; ``slowest`` is the slowest speed to learn from [m/s].
        """
        released = min(len(self.steps), math.ceil(settling_s / STEP_S))
        fast = (k for k, step in enumerate(self.steps[released:], released) if step.speed >= slowest)
        return next(fast, len(self.steps))


def planned_runs(train_file: TrainFile, davis: Davis, force_scale: float = 1.0) -> Iterator[Run]:
    """Yield runs that fit on the line, at the speeds that train and line allow; arguments as in :func:`plan_run`."""
    for manoeuvre in _manoeuvres(top_speed(train_file)):
        run = plan_run(manoeuvre, train_file, davis, force_scale)
        if run is not None and len(run.steps) * STEP_S >= _MIN_RUN_S and _fits(run, train_file):
            yield run


def _fits(run: Run, train_file: TrainFile) -> bool:
    """Return whether there is room for a run between two stops, within the speed limits."""
    line, length = train_file.line, run.length_m
    if not line.stops:
        return length <= 10e3
    profile = profile_of(train_file)
    # A limit ends when the rear of the train has passed it.
    ends = [position + train_file.train.length for position, _ in line.speed_limit]
    return any(
        stop <= begin <= following - length and _is_allowed(run, begin, profile)
        for stop, following in pairwise(line.stops)
        for begin in (stop, *ends)
    )


def _is_allowed(run: Run, begin: float, profile: LineProfile) -> bool:
    """Return whether a run from a position [m] on exceeds no speed limit by more than a controller does, 0.5 m/s."""
    position = begin
    for speed in run.speeds:
        position += STEP_S * speed
        if speed > profile.speed_limit(position, 1) + 0.5:
            return False
    return True


def top_speed(train_file: TrainFile) -> float:
    """Return the highest speed of train and line in whole steps of 5 km/h [m/s]."""
    limits = [limit for _, limit in train_file.line.speed_limit]
    fastest = min(train_file.train.max_speed, max(limits, default=math.inf))
    return max(1.0, math.floor(fastest * KM_H / 5.0 + 1e-6)) * 5.0 / KM_H


def _manoeuvres(top: float) -> Iterator[Manoeuvre]:
    for share in _STARTS:
        start = _round(share * top)
        yield Manoeuvre(start, start)
        yield from (Manoeuvre(start, end) for part in _ENDS if 0.0 < (end := _round(part * start)) < start)
        yield from (Manoeuvre(start, start, held_s) for held_s in _HELD_S)


def _round(speed: float) -> float:
    return round(speed * KM_H / 5.0) * 5.0 / KM_H


def plan_run(manoeuvre: Manoeuvre, train_file: TrainFile, davis: Davis, force_scale: float = 1.0) -> Run | None:
    """Return a run with a scale of the traction, actual over reported [1]; None if it takes too long."""
    train, scale = train_file.train, force_scale
    m = specific_inertia(1.0, train.rotary_mass)
    v = traction = held_s = 0.0
    steps: list[Step] = []
    reached = False
    while not (reached and manoeuvre.is_over(v, held_s)):
        w = davis.a + v * (davis.b + v * davis.c)
        reached = reached or v >= manoeuvre.start
        held_s += STEP_S if reached else 0.0
        full = min(specific_force(train.traction_limit(v), train.mass), (m * ACCELERATION + w) / scale)
        afterwards = max(0.0, w / scale) if manoeuvre.held_s > 0.0 else 0.0
        change = min(max((afterwards if reached else full) - traction, -JERK * m * STEP_S), JERK * m * STEP_S)
        mean, traction = traction + 0.5 * change, traction + change
        v = max(0.0, v + STEP_S / m * (scale * mean - w))
        steps.append(Step(v, mean, change / STEP_S))
        if len(steps) * STEP_S > _MAX_RUN_S or (v == 0.0 and reached):
            return None
    braking = _braking(v, train_file, davis)
    if braking is None:
        return None
    return Run(manoeuvre, tuple(steps), braking)


def _braking(v: float, train_file: TrainFile, davis: Davis) -> tuple[float, ...] | None:
    """Return the speeds of the braking to a stop from a speed [m/s]; None if it takes too long."""
    brake, m = train_file.brake, specific_inertia(1.0, train_file.train.rotary_mass)
    target, speeds = 0.0, list[float]()
    while v > 0.0:
        command = -DECELERATION if STEP_S * len(speeds) >= brake.delay else 0.0
        target = lag_response(target, command, brake.time_constant, STEP_S)
        w = davis.a + v * (davis.b + v * davis.c)
        v = max(0.0, v + STEP_S * (brake.rate_at(v) * target - w / m))
        speeds.append(v)
        if STEP_S * len(speeds) > _MAX_RUN_S:
            return None
    return tuple(speeds)


# Maximum number of repetitions of a run.
_MAX_TIMES: Final = 3
# Largest useful ratio of the standard deviations after and before a drive [1].
_MAX_STD_RATIO: Final = 0.9
# Smallest relative reduction of the standard deviation that justifies a longer drive [1].
_MIN_REDUCTION: Final = 0.03
# Tolerance of a standard deviation, as a multiple of its limit or of the present one [1].
_TOLERANCE: Final = 1.05


@dataclass(frozen=True, slots=True)
class Wanted:
    """A quantity that should be known."""

    name: str  # as in tables
    unit: str
    std: Callable[[Any], float]  # returns its standard deviation in an estimate [unit]
    limit: float  # standard deviation up to which it is known [unit]


@dataclass(frozen=True, slots=True)
class Promise:
    """Standard deviations of a quantity before and after a drive."""

    wanted: Wanted  # the quantity, with the limit
    now: float  # before the drive [unit]
    then: float  # after the drive [unit]

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

    run: Run  # One run of it
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
        times = {1: 'once', 2: 'twice'}.get(self.times, f'{self.times} times')
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
            'std': {
                wanted.name: {'unit': wanted.unit, 'now': item.now, 'then': item.then, 'wanted': wanted.limit}
                for item, wanted in ((item, item.wanted) for item in self.promises)
            },
        }


@runtime_checkable
class ForeseeingEstimator(Protocol):
    """Estimator that can foresee its uncertainty: the filter bank, V-MILS and GSMA."""

    @property
    def config(self) -> Any:
        """Settings."""

    @property
    def converged(self) -> bool:
        """True while the estimate is fit for use."""

    def foreseen(self, run: Run, times: int) -> Iterator[Any]:
        """Yield the mean estimates after one, two, ... of a number of runs, each from a stop."""


def suggested_drive(
    estimator: object, train_file: TrainFile, prior: ResistanceEstimate, now: ResistanceEstimate
) -> SuggestedDrive | None:
    """Return the shortest drive that makes known what is not of the resistance, as far as any drive does.

    ``prior`` is the estimate before the first sample, ``now`` the present one. None if all is known, if nothing was
    learned yet, if no drive would help, or if the estimator cannot foresee it.
    """
    if not isinstance(estimator, ForeseeingEstimator) or not now.speed_max > 0.0:
        return None
    config = estimator.config
    quantities = tuple(_quantities(train_file, prior, now, config.valid_std, config.valid_share))
    scale = now.force_scale if now.force_scale > 0.1 else 1.0  # it may be NaN or implausible
    runs = planned_runs(train_file, Davis(now.a, now.b, now.c), scale)
    return _best_drive(quantities, now, runs, estimator.foreseen)


def suggested_braking(estimator: object, train_file: TrainFile, now: BrakeRateEstimate) -> SuggestedDrive | None:
    """Return the shortest drive with brakings that make the brake rate valid, as far as any does.

    None if it is valid at present, if nothing was measured yet, if the train file is wrong, if no braking would help,
    or if the estimator cannot foresee it.
    """
    if not isinstance(estimator, ForeseeingEstimator) or estimator.converged:
        return None
    wanted = Wanted('brake rate', '', attrgetter('brake_rate_std'), estimator.config.valid_std)
    starts = (_round(share * top_speed(train_file)) for share in _STARTS)
    brakings = (Manoeuvre(start, start, braking=-DECELERATION) for start in starts)
    runs = (plan_run(braking, train_file, train_file.resistance) for braking in brakings)
    fitting = (run for run in runs if run is not None and _fits(run, train_file))
    return _best_drive((wanted,), now, fitting, estimator.foreseen)


def _best_drive(
    quantities: Sequence[Wanted], now: object, runs: Iterable[Run], foreseen: Callable[[Run, int], Iterable[object]]
) -> SuggestedDrive | None:
    """Return the shortest drive of these runs that makes known what is not, None if all is known or none would help.

    A longer drive must be better. What counts is the quantity that is least known after the drive, of those that at
    least one drive makes known; or of those that are not known if none does.
    """
    before = [Promise(wanted, wanted.std(now), wanted.std(now)) for wanted in quantities]
    unknown = {k for k, item in enumerate(before) if item.now > item.wanted.limit}
    if not unknown:
        return None
    drives: list[tuple[Run, int, tuple[Promise, ...]]] = []
    for run in runs:
        for times, then in enumerate(foreseen(run, _MAX_TIMES), 1):
            promises = tuple(Promise(item.wanted, item.now, item.wanted.std(then)) for item in before)
            if not any(promise.is_worse for promise in promises):
                drives.append((run, times, promises))
    drives.sort(key=lambda drive: drive[1] * drive[0].duration_s)
    reached = {k for k in range(len(before)) if any(promises[k].ratio <= 1.0 for _, _, promises in drives)}
    counted = reached if reached & unknown else unknown
    best, least = None, math.inf
    for drive in drives:
        ratio = max(drive[2][k].ratio for k in counted)
        if best is None or ratio < (1.0 - _MIN_REDUCTION) * least:
            best, least = drive, ratio
        if least <= 1.0:
            break
    if best is None:
        return None
    run, times, promises = best
    least_known = max((promises[k] for k in sorted(counted)), key=attrgetter('before'))
    is_useful = least_known.then < _MAX_STD_RATIO * least_known.now
    return SuggestedDrive(run, times, least_known, promises) if is_useful else None


def _quantities(
    train_file: TrainFile, prior: ResistanceEstimate, now: ResistanceEstimate, valid_std: float, valid_share: float
) -> Iterator[Wanted]:
    """Yield what should be known: a, b and c as :func:`observe` demands, w up to the top speed, and the force scale."""
    units = ('N/kN', 'N/kN per m/s', 'N/kN per (m/s)^2')
    left = math.sqrt(1.0 - SEEN_SHARE)
    for k, (name, unit) in enumerate(zip('abc', units, strict=True)):
        yield Wanted(name, unit, partial(_parameter, k), left * _parameter(k, prior))
    for share in (0.25, 0.5, 0.75, 1.0):
        v = share * top_speed(train_file)
        w = now.a + v * (now.b + v * now.c)
        yield Wanted(f'w at {v * KM_H:.0f} km/h', 'N/kN', partial(_at, v), math.hypot(valid_std, valid_share * w))
    if not math.isnan(prior.force_scale_std):
        yield Wanted('force scale', '', attrgetter('force_scale_std'), max(0.01, left * prior.force_scale_std))


# Functions of the module, so that a drive can be sent to another process.
def _parameter(k: int, estimate: ResistanceEstimate) -> float:
    return math.sqrt(max(0.0, estimate.covariance[4 * k]))


def _at(v: float, estimate: ResistanceEstimate) -> float:
    return resistance_std(estimate.covariance, v)
