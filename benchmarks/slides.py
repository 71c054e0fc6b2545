# SPDX-License-Identifier: Apache-2.0
"""Drives on rails with patches of low adhesion: sliding wheels, wheel slide protection, and what the axle shows.

Between wheel and rail a train transmits at most the adhesion of the place times its weight. What the brake asks for
beyond that makes the measured axle run away from the train, until the wheel slide protection lets it come back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table
from trainid_ros.client import TrainModel
from trainid_ros.estimators.pipeline import PipelineGroup
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.records import Record, SpeedRecord
from trainid_ros.interface.results import AdhesionEstimate, Output
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.sim.plant import TICK_S, Decision, Driver, Plant
from trainid_ros.sim.scenario import Scenario, TrainDriver, simulate
from trainid_ros.sim.worlds import WORLDS, world_train
from trainid_ros.train.forces import G
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import TrainFile

_AXLE: Final = 4.0
"""Acceleration of an axle that runs away or comes back [m/s^2]."""


@dataclass(frozen=True, slots=True)
class Patch:
    """Low adhesion on a part of the line."""

    start: float  # Where it begins [m]
    end: float  # Where it ends [m]
    adhesion: float  # Adhesion there, over the weight of the train [1]


@dataclass(frozen=True, slots=True)
class Moment:
    """The truth at one tick."""

    stamp_ns: int  # Time [ns]
    speed: float  # Speed of the train [m/s]
    axle: float  # Speed of the axle [m/s]
    adhesion: float  # Adhesion at the place [1], infinite outside of patches
    train: Plant  # A copy of the train


class SlidingDriver:
    """The driver of a scenario on rails with patches of low adhesion."""

    def __init__(self, driver: TrainDriver, plant: Plant, patches: Sequence[Patch], rng: np.random.Generator) -> None:
        self._driver, self._plant, self._patches, self._rng = driver, plant, patches, rng
        self._rate, self._slip, self._target, self._returns = plant.brake_rate, 0.0, 0.0, False
        self.moments: list[Moment] = []
        self.arrivals, self.stop = driver.arrivals, driver.stop

    def observe(self, record: Record) -> None:
        self._driver.observe(record)

    def may_depart(self, time_s: float) -> bool:
        return self._driver.may_depart(time_s)

    def depart(self, stop: float) -> None:
        self._driver.depart(stop)
        self.stop = stop

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Limit the brake by the adhesion, and let the axle run away where that is less."""
        adhesion = adhesion_at(self._patches, train.position)
        is_sliding = limit_brake(train, self._rate, adhesion)
        if not is_sliding or train.speed < 1.0:
            self._target, self._returns = 0.0, True
        elif self._target == 0.0 or (self._slip >= self._target and not self._returns):
            self._returns = self._target > 0.0
            self._target = self._target or float(self._rng.uniform(0.08, 0.25)) * train.speed
        elif self._returns and self._slip < 0.3 * self._target:
            self._target, self._returns = float(self._rng.uniform(0.08, 0.25)) * train.speed, False
        step = _AXLE * TICK_S
        self._slip = max(0.0, self._slip - step) if self._returns else min(self._target, self._slip + step)
        self._slip = min(self._slip, train.speed)
        self.moments.append(Moment(train.now_ns, train.speed, train.speed - self._slip, adhesion, train.twin()))
        return self._driver.decide(time_s, train)


def adhesion_at(patches: Sequence[Patch], position: float) -> float:
    """Return the adhesion at a position [m]; infinite outside of patches."""
    return min((patch.adhesion for patch in patches if patch.start <= position < patch.end), default=np.inf)


def limit_brake(train: Plant, rate: float, adhesion: float) -> bool:
    """Limit the brake rate of a train by the adhesion; return whether that is less than what the brake asks for."""
    most = adhesion * G / (1.0 + train._train.rotary_mass)
    asked = -rate * train._brake.shape_at(train.speed) * train.brake
    train.brake_rate = rate if asked <= most else rate * most / asked
    return asked > most


@dataclass(frozen=True, slots=True)
class SlideDrive:
    """A drive with what its axle showed, and the truth."""

    records: tuple[Record, ...]
    moments: tuple[Moment, ...]


def drive_with_slides(scenario: Scenario, patches: Sequence[Patch], rng: np.random.Generator) -> SlideDrive:
    """Drive a scenario over patches of low adhesion; the axle's speed and distance take the place of the train's."""
    made: list[SlidingDriver] = []
    slides = rng.spawn(1)[0]

    def make(plant: Plant, drive: np.random.Generator) -> TrainDriver:
        file = scenario.train_file
        driver = Driver(scenario.driver, scenario.stated or file, profile_of(file), drive)
        made.append(SlidingDriver(driver, plant, patches, slides))
        return made[0]

    simulation = simulate(scenario, rng, make)
    moments = made[0].moments
    stamps = np.array([moment.stamp_ns for moment in moments], dtype=np.float64)
    lag = np.array([moment.speed - moment.axle for moment in moments])
    records: list[Record] = []
    lost_m, before_ns = 0.0, 0
    for record in simulation.records:
        if isinstance(record, SpeedRecord):
            slip = float(np.interp(record.stamp_ns, stamps, lag))
            lost_m = lost_m + slip * (record.stamp_ns - before_ns) * 1e-9 if before_ns else 0.0
            before_ns = record.stamp_ns
            if record.speed == 0.0:
                lost_m = 0.0
            record = replace(record, speed=max(0.0, record.speed - slip), position=record.position - lost_m)  # noqa: PLW2901
        records.append(record)
    return SlideDrive(tuple(records), tuple(moments))


def leaf_season(scenario: Scenario, rng: np.random.Generator, share: float = 0.3) -> tuple[Patch, ...]:
    """Return patches before a share of the stops, with the length of a braking and the adhesion of wet leaves."""
    patches = []
    for stop in scenario.train_file.line.stops:
        if rng.random() < share:
            length, ahead = float(rng.uniform(100.0, 400.0)), float(rng.uniform(0.0, 100.0))
            for side in (-1.0, 1.0):
                ends = sorted((stop + side * ahead, stop + side * (ahead + length)))
                patches.append(Patch(ends[0], ends[1], float(rng.uniform(0.03, 0.07))))
    return tuple(patches)


# Bounds of the stopping distance

_LINES: Final = (('metro', 8), ('emu', 4), ('tram', 12))
# Seeds from here on were not used during development.
_FIRST_SEED: Final = 9401
_COMMAND: Final = -0.9
"""Brake command of the bounds [m/s^2]."""
_EVERY: Final = 10  # moments between two bounds
_MIN_SPEED: Final = 5.0  # m/s
_NEAR_M: Final = 1000.0  # m behind a slide that count as near it
_LONGEST_S: Final = 300.0  # s: no stop takes longer
_WHEN: Final = ('in a slide', 'after a slide', 'elsewhere')


@dataclass(frozen=True, slots=True)
class Trial:
    world: str
    runs: int
    seed: int


@dataclass(frozen=True, slots=True)
class Bound:
    """A bound where the train is, with the adhesion and without."""

    when: str  # One of _WHEN
    with_adhesion: float  # Bound of the client [m], infinite if it refuses
    without: float  # The same without estimates of the adhesion
    distance: float  # Distance in which the train stops [m]


@dataclass(frozen=True, slots=True)
class Outcome:
    bounds: tuple[Bound, ...]
    found: int  # Samples that slip by more than 0.3 m/s, and are found to slip
    slipped: int  # Those that do
    false: int  # Those that do not and have not in the last 5 s, but are found to slip
    samples: int
    # Adhesion after each slide, less the true one, in standard deviations
    errors: tuple[float, ...]


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the tables over as many drives on each of the lines."""
    trials = [Trial(world, runs, _FIRST_SEED + k) for world, runs in _LINES for k in range(seeds)]
    outcomes = over_seeds(run, trials, 'slides')
    rows = []
    for world, _ in _LINES:
        of_world = [outcome for trial, outcome in zip(trials, outcomes, strict=True) if trial.world == world]
        bounds = [bound for outcome in of_world for bound in outcome.bounds]
        for when in _WHEN:
            chosen = [bound for bound in bounds if bound.when == when]
            if chosen:
                rows.append((world, when, str(len(chosen)), *_shares([(b.without, b.distance) for b in chosen]),
                             *_shares([(b.with_adhesion, b.distance) for b in chosen])))  # fmt: skip
    found, slipped, false, samples = (
        sum(getattr(outcome, name) for outcome in outcomes) for name in ('found', 'slipped', 'false', 'samples')
    )
    errors = np.array([error for outcome in outcomes for error in outcome.errors])
    held = ('held before', 'margin before', 'held', 'margin', 'refused')
    return (
        Table(
            'Bounds of the stopping distance on slippery rails',
            ('line', 'where', 'bounds', *held[:2], 'refused before', *held[2:]),
            tuple(rows),
            'Bounds at 95 % confidence every 2 s above 5 m/s, against the distance in which a copy of the train stops '
            'that keeps a brake command of -0.9 m/s^2 on the same rails. Before: without the adhesion. The client is '
            'given the measured speed over 1 + slip. After a slide: the train has slid in the last km. Refused: no '
            'bound is stated; these do not count as held. Margin: median of bound over distance, less 1.',
        ),
        Table(
            'Slides found',
            ('samples', 'slip', 'found', 'false', 'slides', 'mean, std', 'beyond 2 std'),
            (
                (
                    str(samples),
                    str(slipped),
                    f'{found / max(slipped, 1):.1%}',
                    f'{false / samples:.3%}',
                    str(errors.size),
                    f'{errors.mean():+.2f}' if errors.size else '-',
                    f'{np.mean(np.abs(errors) > 2.0):.0%}' if errors.size else '-',
                ),
            ),
            'Slip: samples whose axle is off by more than 0.3 m/s. False: found 5 s or more after the last of them. '
            'The last columns compare the adhesion at the last sample of a slide with the mean of the true one.',
        ),
    )


def _shares(pairs: Sequence[tuple[float, float]]) -> tuple[str, str, str]:
    stated = [(bound, distance) for bound, distance in pairs if np.isfinite(bound)]
    if not stated:
        return '-', '-', f'{1.0:.0%}'
    held = np.mean([distance <= bound for bound, distance in stated])
    margin = float(np.median([bound / distance for bound, distance in stated])) - 1.0
    return f'{held:.1%}', f'{margin:+.0%}', f'{1.0 - len(stated) / len(pairs):.1%}'


def run(trial: Trial) -> Outcome:
    """Drive a trial with estimators and two clients."""
    world, rng = WORLDS[trial.world], np.random.default_rng(trial.seed)
    train_file = world_train(world)
    scenario = Scenario(train_file, trial.runs, passengers=world.passengers, driver=world.driver)
    patches = leaf_season(scenario, rng)
    drive, settings, now = drive_with_slides(scenario, patches, rng), EstimatorSettings(), [0.0]
    pipelines = (resistance_pipeline(train_file, settings), brake_rate_pipeline(train_file, settings))
    clients = tuple(TrainModel(None, train_file, clock=lambda: now[0]) for _ in range(2))
    group, bounds, newest = PipelineGroup(pipelines), list[Bound](), pipelines[1].adhesion()
    errors, off, slid_m, before = list[float](), list[float](), np.inf, drive.moments[0]
    counts, quiet = {'found': 0, 'slipped': 0, 'false': 0, 'samples': 0}, 0.0

    def take(output: Output[Any]) -> None:
        nonlocal newest
        clients[0].take(output)
        if isinstance(output.estimate, AdhesionEstimate):
            newest = output
        else:
            clients[1].take(output)

    records = iter(drive.records)
    record = next(records, None)
    was = newest.estimate
    for k, moment in enumerate(drive.moments):
        while record is not None and record.stamp_ns <= moment.stamp_ns:
            now[0] = record.stamp_ns * 1e-9
            group.push_rows((record.row(),), take)
            record = next(records, None)
        estimate, slips = newest.estimate, before.speed - before.axle > 0.3  # the estimate is of the sample before
        is_found = estimate.slipping
        slid_m = 0.0 if slips else slid_m + moment.speed * TICK_S
        quiet = 0.0 if slips else quiet + TICK_S
        counts['samples'] += 1
        counts['slipped'] += slips
        counts['found'] += slips and is_found
        counts['false'] += is_found and quiet > 5.0
        if slips and np.isfinite(before.adhesion):
            off.append(before.adhesion)
        if was.slipping and not is_found and off:
            errors.append((was.adhesion - float(np.mean(off))) / was.adhesion_std)
            off = []
        was, before = estimate, moment
        if k % _EVERY == 0 and moment.speed > _MIN_SPEED:
            when = _WHEN[0] if slips else _WHEN[1] if slid_m < _NEAR_M else _WHEN[2]
            with_adhesion = _bound(clients[0], train_file, moment.train, moment.axle / (1.0 + estimate.slip))
            without = _bound(clients[1], train_file, moment.train, moment.axle)
            bounds.append(Bound(when, with_adhesion, without, _stop(moment.train.twin(), patches)))
    return Outcome(tuple(bounds), **counts, errors=tuple(errors))


def _bound(client: TrainModel, train_file: TrainFile, train: Plant, speed: float) -> float:
    """Return the bound of a client on the true gradient halfway to the stop [m], infinite if it refuses."""
    ahead = train.position + train.direction * 0.5 * speed * speed / 1.6
    gradient = profile_of(train_file).gradient(ahead, train.direction)
    try:
        return client.stopping_distance(speed, gradient, _COMMAND, applied=min(train.brake, 0.0)).value
    except NoAnswerError:
        return np.inf


def _stop(train: Plant, patches: Sequence[Patch]) -> float:
    """Return the distance [m] in which a train stops with the brake command."""
    begin, rate = train.distance_run, train._brake.rate
    train.command(_COMMAND)
    train.traction = 0.0  # bounds do not count traction that still acts
    for _ in range(round(_LONGEST_S / 0.02)):
        limit_brake(train, rate, adhesion_at(patches, train.position))
        train.step(0.0)
        if train.speed == 0.0:
            break
    return train.distance_run - begin
