# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stopping distance on days whose brake drops suddenly, as often and by as much as the train file states.

The brake rate also changes over speed. See ``ato.days``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ato.days import DayPlan, drive_day, plan_day
from ato.knowledge import LiveValues
from benchmarks.closed_loop import outcome_of
from benchmarks.seeds import over_seeds
from benchmarks.tables import Table, columns
from trainid_ros.client import TrainModel, Value
from trainid_ros.interface.scalars import seconds
from trainid_ros.sim.scenario import Change
from trainid_ros.sim.worlds import usual_duration

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.interface.records import Record
    from trainid_ros.interface.results import Output
    from trainid_ros.train.train_file import TrainFile

# Lines, and runs from stop to stop on a day.
_LINES: Final = (('metro', 10), ('emu', 6), ('tram', 14))
# Drops per hour and their size [1].
_HAZARDS: Final = ((1.0, 0.15), (4.0, 0.1), (15.0, 0.1))
# Brake rate at the start of a day [1], and times the usual duration of a day in which it drops.
_RATE: Final = (0.9, 1.1)
_DAY: Final = 1.5
# Seeds from here on were not used during development.
_FIRST_SEED: Final = 12_001
# Bounds asked for: whether the client knows the hazard, the confidence, and that of the first stops after a drop.
_ASKED: Final = ((False, 0.95, 0.0), (True, 0.95, 0.0), (True, 0.99, 0.0), (True, 0.95, 0.9))


@dataclass(frozen=True, slots=True)
class Trial:
    """A day of a world, with drops per hour and their size."""

    world: str
    runs: int
    hazard: tuple[float, float]
    seed: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Whether the bounds of a stop by live estimates hold, and their length as a share of the distance."""

    held: tuple[bool, ...]  # For each of those asked for
    lengths: tuple[float, ...]  # The same [1]
    has_dropped: bool  # Whether the brake has dropped since the last stop


class _Asked(TrainModel):
    """Takes note of all bounds whenever the controller asks for one."""

    def watch(self, stated: TrainFile) -> None:
        """Begin, with further clients that have the same estimates and state other hazards."""
        self._stamp_ns, self.bounds = 0, list[tuple[float, ...]]()
        now, self._others = lambda: seconds(self._stamp_ns), list[tuple[TrainModel, float]]()
        for knows, confidence, first in _ASKED:
            brake = replace(stated.brake, loss_per_hour=knows * stated.brake.loss_per_hour, loss_confidence=first)
            self._others.append((TrainModel(None, replace(stated, brake=brake), clock=now), confidence))

    def push(self, record: Record) -> list[Output[Any]]:
        outputs = super().push(record)
        for output in outputs:
            self._stamp_ns = output.stamp_ns
            for model, _ in self._others:
                model.take(output)
        return outputs

    def stopping_distance(self, speed: float, *arguments: Any, **options: Any) -> Value:
        i, u = arguments[:2]
        asked = (model.stopping_distance(speed, i, u, confidence) for model, confidence in self._others)
        self.bounds.append(tuple(answer.value for answer in asked))
        return super().stopping_distance(speed, *arguments, **options)


class _Values(LiveValues):
    def __init__(self, stated: TrainFile) -> None:
        super().__init__(stated)
        asked = _Asked.offline(stated)
        assert isinstance(asked, _Asked)
        asked.watch(stated)
        self.model = self.asked = asked


def measure(seeds: int) -> tuple[Table, ...]:
    """Return tables over as many days of each hazard on each line."""
    trials = [
        Trial(world, runs, hazard, _FIRST_SEED + k)
        for hazard in _HAZARDS
        for world, runs in _LINES
        for k in range(seeds)
    ]
    stops: dict[tuple[float, float], list[Stop]] = {hazard: [] for hazard in _HAZARDS}
    for trial, found in zip(trials, over_seeds(run, trials, 'hazard'), strict=True):
        stops[trial.hazard] += found
    rows = tuple(_row(hazard, found) for hazard, found in stops.items())
    header = columns(
        'drops per hour, size | stops | 95 %, no hazard stated | 95 % | 99 % | 95 %, 90 % after a drop | '
        'stops after a drop | 95 %, no hazard stated | 95 % | 99 % | 95 %, 90 % after a drop | '
        'median margin of the four'
    )
    note = (
        'Share of the stops within the bound that the client states with live estimates when the braking begins: of '
        'all stops, and of the first one after a drop. The brake rate falls by the size at random times, as often as '
        'stated; nothing else of it changes but over speed, and by up to 10 % when it is hot. The client is asked with '
        'the true gradient halfway to the stop. Margin: bound over distance, less 1.'
    )
    return (Table('Bounds with a stated hazard', header, rows, note),)


def run(trial: Trial) -> list[Stop]:
    plan = _plan(trial)
    values = _Values(plan.case.stated)
    outcome = outcome_of(plan, drive_day(plan, values, trial.seed))
    found = []
    for row, bounds, has_dropped in zip(outcome.drive.bounds, values.asked.bounds, outcome.unknown, strict=True):
        if row.is_live:
            held = tuple(row.distance <= bound for bound in bounds)
            found.append(Stop(held, tuple(bound / row.distance for bound in bounds), has_dropped))
    return found


def _plan(trial: Trial) -> DayPlan:
    rng = np.random.default_rng(trial.seed)
    plan, (per_hour, loss) = plan_day(trial.world, trial.runs, rng, shaped=True), trial.hazard
    case = plan.case
    stated = replace(case.stated, brake=replace(case.stated.brake, loss_per_hour=per_hour, loss=loss))
    duration = _DAY * usual_duration(plan.world, stated.line.stops, trial.runs)
    times = np.sort(rng.uniform(0.0, duration, rng.poisson(per_hour * duration / 3600.0))).tolist()
    rate = float(rng.uniform(*_RATE))
    changes = tuple(Change(t, None, rate * (1.0 - loss) ** k) for k, t in enumerate([0.0, *times]))
    scenario = replace(case.scenario, changes=changes, stated=stated)
    return DayPlan(plan.world, replace(case, scenario=scenario, stated=stated), tuple(times))


def _row(hazard: tuple[float, float], stops: Sequence[Stop]) -> tuple[str, ...]:
    held = np.array([stop.held for stop in stops])
    after: NDArray[np.bool_] = np.array([stop.has_dropped for stop in stops])
    margins = np.median([stop.lengths for stop in stops], axis=0) - 1.0
    lengths = ', '.join(f'{margin:+.1%}' for margin in margins)
    return (f'{hazard[0]:g}, {hazard[1]:.0%}', *_shares(held), *_shares(held[after]), lengths)


def _shares(held: NDArray[np.bool_]) -> tuple[str, ...]:
    return (str(len(held)), *(f'{column.mean():.1%}' if column.size else '-' for column in held.T))
