# SPDX-License-Identifier: Apache-2.0
"""Random days on which controllers of different knowledge drive the same train over the same line.

A day has what the train file does not know: another resistance, load at each stop, gusts, errors of map, wheels, mass,
force and brake timing, pads that wear, rain, one brake unit that is isolated, a brake that fades when it is hot. Its
brake rate may also change over speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ato.controller import Ato, AtoModel, Phase
from ato.knowledge import LearnedRate, LiveValues, StatedValues, StopBias, TrainKnowledge, TrueValues
from ato.train_state import PositionModel
from trainid_ros.interface.errors import InputError
from trainid_ros.sim.plant import TICK_S
from trainid_ros.sim.scenario import Change, simulate
from trainid_ros.sim.worlds import UNKNOWNS, find_world, make_case, usual_duration, world_train
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Davis, Effect, TrainFile

if TYPE_CHECKING:
    from trainid_ros.client import TrainModel
    from trainid_ros.sim.plant import Decision, Plant, StopEvent
    from trainid_ros.sim.worlds import Case, World

CONTROLLERS: Final = ('nominal', 'fast', 'learning', 'rate', 'rate_fast', 'live', 'truth')
"""Values of the train file; the same with stronger integral action; with that and a bias learned from the last stops;
with a brake rate learned from the last stops; with that and stronger integral action; estimates; true values."""
_FAST: Final = PositionModel(integral_gain=0.25)
_UNKNOWNS: Final = frozenset(UNKNOWNS) - {'changes'}
# Brake rate at the start of a day, wear over the day [1], steps in which the wear is simulated.
_RATE: Final = (0.85, 1.1)
_WEAR: Final = (0.0, 0.08)
_WEAR_STEPS: Final = 20
# Rain: probability, factors on brake rate and a. Isolated brake unit: probability. Times as shares of the day.
_RAIN: Final = 0.4
_RAIN_RATE: Final = (0.85, 0.95)
_RAIN_DRAG: Final = (1.0, 1.2)
_ISOLATED: Final = 0.3
_WHEN: Final = (0.15, 0.85)
# Change of the brake rate from standstill to full speed, and at the changeover between brakes [1]; its speed [m/s].
_SLOPE_STD: Final = 0.08
_BLEND_STD: Final = 0.06
_BLEND_SPEED: Final = 2.5
# Fade of the hot brake: loss [1], and heat at which it is reached [J/kg].
_FADE: Final = (0.0, 0.1)
_FADE_ENERGY: Final = 400.0


@dataclass(frozen=True, slots=True)
class DayPlan:
    """A day, and the times at which its brake changes at once [s]."""

    world: World
    case: Case
    events_s: tuple[float, ...]

    def changes(self, begin_s: float, end_s: float) -> bool:
        """Return whether the brake changes at once between two times [s]."""
        return any(begin_s < event_s <= end_s for event_s in self.events_s)

    def surprised(self, drive: Drive) -> tuple[bool, ...]:
        """Return for each stop whether the brake changed while the train braked to it."""
        brakings = zip(drive.brakings_s, drive.arrivals, strict=True)
        return tuple(self.changes(begin_s, arrival.time_s) for begin_s, arrival in brakings)


@dataclass(frozen=True, slots=True)
class Bound:
    """A bound of the stopping distance under one command."""

    time_s: float  # Time at which the braking begins [s]
    bound: float  # Distance within which the client says that the train stops, at 95 % confidence [m]
    distance: float  # Distance within which it does [m]
    is_live: bool  # Whether the bound is from live estimates; False: from the train file, or on the way back to it


@dataclass(frozen=True, slots=True)
class Drive:
    """How a controller has driven a day."""

    arrivals: tuple[StopEvent, ...]  # Its stops
    brakings_s: tuple[float, ...]  # Times at which the brakings to them begin [s]
    duration_s: float  # Duration without the dwell after the last stop [s]
    energy_kwh: float  # Work of the traction [kWh]
    jerk: float  # Root mean square of the jerk from departures to standstills, both included; means of 0.2 s [m/s^3]
    jerk_p999: float  # 99.9 % quantile of its absolute value [m/s^3]
    final_deceleration: float  # Deceleration just before a standstill, mean of the stops [m/s^2]
    overspeed: float  # Highest speed above a limit [m/s], 0 if none
    tracking: float  # Root mean square of the speed less that allowed, while it is regulated to [m/s]
    bounds: tuple[Bound, ...]  # At the beginning of each stop braking, what the client says; only with live estimates

    @property
    def errors(self) -> np.ndarray:
        """Errors of the stops, > 0 beyond them [m], shape (n,)."""
        return np.array([arrival.error for arrival in self.arrivals])


def plan_day(world_name: str, runs: int, rng: np.random.Generator, *, shaped: bool = False) -> DayPlan:
    """Draw a day of a world.

    Args:
        world_name: Name of the world.
        runs: Number of runs from stop to stop.
        rng: Random generator.
        shaped: Whether the brake rate also changes over speed, by as much as the estimators expect.

    Raises:
        InputError: There is no such world.

    """
    world = find_world(world_name)
    file = world_train(world)
    fade = Effect('brake_fade', (('loss', float(rng.uniform(*_FADE))), ('energy', _FADE_ENERGY)))
    case = make_case(world, file, _UNKNOWNS, runs, rng, (fade,))
    duration = usual_duration(world, file.line.stops, runs)
    true = case.scenario.train_file
    changes, events = _changes(true.resistance, file.train.cars, duration, rng)
    if shaped:
        true = replace(true, brake=replace(true.brake, rate_table=_rate_over_speed(true.train.max_speed, rng)))
    return DayPlan(world, replace(case, scenario=replace(case.scenario, train_file=true, changes=changes)), events)


def _rate_over_speed(max_speed: float, rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Return a brake rate over speed [m/s] that no train file states; at half the maximum speed it is 1."""
    slope, blend = (float(std * rng.standard_normal()) for std in (_SLOPE_STD, _BLEND_STD))
    speeds = (0.0, _BLEND_SPEED, 2.0 * _BLEND_SPEED, max_speed)
    return tuple((v, 1.0 + slope * (v / max_speed - 0.5) + blend * (v == _BLEND_SPEED)) for v in speeds)


def _changes(
    resistance: Davis, cars: int, duration: float, rng: np.random.Generator
) -> tuple[tuple[Change, ...], tuple[float, ...]]:
    """Return the changes of a day and the times at which the brake changes at once [s]."""
    rate, wear = float(rng.uniform(*_RATE)), float(rng.uniform(*_WEAR))
    rains, isolated = float(rng.random()) < _RAIN, float(rng.random()) < _ISOLATED
    (rain_s, isolated_s), wet = (duration * rng.uniform(*_WHEN, 2)).tolist(), float(rng.uniform(*_RAIN_RATE))
    wet_a = resistance.a * float(rng.uniform(*_RAIN_DRAG))
    events = [at for at, happens in ((rain_s, rains), (isolated_s, isolated)) if happens]
    changes = []
    for time_s in sorted([*np.linspace(0.0, duration, _WEAR_STEPS).tolist(), *events]):
        is_wet, is_weak = rains and time_s >= rain_s, isolated and time_s >= isolated_s
        now = rate * (1.0 - wear * time_s / duration) * (wet if is_wet else 1.0) * (1.0 - is_weak / cars)
        changes.append(Change(time_s, replace(resistance, a=wet_a) if is_wet else None, now))
    return tuple(changes), tuple(sorted(events))


def drive_day(plan: DayPlan, controller: str | TrainKnowledge, seed: int) -> Drive:
    """Let a controller drive a day; the same seed gives the same day but for what the controller does.

    Args:
        plan: The day.
        controller: One of ``CONTROLLERS``, or where its values come from.
        seed: Seed of the day.

    Raises:
        InputError: There is no such controller.

    """
    if isinstance(controller, str) and controller not in CONTROLLERS:
        raise InputError(f'controller {controller!r} is not known; {did_you_mean(controller, CONTROLLERS)}')
    stated, true = plan.case.stated, plan.case.scenario.train_file
    scored: list[ScoredAto] = []

    def make(plant: Plant, rng: np.random.Generator) -> ScoredAto:
        known = _knowledge(controller, stated, TrueValues(true, plant)) if isinstance(controller, str) else controller
        position = _FAST if controller in ('fast', 'learning', 'rate_fast') else PositionModel()
        scored.append(ScoredAto(plan, known, rng, position, learns=controller == 'learning'))
        return scored[0]

    simulation = simulate(plan.case.scenario, np.random.default_rng(seed), make)
    return scored[0].drive(simulation.arrivals)


def _knowledge(controller: str, stated: TrainFile, true: TrueValues) -> TrainKnowledge:
    if controller == 'truth':
        return true
    if controller in ('rate', 'rate_fast'):
        return LearnedRate(stated)
    return LiveValues(stated) if controller == 'live' else StatedValues(stated)


def _model(world: World) -> AtoModel:
    driver = world.driver
    return AtoModel(
        acceleration=driver.acceleration,
        deceleration=driver.deceleration,
        strongest=driver.max_deceleration,
        speed_margin=driver.speed_margin,
        dwell=0.5 * (driver.dwell_low + driver.dwell_high),
    )


class BoundCheck:
    """Compare bounds of the stopping distance with what a copy of the train does.

    The client is asked with the true gradient halfway to where the train will stop: what is tested is what the
    estimates say of the train, not the map.

    Attributes:
        rows: The bounds so far.

    """

    def __init__(self, model: TrainModel, deceleration: float) -> None:
        """Ask a model about a brake command of this deceleration [m/s^2]."""
        self._model, self._command = model, -deceleration
        self.rows: list[Bound] = []

    def check(self, time_s: float, train: Plant) -> None:
        """Compare at the present state of the train, at a time [s]."""
        distance = self._true_distance(train)
        middle = train.position + 0.5 * train.direction * distance
        gradient = train.profile.gradient(middle, train.direction)
        bound = self._model.stopping_distance(train.speed, gradient, self._command, 0.95)
        self.rows.append(Bound(time_s, bound.value, distance, bound.live))

    def _true_distance(self, train: Plant) -> float:
        twin = train.twin()
        twin.traction = 0.0
        twin.command(self._command)
        while twin.speed > 0.0:
            twin.step(0.0)
        return abs(twin.position - train.position)


@dataclass(frozen=True, slots=True)
class _Moment:
    """Position [m], speed [m/s] and acceleration [m/s^2] at a tick."""

    position: float
    speed: float
    acceleration: float


class RideScore:
    """Follow the true train from tick to tick.

    Attributes:
        jerks: Mean jerk of each tick in motion and of that in which the train comes to rest [m/s^3].
        final_decelerations: Deceleration at the last tick before each standstill [m/s^2].
        speed_errors: Speed less that allowed, while it is regulated to [m/s].
        overspeed: Highest speed above a limit, 0 if none [m/s].

    """

    def __init__(self) -> None:
        """Start at rest."""
        self.jerks: list[float] = []
        self.final_decelerations: list[float] = []
        self.speed_errors: list[float] = []
        self.overspeed = 0.0
        self._last = _Moment(math.nan, 0.0, 0.0)

    def skip(self, train: Plant) -> None:
        """Take note of a tick that does not count."""
        self._last = _moment(train)

    def add(self, train: Plant, allowed: float | None) -> None:
        """Count a tick; with the speed allowed [m/s] if the controller regulates to it."""
        last, now = self._last, _moment(train)
        self.jerks.append((now.acceleration - last.acceleration) / TICK_S)
        if now.speed == 0.0 < last.speed:
            self.final_decelerations.append(-last.acceleration)
        self.overspeed = max(self.overspeed, _overspeed(last, train))
        if allowed is not None:
            self.speed_errors.append(train.speed - allowed)
        self._last = now


def _moment(train: Plant) -> _Moment:
    # In the step in which the train comes to rest, its mean acceleration is neither that before nor that at rest.
    acceleration = train.acceleration if train.speed > 0.0 else 0.0
    return _Moment(train.position, train.speed, acceleration)


def _overspeed(last: _Moment, train: Plant) -> float:
    """Return the highest speed above a limit since the last tick [m/s]: where limits begin, and at the end."""
    profile, direction = train.profile, train.direction
    most = train.speed - profile.speed_limit(train.position, direction)
    run = (train.position - last.position) * direction
    if run > 0.0:
        for distance, limit in profile.limits_ahead(last.position, direction, run):
            # At a constant acceleration, the square of the speed is linear in the distance.
            square = last.speed**2 + (train.speed**2 - last.speed**2) * distance / run
            most = max(most, math.sqrt(square) - limit)
    return most


class ScoredAto(Ato):
    """A controller together with what it is scored by."""

    def __init__(
        self,
        plan: DayPlan,
        known: TrainKnowledge,
        rng: np.random.Generator,
        position: PositionModel,
        *,
        learns: bool,
    ) -> None:
        """Start a day; with ``learns``, aim by the errors of the last stops."""
        stated, self._bias, self._learns = plan.case.stated, StopBias(), learns
        profile = profile_of(stated)
        super().__init__(_model(plan.world), stated, profile, known, rng, lambda: self._bias.aim, position)
        strongest = plan.world.driver.max_deceleration
        self._bounds = BoundCheck(known.model, strongest) if isinstance(known, LiveValues) else None
        self._score = RideScore()
        self._brakings_s: list[float] = []
        self._braking_s = self._work = 0.0

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick."""
        before, phase = len(self.arrivals), self.phase
        decision = super().decide(time_s, train)
        if phase is not Phase.STOP and self.phase is Phase.STOP:
            self._braking_s = time_s
            if self._bounds is not None:
                self._bounds.check(time_s, train)
        if len(self.arrivals) > before:
            self._brakings_s.append(self._braking_s)
            if self._learns:
                self._bias.learn(self.arrivals[-1].error)
        self._work = train.work
        if phase is Phase.DWELL:
            self._score.skip(train)
        else:
            # Also the tick in which the train comes to rest, when the dwell has just begun.
            self._score.add(train, self.allowed(train.position, train.speed)[0] if self.follows else None)
        return decision

    def drive(self, arrivals: tuple[StopEvent, ...]) -> Drive:
        """Return how the day was driven."""
        score = self._score
        jerks = np.abs(score.jerks)
        return Drive(
            arrivals=arrivals,
            brakings_s=tuple(self._brakings_s),
            duration_s=arrivals[-1].time_s,
            energy_kwh=self._work / 3.6e6,
            jerk=float(np.sqrt(np.mean(jerks * jerks))),
            jerk_p999=float(np.quantile(jerks, 0.999)),
            final_deceleration=float(np.mean(score.final_decelerations)),
            overspeed=score.overspeed,
            tracking=float(np.sqrt(np.mean(np.square(score.speed_errors)))),
            bounds=tuple(self._bounds.rows) if self._bounds else (),
        )
