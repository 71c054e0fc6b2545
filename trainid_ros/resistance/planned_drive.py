# SPDX-License-Identifier: Apache-2.0
"""Drives that could be made to learn more about a train, planned with what is known of it.

A drive starts at a stop, on level track: full traction, then coasting or holding the speed, then braking, from which no
resistance is learned. Speeds follow ``m dv/dt = kappa T - a - b v - c v^2`` with the reported specific traction T
[N/kN], its scale kappa [1] and m = 1000 (1 + gamma) / g.

The recursion of a bank of hypotheses over planned runs gives what it would know after them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.state import encode, restore
from trainid_ros.interface.vectors import vec
from trainid_ros.resistance.hypotheses import Bank, Mixture
from trainid_ros.resistance.speed_states import Interval
from trainid_ros.train.forces import lag_response, specific_force, specific_inertia
from trainid_ros.train.line import LineProfile

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from trainid_ros.resistance.hypotheses import Array
    from trainid_ros.train.train_file import Davis, TrainFile

KM_H: Final = 1.0 / 3.6
"""One kilometre per hour [m/s]."""
STEP_S: Final = 0.4
"""Duration of a step of a plan [s]."""
# Traction of a service start: limits of acceleration [m/s^2] and jerk [m/s^3]. Brake command to the stop [m/s^2].
ACCELERATION: Final = 0.9
JERK: Final = 0.8
DECELERATION: Final = 0.6
# Shortest run with enough data for a prediction, and longest practicable run or braking [s].
_MIN_RUN_S: Final = 60.0
_MAX_RUN_S: Final = 900.0
# Length of a run where the train file names no stops [m].
_MAX_RUN_M: Final = 10e3
# Tolerance of a controller at a speed limit [m/s].
_LIMIT_TOLERANCE: Final = 0.5
# Speeds at which coasting or holding begins, as shares of the top speed; coasting ends at these shares of that speed.
_STARTS: Final = (1.0, 0.7, 0.45)
_ENDS: Final = (0.85, 0.7, 0.5, 0.3)
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
            return f'coast from {self.start / KM_H:.0f} to {self.end / KM_H:.0f} km/h'
        if self.braking < 0.0:
            return f'brake from {self.start / KM_H:.0f} km/h with {self.braking:g} m/s²'
        if self.held_s > 0.0:
            return f'hold {self.start / KM_H:.0f} km/h for {self.held_s:.0f} s'
        return f'accelerate with full traction to {self.start / KM_H:.0f} km/h'


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

        Args:
            settling_s: Time that the brake takes to release, from the start [s].
            slowest: Slowest speed to learn from [m/s].
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


def planned_brakings(train_file: TrainFile) -> Iterator[Run]:
    """Yield runs that fit on the line, for the braking to the stop; resistance as in the train file."""
    for share in _STARTS:
        start = _round(share * top_speed(train_file))
        run = plan_run(Manoeuvre(start, start, braking=-DECELERATION), train_file, train_file.resistance)
        if run is not None and _fits(run, train_file):
            yield run


def _fits(run: Run, train_file: TrainFile) -> bool:
    """Return whether there is room for a run between two stops, where the speed limits allow it."""
    line, length = train_file.line, run.length_m
    if not line.stops:
        return length <= _MAX_RUN_M
    profile = LineProfile(line, train_file.train.length)
    for stop, following in pairwise(line.stops):
        # A limit ends when the rear of the train has passed it.
        ends = (position + train_file.train.length for position, _ in line.speed_limit)
        begins = (begin for begin in (stop, *ends) if stop <= begin <= following - length)
        if any(_is_allowed(run, begin, profile) for begin in begins):
            return True
    return False


def _is_allowed(run: Run, begin: float, profile: LineProfile) -> bool:
    """Return whether a run from a position [m] on exceeds no speed limit."""
    position = begin
    for speed in run.speeds:
        position += STEP_S * speed
        if speed > profile.speed_limit(position, 1) + _LIMIT_TOLERANCE:
            return False
    return True


def top_speed(train_file: TrainFile) -> float:
    """Return the highest speed of train and line in whole steps of 5 km/h [m/s]."""
    limits = [limit for _, limit in train_file.line.speed_limit]
    fastest = min(train_file.train.max_speed, max(limits, default=math.inf))
    return max(1.0, math.floor(fastest / (5.0 * KM_H) + 1e-6)) * 5.0 * KM_H


def _manoeuvres(top: float) -> Iterator[Manoeuvre]:
    for share in _STARTS:
        start = _round(share * top)
        yield Manoeuvre(start, start)
        yield from (Manoeuvre(start, end) for part in _ENDS if 0.0 < (end := _round(part * start)) < start)
        yield from (Manoeuvre(start, start, held_s) for held_s in _HELD_S)


def _round(speed: float) -> float:
    return round(speed / (5.0 * KM_H)) * 5.0 * KM_H


def plan_run(manoeuvre: Manoeuvre, train_file: TrainFile, davis: Davis, force_scale: float = 1.0) -> Run | None:
    """Return a run; None if the train does not do it within a practicable time.

    Args:
        manoeuvre: What the driver does.
        train_file: Train and line.
        davis: Resistance.
        force_scale: Actual over reported traction [1].
    """
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


# Step of the traction interpolation [s].
_SPACING_S: Final = 0.2


def usual_deviations(run: Run, times: int) -> Array:
    """Return innovations over their standard deviations, shape (2, times, steps): two sequences, one the other negated.

    How soon a step can be excluded that may just have happened depends on them.
    """
    one = np.random.default_rng(times).standard_normal((times, len(run.steps)))
    return np.stack([one, -one])


def foreseen_mixtures(
    now: Bank, run: Run, deviations: Array, first: int, slowest: float, variances: tuple[float, float]
) -> Iterator[Mixture]:
    """Yield the mixture after each of some runs from a stop.

    Args:
        now: The bank, which stays as it is.
        run: The run, driven once or more.
        deviations: Innovations over their standard deviations, shape (runs, steps).
        first: Index of the first step from which is learned, at least 1.
        slowest: Speed at which the train is taken to stop [m/s].
        variances: Variance of the speed at the end of a step [(m/s)^2], and that by which the force scale may change
            at a stop [1].
    """
    bank, (speed_variance, scale_variance) = Bank(now.plan), variances
    restore(bank, encode(now))
    for row in deviations.tolist():
        bank.inflate_force_scale_variance(scale_variance)
        bank.restart(run.steps[first - 1].speed, speed_variance)
        for step, deviation in zip(run.steps[first:], row[first:], strict=True):
            if not bank.simulate_step(_planned(step, speed_variance), deviation, slowest):
                break
        yield bank.mixture(bank.plan.young_weight)


def mean_covariance(mixtures: Sequence[Mixture]) -> vec[float]:
    """Return the mean of the covariances of mixtures, 15 numbers."""
    columns = zip(*(mixture.covariance for mixture in mixtures), strict=True)
    return vec[float](np.mean(list(columns), axis=1).tolist())


def _planned(step: Step, variance: float) -> Interval:
    """Return a planned step as an interval; ``variance`` is that of the speed at its end [(m/s)^2]."""
    T, change = step.traction, step.ramp * _SPACING_S
    return Interval(
        dt=STEP_S,
        traction=(T - change, T, T + change, T + 2.0 * change),
        track=0.0,
        curve=0.0,
        speed=step.speed,
        speed_variance=variance,
        spacing=_SPACING_S,
        force_interval=_SPACING_S,
    )
