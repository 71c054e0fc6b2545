# SPDX-License-Identifier: Apache-2.0
"""Data for estimators of the brake rate: the experiment of Zheng et al. 2015, and a metro train at 5 Hz.

The metro train has realistic errors: the gradient map is wrong by 2 per mille with a correlation length of 200 m, the
running resistance by 10 %, the wheel diameter by 0.5 %, speed has a resolution of 0.1 km/h, and the dead time of the
brake is 1.2 s. Train file and samples contain only what the estimators are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import BrakeCommandChange, G, lag_integral, lag_response
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

Array = NDArray[np.float64]

DT: Final = 0.2
MAP_ERROR: Final = 0.02
_LAG: Final = 6
_START_NS: Final = 1_700_000_000 * NS_PER_S
_MAP_LENGTH: Final = 200.0
_STEEPEST: Final = 25.0
_RESISTANCE_ERROR: Final = 0.1
_WHEEL_ERROR: Final = 0.005
_QUANTUM: Final = 0.1 / 3.6
_SPEED_NOISE: Final = 0.02
_POSITION_NOISE: Final = 0.03
_WHITE: Final = 0.002
_WALK: Final = 0.003
_POWER: Final = 0.9
_DWELL_S: Final = 25.0
_STANDING: Final = 0.2
# Range of the commanded deceleration [m/s^2].
_LEVELS: Final = (0.3, 1.2)
# Longest duration of a phase that ends by speed [s].
_MAX_PHASE_S: Final = 200.0


def metro_train() -> TrainFile:
    """Return the train file given to the estimators."""
    return TrainFile(Train(200e3, 0.08, 118.0), Davis(1.5, 0.03, 0.004), Brake(1.0, 0.4, _LAG * DT))


class Kind(Enum):
    """Phase of driving."""

    POWER = 'power'
    COAST = 'coast'
    CRUISE = 'cruise'
    BRAKE = 'brake'
    DWELL = 'dwell'


@dataclass(frozen=True, slots=True)
class Phase:
    """A part of a run, until ``seconds`` [s] have passed or, under power, ``speed`` [m/s] is reached.

    A brake phase ends near standstill. Without a ``level`` [m/s^2] it draws one, and a new one every 15 to 30 s.
    """

    kind: Kind
    seconds: float = _MAX_PHASE_S
    speed: float = 0.0
    level: float = math.nan


@dataclass(frozen=True, slots=True)
class BrakeRun:
    """Samples of one drive and the truth at each."""

    samples: tuple[Sample, ...]  # Input of the estimators
    rate: Array  # True brake rate [1]
    speed: Array  # True speed [m/s]
    braked_s: Array  # Time since the first brake command of this phase [s], NaN in other phases
    phase: NDArray[np.intp]  # Index of the phase


# Brake rate [1] as a function of the time in a phase [s], its index and the previous rate.
Rate = Callable[[float, int, float], float]


def metro_run(seed: int, stops: int = 5) -> BrakeRun:
    """Return a drive with several stops; f starts in 0.75 to 1.05 and is a random walk of 0.003 per sqrt(s)."""
    rng = np.random.default_rng([seed, 2015])
    plan = [phase for _ in range(stops) for phase in _stop(rng)]
    return _drive(rng, plan, _walk(rng), float(rng.uniform(0.75, 1.05)))


def hard_run(seed: int, stops: int = 5) -> BrakeRun:
    """Return the same with one level per braking, held until standstill: weak braking is long and uninformative."""
    rng = np.random.default_rng([seed, 2016])
    plan: list[Phase] = []
    for _ in range(stops):
        power, coast, brake, dwell = _stop(rng)
        plan += [power, coast, replace(brake, level=-float(rng.uniform(*_LEVELS))), dwell]
    return _drive(rng, plan, _walk(rng), float(rng.uniform(0.75, 1.05)))


def walk_run(seed: int, drift: float = _WALK, stops: int = 5) -> BrakeRun:
    """Return a drive by the model of the estimators: exact train file, f(0) ~ N(1, 0.2^2), then a random walk."""
    rng = np.random.default_rng([seed, 1985])
    plan = [phase for _ in range(stops) for phase in _stop(rng)]
    start = float(np.clip(1.0 + 0.2 * rng.standard_normal(), 0.5, 1.5))
    return _drive(rng, plan, _walk(rng, drift), start, exact=True)


def unbraked_run(seed: int, seconds: float = 240.0) -> BrakeRun:
    """Return two stops with f = 0.95, a cruise in which f falls unobserved to 0.80, and a third braking."""
    rng = np.random.default_rng([seed, 240])
    plan = [*_stop(rng), *_stop(rng), Phase(Kind.POWER, speed=18.0), Phase(Kind.CRUISE, seconds), Phase(Kind.BRAKE)]
    cruise = len(plan) - 2

    def rate(t: float, k: int, _before: float) -> float:
        fallen = 0.0 if k < cruise else min(1.0, t / seconds) if k == cruise else 1.0
        return 0.95 - 0.15 * fallen

    return _drive(rng, plan, rate, 0.95)


def jump_run(seed: int, jump: float = -0.25) -> BrakeRun:
    """Return two stops, and a third braking of 0.45 m/s^2 from 25 m/s in which f jumps after 12 s."""
    rng = np.random.default_rng([seed, 25])
    plan = [*_stop(rng), *_stop(rng), Phase(Kind.POWER, speed=25.0), Phase(Kind.BRAKE, level=-0.45)]
    walk = _walk(rng)

    def rate(t: float, k: int, before: float) -> float:
        now = walk(t, k, before)
        return now + jump if k == len(plan) - 1 and abs(t - JUMP_AFTER_S) < 0.5 * DT else now

    return _drive(rng, plan, rate, float(rng.uniform(0.85, 1.05)))


JUMP_AFTER_S: Final = 12.0


def _stop(rng: np.random.Generator) -> tuple[Phase, Phase, Phase, Phase]:
    power = Phase(Kind.POWER, speed=float(rng.uniform(16.0, 22.0)))
    return power, Phase(Kind.COAST, float(rng.uniform(15.0, 40.0))), Phase(Kind.BRAKE), Phase(Kind.DWELL, _DWELL_S)


def _walk(rng: np.random.Generator, drift: float = _WALK) -> Rate:
    return lambda _t, _k, before: before + drift * math.sqrt(DT) * float(rng.standard_normal())


@dataclass(slots=True)
class _Train:
    """The true train and its track, advanced by one sample per step."""

    rng: np.random.Generator
    resistance: float
    map_error: float
    v: float = 0.0
    position: float = 0.0
    brake: float = 0.0
    gradient: float = 0.0
    gradient_until: float = 0.0
    error: float = 0.0

    def step(self, traction: float, delayed: float, f: float) -> None:
        """Advance by one sample; traction and delayed command [m/s^2], brake rate f [1]."""
        train, rng = metro_train(), self.rng
        if self.position >= self.gradient_until:
            self.gradient = float(rng.uniform(-_STEEPEST, _STEEPEST))
            self.gradient_until = self.position + float(rng.uniform(200.0, 500.0))
        rho = math.exp(-self.v * DT / _MAP_LENGTH)
        self.error = rho * self.error + self.map_error * math.sqrt(1.0 - rho * rho) * float(rng.standard_normal())
        w = train.resistance
        drag = self.resistance * (w.a + w.b * self.v + w.c * self.v**2)
        other = traction + self.error - (self.gradient + drag) * G / (1000.0 * (1.0 + train.train.rotary_mass))
        tau = train.brake.time_constant
        gained = other * DT + lag_integral(self.brake, f * delayed, tau, DT)
        self.brake = lag_response(self.brake, f * delayed, tau, DT)
        white = _WHITE * math.sqrt(DT) * float(rng.standard_normal())
        after = max(0.0, self.v + gained + (white if self.v > 0.0 else 0.0))
        self.position += 0.5 * DT * (self.v + after)
        self.v = after


def _drive(
    rng: np.random.Generator, plan: Sequence[Phase], rate: Rate, first: float, *, exact: bool = False
) -> BrakeRun:
    """Drive a plan; ``exact``: the train file has no errors and the speed is not quantised."""
    error = 0.0 if exact else 1.0
    train = _Train(rng, 1.0 + error * _RESISTANCE_ERROR * float(rng.standard_normal()), MAP_ERROR)
    scale = 1.0 + error * _WHEEL_ERROR * float(rng.standard_normal())
    mass = metro_train().train.mass * (1.0 + metro_train().train.rotary_mass)
    samples: list[Sample] = []
    truth, commands, f, drift = [], [0.0] * (_LAG + 1), first, 0.0
    command = gradient = pull = 0.0
    for k, phase in enumerate(plan):
        t, until = 0.0, 0.0
        while t < phase.seconds - 0.5 * DT:
            if phase.kind is Kind.BRAKE and t >= until:
                level = phase.level if math.isfinite(phase.level) else -float(rng.uniform(*_LEVELS))
                until = t + (_MAX_PHASE_S if math.isfinite(phase.level) else float(rng.uniform(15.0, 30.0)))
            wanted = level if phase.kind is Kind.BRAKE else command if phase.kind is Kind.DWELL else 0.0
            stamp_ns = _START_NS + len(samples) * round(DT * NS_PER_S)
            changes = (BrakeCommandChange(stamp_ns, wanted),) if wanted != command or not samples else ()
            command = wanted
            drift += _POSITION_NOISE * math.sqrt(DT) * float(rng.standard_normal())
            noisy = scale * train.v + _SPEED_NOISE * float(rng.standard_normal())
            measured = noisy if exact else _QUANTUM * round(noisy / _QUANTUM)
            speed = max(0.0, measured) if train.v > 0.0 else 0.0
            sample = coasting_sample(stamp_ns, DT if samples else math.nan, speed)
            sample.position = train.position + drift
            sample.force = sample.force_mean = pull * mass
            sample.gradient = sample.gradient_mean = gradient
            sample.brake_command, sample.brake_changes = command, changes
            samples.append(sample)
            truth.append((f, train.v, t if phase.kind is Kind.BRAKE else math.nan, k))
            commands = [*commands[1:], command]
            pull = _pull(phase, train)
            f = rate(t, k, f)
            train.step(pull, commands[0], f)
            gradient = train.gradient
            t += DT
            if _reached(phase, train.v):
                break
    rows = np.array(truth)
    return BrakeRun(tuple(samples), rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3].astype(np.intp))


def _pull(phase: Phase, train: _Train) -> float:
    """Return the traction of the driver [m/s^2]."""
    if phase.kind is Kind.POWER:
        return _POWER
    if phase.kind is Kind.CRUISE:
        return min(_POWER, max(0.0, 0.3 * (18.0 - train.v) + 0.05))
    return 0.0


def _reached(phase: Phase, v: float) -> bool:
    return (phase.kind is Kind.POWER and v >= phase.speed) or (phase.kind is Kind.BRAKE and v < _STANDING)
