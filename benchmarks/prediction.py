# SPDX-License-Identifier: Apache-2.0
"""Speed predicted 5 and 60 s ahead, against the truth and against persistence, in all worlds of the simulator."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, columns
from trainid_ros.client import TrainModel
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, MassRecord, Record, SpeedRecord
from trainid_ros.interface.results import SpeedModelEstimate, Status
from trainid_ros.setup.pipelines import EstimatorSettings, speed_model_pipeline
from trainid_ros.sim.plant import TICK_S, Decision, Driver, Plant
from trainid_ros.sim.scenario import simulate
from trainid_ros.sim.worlds import REALISMS, WORLDS, Case, find_world, make_case, world_train
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import BrakeActuator, BrakeCommandChange, acceleration, davis
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Davis

HORIZONS: Final = (5.0, 60.0)
_HEADER: Final = columns(
    'world | train file | values | ahead, s | number | client, m/s | its std | 95 % band | same speed, m/s | '
    'same acceleration, m/s | no brake: client, m/s | by the speed model, m/s'
)
_NOTE: Final = (
    'Root mean square errors of the speed predicted, each 15 s of motion above 3 m/s, without horizons in which the '
    'train stands. The client knows the traction that the drive reports and the brake commands of the horizon, as a '
    'controller that plans them, and the place on the map; not gusts, errors of map, mass and force, or changes of '
    'the train. Same speed, same acceleration: persistence, the latter of the last 2 s. Std: median of those stated. '
    'Live: resistance and brake rate are; the others are at the beginning of a drive. No brake: horizons without brake '
    'in which the speed model is valid; its parameters instead of those of the resistance.'
)
# Seeds from here on were not used during development.
_FIRST_SEED: Final = 6001
_RUNS: Final = 5
_EVERY_S: Final = 15.0
_SLOWEST: Final = 3.0
# Commands are this old at most when they act [s].
_PAST_S: Final = 8.0
# Persistence takes the acceleration from so many speeds.
_RECENT: Final = 10


class Forecast(NamedTuple):
    """A prediction over one horizon; all in m/s."""

    horizon: float  # [s]
    is_live: bool  # Whether resistance and brake rate are live
    error: float  # Of the client, predicted minus true
    std: float  # As stated
    speed: float  # Error if the speed stays
    acceleration: float  # Error if the acceleration stays
    speed_model: float  # Error by the parameters of the speed model, NaN where it is not valid or the train brakes
    by_client: float  # That of the client at these times


class _Logged(Driver):
    """The driver of the scenario; the true motion is written down."""

    def __init__(self, case: Case, plant: Plant, rng: np.random.Generator) -> None:
        super().__init__(case.scenario.driver, case.stated, plant.profile, rng)
        self.times: list[float] = []
        self.speeds: list[float] = []
        self.places: list[tuple[float, int]] = []

    def decide(self, time_s: float, train: Plant) -> Decision:
        """Return the demands until the next tick."""
        self.times.append(time_s)
        self.speeds.append(train.speed)
        self.places.append((train.position, train.direction))
        return super().decide(time_s, train)


def forecasts(world: str, realism: str, seed: int, runs: int = _RUNS) -> list[Forecast]:
    """Return the predictions of a drive; what drives and brakes the train is known, as to a controller."""
    kind = find_world(world)
    case = make_case(kind, world_train(kind), REALISMS[realism], runs, np.random.default_rng(seed))
    drivers: list[_Logged] = []

    def make_driver(plant: Plant, rng: np.random.Generator) -> _Logged:
        drivers.append(_Logged(case, plant, rng))
        return drivers[-1]

    records = simulate(case.scenario, np.random.default_rng([seed, 1]), make_driver).records
    return _Questions(case, drivers[-1], records).answers()


class _Questions:
    """Predictions in the course of a drive."""

    def __init__(self, case: Case, driver: _Logged, records: Sequence[Record]) -> None:
        self._case, self._driver, self._records = case, driver, records
        self._start_s = case.scenario.start_ns / NS_PER_S
        # The wheels measure a wrong speed, which nobody knows: the truth is compared as they measure it.
        self._wheels = dict(case.true_values)['wheel_ratio']
        self._commands = [(self._time(r), r.target_acceleration) for r in records if isinstance(r, BrakeRecord)]
        self._forces = [(self._time(r), r.force) for r in records if isinstance(r, ForceRecord)]
        self._mass = case.stated.train.mass

    def _time(self, record: Record) -> float:
        return record.stamp_ns / NS_PER_S - self._start_s

    def answers(self) -> list[Forecast]:
        stated, out, next_s = self._case.stated, list[Forecast](), 60.0
        model, other = TrainModel.offline(stated), speed_model_pipeline(stated, EstimatorSettings())
        actuator, speeds, last_ns = BrakeActuator(stated.brake), list[SpeedRecord](), 0
        for record in self._records:
            model.push(record)
            other.push(record)
            if isinstance(record, BrakeRecord):
                actuator.commands.follow((BrakeCommandChange(record.stamp_ns, record.target_acceleration),))
            elif isinstance(record, MassRecord):
                self._mass = record.mass
            elif isinstance(record, SpeedRecord):
                actuator.advance(last_ns or record.stamp_ns, record.stamp_ns)
                last_ns, speeds = record.stamp_ns, [*speeds[1 - _RECENT :], record]
                if (now := self._time(record)) >= next_s and record.speed > _SLOWEST:
                    next_s = now + _EVERY_S
                    estimate = other.current()
                    is_valid = estimate.status in (Status.VALID, Status.HOLDING)
                    out += self._ask(model, speeds, actuator.output, estimate.estimate if is_valid else None)
        return out

    def _ask(
        self, model: TrainModel, speeds: Sequence[SpeedRecord], applied: float, other: SpeedModelEstimate | None
    ) -> list[Forecast]:
        """Return the predictions of now, but those of horizons in which the train stands."""
        now, speed = self._time(speeds[-1]), speeds[-1].speed
        times, true_speeds = self._driver.times, self._driver.speeds
        first = bisect_right(times, now) - 1
        position, direction = self._driver.places[first]
        force, command = self._ahead(self._forces, now, TICK_S), self._ahead(self._commands, now, _PAST_S)
        # A drive reports the brake as a force too. Each force is that in the middle of its time.
        force = [
            (t - 0.5 * TICK_S, 0.0 if f < 0.0 and self._brakes(now + t - _PAST_S, now + t) else f) for t, f in force
        ]
        found = model.predict(
            HORIZONS, speed=speed, force=force, command=command, applied=applied, mass=self._mass,
            direction=direction, position=position,
        )  # fmt: skip
        is_live, out = model.resistance(speed).live and model.brake_rate().live, list[Forecast]()
        slope = float(np.polyfit([self._time(r) for r in speeds], [r.speed for r in speeds], 1)[0])
        for horizon, value in zip(HORIZONS, found, strict=True):
            end = bisect_right(times, now + horizon)
            if end == len(times) or min(true_speeds[first : end + 1]) <= 0.0:
                continue
            true, by_other = self._wheels * float(np.interp(now + horizon, times, true_speeds)), math.nan
            if other and not self._brakes(now - _PAST_S, now + horizon):
                by_other = self._by_speed_model(other, speed, force, position, direction, horizon) - true
            error, stays = value.value - true, max(0.0, speed + slope * horizon) - true
            by_client = error if math.isfinite(by_other) else math.nan
            out.append(Forecast(horizon, is_live, error, value.std, speed - true, stays, by_other, by_client))
        return out

    def _ahead(self, steps: Sequence[tuple[float, float]], now: float, past: float) -> list[tuple[float, float]]:
        """Return values from some time ago until the end of the horizons, by their time from now [s]."""
        return [(t - now, x) for t, x in steps if now - past < t < now + HORIZONS[-1]]

    def _brakes(self, begin: float, end: float) -> bool:
        return any(command < 0.0 for t, command in self._commands if begin < t < end)

    def _by_speed_model(
        self, model: SpeedModelEstimate, v: float, force: Sequence[tuple[float, float]], position: float,
        direction: int, horizon: float,
    ) -> float:  # fmt: skip
        """Return the speed by the parameters of the speed model after a time without brake [m/s]."""
        curve = effect_value(self._case.stated.effects, 'curve_resistance', 'coefficient', 0.0)
        profile = profile_of(self._case.stated)
        times, forces = zip(*force, strict=True)
        for k in range(round(horizon / TICK_S)):
            F = float(np.interp((k + 0.5) * TICK_S, times, forces))
            radius = profile.curve_radius(position, direction)
            w = davis(Davis(model.a, model.b, model.c), v) + profile.gradient(position, direction)
            w += curve / radius if radius > 0.0 else 0.0
            v = max(0.0, v + TICK_S * acceleration(F, self._mass, model.mass_factor - 1.0, w))
            position += direction * TICK_S * v
        return v


def measure(seeds: int) -> tuple[Table, ...]:
    """Return the errors of all worlds, clean and in the field."""
    trials = list(product(WORLDS, REALISMS, range(_FIRST_SEED, _FIRST_SEED + seeds)))
    groups: dict[tuple[str, str], list[Forecast]] = {trial[:2]: [] for trial in trials}
    for trial, found in zip(trials, over_seeds(_of_trial, trials, 'prediction'), strict=True):
        groups[trial[:2]] += found
    rows = [
        (*group, 'live' if is_live else 'train file', f'{horizon:g}', *summary(chosen))
        for group, found in groups.items()
        for horizon, is_live in product(HORIZONS, (True, False))
        if (chosen := [one for one in found if one.horizon == horizon and one.is_live == is_live])
    ]
    return (Table('Speed predicted ahead', _HEADER, tuple(rows), _NOTE),)


def summary(found: Sequence[Forecast]) -> tuple[str, ...]:
    """Return the cells of some predictions."""
    values = np.array([one[2:] for one in found])
    error, std = values[:, 0], values[:, 1]
    both = np.isfinite(values[:, 4])
    shown = (
        _rms(error), f'{np.median(std):.3f}', f'{np.mean(np.abs(error) < 1.96 * std):.1%}', _rms(values[:, 2]),
        _rms(values[:, 3]), _rms(values[both, 5]), _rms(values[both, 4]),
    )  # fmt: skip
    return str(len(found)), *shown


def _rms(errors: NDArray[np.float64]) -> str:
    return f'{math.sqrt(np.mean(np.square(errors))):.3f}' if errors.size else '-'


def _of_trial(trial: tuple[str, str, int]) -> list[Forecast]:
    return forecasts(*trial)
