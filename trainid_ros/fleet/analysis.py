# SPDX-License-Identifier: Apache-2.0
"""Which trains stand out in a table: those that have changed, and those that always differed from the others.

The cause of a change is named from the bags of the train, by the discrepancy workflow before and after it: what those
of its main departure show besides that of the usual days is new. Each bag is explained alone, since wind and load
differ from day to day.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import ndtr, stdtrit

from trainid_ros.bag.run_reader import read_runs
from trainid_ros.explain.result import Explanation, FoundEffect
from trainid_ros.fleet import mixed_model as mixed
from trainid_ros.fleet.changes import (
    MIN_AFTER,
    Cause,
    Change,
    Departure,
    Series,
    causes_of,
    departures,
    find_changes,
    usual_days,
)
from trainid_ros.fleet.mixed_model import CHANNELS, Array, Cells, Channel, Flags, Labels, MixedFit, has_estimate
from trainid_ros.fleet.table_file import FleetRun, Row
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.interface.errors import InputError, NoAnswerError, TrainIdError
from trainid_ros.interface.text import listed
from trainid_ros.train.train_file import load_train_file

_MIN_CELLS: Final = 4  # Days of trains, all trains together, for a channel to be compared


@dataclass(frozen=True, slots=True)
class ChannelView:
    """One channel of the fleet."""

    channel: Channel  # Which
    cells: Cells  # Its values
    fit: MixedFit  # The fitted model

    def series(self, train: int, days: int) -> Series:
        """Return the values of a train by day, less what trains have in common."""
        mine = np.flatnonzero(self.cells.train == train)
        day = self.cells.day[mine]
        weight = 1.0 / (self.fit.variance[mine] + self.fit.common_variance[mine])
        own = self.cells.value[mine] - self.fit.common[mine]
        total = np.bincount(day, weight, days)
        with np.errstate(invalid='ignore', divide='ignore'):
            value, variance = np.bincount(day, weight * own, days) / total, 1.0 / total
        step_std = self.channel.change * abs(self.fit.mean)
        std = np.sqrt(variance + (0.02 * step_std) ** 2)  # harmless changes from day to day
        # The std found among trains may be zero.
        return Series(value, std, self.fit.degrees, self.fit.stds['train'] + 0.01 * step_std, step_std)


@dataclass(frozen=True, slots=True)
class LevelOutlier:
    """A train that always differed: by how much, its standard deviation, and in standard deviations among trains."""

    channel: Channel
    size: float
    std: float
    sigmas: float


@dataclass(frozen=True, slots=True)
class TrainView:
    """One train."""

    name: str
    number: int  # Index in the labels
    series: tuple[Series, ...]  # Its values by channel
    changes: tuple[Change, ...]
    departures: tuple[Departure, ...]  # Days on which it was away from its usual level
    outliers: tuple[LevelOutlier, ...]  # Channels in which it always differed
    causes: tuple[Cause, ...]  # What the main departure may be, the most probable first

    @property
    def main(self) -> Departure | None:
        """The departure that has not ended, else the most certain one."""
        return max(self.departures, key=lambda found: (found.end is None, found.evidence), default=None)

    @property
    def evidence(self) -> float:
        """Evidence that it stands out: ln R of its strongest change, or half the square of its largest difference."""
        levels = (0.5 * outlier.sigmas**2 for outlier in self.outliers)
        return max((*(change.evidence for change in self.changes), *levels), default=0.0)


@dataclass(frozen=True, slots=True)
class FleetView:
    """The whole fleet."""

    labels: Labels
    channels: tuple[ChannelView, ...]
    trains: tuple[TrainView, ...]  # Its trains by evidence, the strongest first
    # Trains with runs that were left out as their inputs contradict each other, with how many
    contradicted: tuple[tuple[str, int], ...] = ()
    hidden: tuple[str, ...] = ()  # What cannot be seen yet, and why, as sentences

    @property
    def found(self) -> tuple[TrainView, ...]:
        """Trains that stand out."""
        return tuple(train for train in self.trains if train.changes or train.outliers)


def analyse(rows: Sequence[Row], limit: float) -> FleetView:
    """Return what stands out in the rows of a fleet; ``limit`` are the train-days for one false alarm.

    NoAnswerError if too few runs of known trains and days have an estimate.
    """
    labels = mixed.labels_of(rows)
    cells = [(channel, mixed.cells_of(rows, channel, labels)) for channel in CHANNELS]
    cells = [(channel, found) for channel, found in cells if found.value.size >= _MIN_CELLS]
    if not cells:
        usable = sum(has_estimate(row) and not row['contradiction'] for row in rows)
        raise NoAnswerError(
            f'too few days of trains to compare: {len(rows)} rows, {usable} with train, day and estimate and without '
            f'contradiction; {_MIN_CELLS} days, those of all trains together, are the least'
        )
    views, series, changes = _fit_and_test(labels, cells, limit)
    trains = [_train(labels, views, k, series[k], changes[k]) for k in range(len(labels.trains))]
    contradicted = Counter(row['train'] for row in rows if has_estimate(row) and row['contradiction'])
    ranked = tuple(sorted(trains, key=lambda train: (-train.evidence, train.name)))
    return FleetView(
        labels, views, ranked, tuple(contradicted.most_common()), tuple(_hidden(rows, labels, ranked, views))
    )


def _hidden(
    rows: Sequence[Row], labels: Labels, trains: Sequence[TrainView], views: Sequence[ChannelView]
) -> Iterator[str]:
    """Yield which changes and trains cannot be seen yet, with the reason."""
    days: dict[str, list[str]] = {}
    for train in sorted(trains, key=lambda train: train.name):
        seen = np.any([np.isfinite(series.value) for series in train.series], axis=0)
        days[train.name] = [labels.days[k] for k in np.flatnonzero(seen)]
    few = [name for name, own in days.items() if len(own) <= MIN_AFTER]
    for last in sorted({own[-1] for name, own in days.items() if name not in few}, reverse=True)[:3]:
        names = [name for name, own in days.items() if name not in few and own[-1] == last]
        who = '' if len(names) == len(trains) else f' of {listed(names, 5)}'
        yield f'What began{who} on {last} or later: a change needs {MIN_AFTER} days of data.'
    if few:
        yield f'Changes of {listed(few, 5)}: there must be {MIN_AFTER + 1} days of data.'
    unused = {row['train']: row for row in rows if row['train'] and row['train'] not in labels.trains}
    for name, row in sorted(unused.items())[:5]:
        why = row['contradiction'] or row['error'] or 'its day is not known'
        yield f'Train {name}: no run can be used ({why}).'
    compared = {view.channel for view in views}
    if missing := [channel.title for channel in CHANNELS if channel not in compared]:
        yield f'Changes of {" and ".join(missing)}: fewer than {_MIN_CELLS} days of trains have a value.'


def _fit_and_test(
    labels: Labels, cells: Sequence[tuple[Channel, Cells]], limit: float
) -> tuple[tuple[ChannelView, ...], list[tuple[Series, ...]], list[list[Change]]]:
    """Return the fitted channels, and values and changes of each train.

    A fault in the data widens the spread by which it is judged. So the model is fitted without what may be a fault,
    then without what the last fit found, until the same is found again.
    """
    usual = _screen(labels, cells, min(limit, 50.0))  # train-days for one false alarm
    for _ in range(5):
        in_usual_days = [(usual[c.train, 0] <= c.day) & (c.day < usual[c.train, 1]) for _, c in cells]
        views = _fit(labels, cells, in_usual_days)
        series = [_series(views, labels, k) for k in range(len(labels.trains))]
        changes = [find_changes(own, limit) for own in series]
        last, usual = usual, _usual(series, changes)
        if np.array_equal(last, usual):
            break
    return views, series, changes


def _screen(labels: Labels, cells: Sequence[tuple[Channel, Cells]], limit: float) -> Array:
    """Return the days on which each train may be as usual, shape (trains, 2).

    A train of a small fleet is judged by the others alone, since it is much of the data.
    """
    trains = range(len(labels.trains))
    rounds = 2  # of weights: these fits must not be spoilt by a fault
    if len(trains) > 12:
        views = _fit(labels, cells, [None] * len(cells), rounds)
        series = [_series(views, labels, k) for k in trains]
    else:
        others = (_fit(labels, cells, [c.train != k for _, c in cells], rounds) for k in trains)
        series = [_series(views, labels, k) for k, views in enumerate(others)]
    return _usual(series, [find_changes(own, limit) for own in series])


def _fit(
    labels: Labels,
    cells: Sequence[tuple[Channel, Cells]],
    used: Sequence[Flags | None],
    rounds: int = mixed.ROUNDS,
) -> tuple[ChannelView, ...]:
    views = []
    for (channel, found), mine in zip(cells, used, strict=True):
        usual = 0.25 * channel.change * float(np.median(np.abs(found.value)))  # std among trains
        views.append(ChannelView(channel, found, mixed.fit(found, labels, usual, mine, rounds)))
    return tuple(views)


def _series(views: Sequence[ChannelView], labels: Labels, train: int) -> tuple[Series, ...]:
    return tuple(view.series(train, len(labels.days)) for view in views)


def _usual(series: Sequence[tuple[Series, ...]], changes: Sequence[Sequence[Change]]) -> Array:
    """Return the first day of the usual level of each train, and the first one after it, shape (trains, 2)."""
    return np.array([usual_days(*pair) for pair in zip(series, changes, strict=True)])


def _train(
    labels: Labels, views: Sequence[ChannelView], number: int, series: tuple[Series, ...], changes: Sequence[Change]
) -> TrainView:
    outliers = () if changes else tuple(filter(None, (_outlier(view, number) for view in views)))
    found = TrainView(labels.trains[number], number, series, tuple(changes), departures(series, changes), outliers, ())
    # By what share of the mean it departed, or always differed, with the standard deviation.
    steps: dict[str, tuple[float, float] | None] = {}
    if found.main is not None:
        for view, step in zip(views, found.main.steps, strict=True):
            steps[view.channel.name] = step and (step.size / view.fit.mean, step.std / abs(view.fit.mean))
    elif outliers:
        for view in views:
            level, mean = float(view.fit.train[number]), view.fit.mean
            spread = float(np.hypot(view.fit.train_std[number], view.fit.stds['train']))
            steps[view.channel.name] = level / mean, spread / abs(mean)
    return replace(found, causes=causes_of(steps) if steps else ())


def _outlier(view: ChannelView, number: int) -> LevelOutlier | None:
    """Return by how much a train differs, in robust standard deviations among trains; None if it does not."""
    effects = view.fit.train
    spread = max(mixed.robust_std(effects), view.fit.stds['train'] * 0.5, float(view.fit.train_std[number]))
    sigmas = float(effects[number] - np.median(effects)) / spread
    # Five standard deviations; the spread of few trains is not well known: Student's t.
    if abs(sigmas) < stdtrit(max(1, effects.size - 1), ndtr(5.0)):
        return None
    return LevelOutlier(view.channel, float(effects[number]), float(view.fit.train_std[number]), sigmas)


@dataclass(frozen=True, slots=True)
class CauseByBags:
    """What ``explain`` found: number of bags after the change, new effects, the most evident first, or why not.

    Each effect is as found where its evidence is greatest, with the number of bags in which it was found.
    """

    bags: int
    effects: tuple[tuple[FoundEffect, int], ...] = ()
    problem: str = ''


def name_cause(view: FleetView, train: TrainView, runs: Sequence[FleetRun]) -> CauseByBags:
    """Return what has changed by the bags of a train, each explained with the files that it was replayed with."""
    usual, away = _bags(view, train, runs)
    try:
        known = [effect for run in usual for effect in _explain(run).effects]
        found = [effect for run in away for effect in _explain(run).effects]
    except TrainIdError as error:
        return CauseByBags(0, problem=str(error))
    by_name: dict[str, list[FoundEffect]] = defaultdict(list)
    for new in found:
        if not any(are_equal(new, old, 3.0) for old in known):
            by_name[new.name].append(new)
    ranked = sorted(by_name.values(), key=lambda effects: -sum(effect.evidence for effect in effects))
    named = ((max(effects, key=lambda effect: effect.evidence), len(effects)) for effects in ranked)
    return CauseByBags(len(away), tuple(named))


def _bags(view: FleetView, train: TrainView, runs: Sequence[FleetRun]) -> tuple[list[FleetRun], list[FleetRun]]:
    """Return the bag of the usual days that is next to the main departure of a train, and the first ones of that."""
    days, departure = view.labels.days, train.main
    if departure is None:
        return [], []
    own = [run for run in runs if run.row['train'] == train.name and run.row['day'] and run.row['status']]
    own.sort(key=lambda run: (run.row['day'], run.row['start'] or 0.0))
    first, end = days[departure.first], '9999' if departure.end is None else days[departure.end]
    before = [run for run in own if run.row['day'] < first]
    away = [run for run in own if first <= run.row['day'] < end]
    after = [run for run in own if run.row['day'] >= end]
    return before[-1:] or after[:1], away[:3]  # effects that hold are in the first ones already


def are_equal(one: FoundEffect, other: FoundEffect, stds: float) -> bool:
    """Return whether two effects have one name and, within some standard deviations, the same parameters."""
    if one.name != other.name:
        return False
    values, known = dict(other.parameters), (dict(one.std), dict(other.std))
    return all(
        abs(value - values[name]) <= stds * math.hypot(*(std.get(name, 0.0) for std in known))
        for name, value in one.parameters
    )


def _explain(run: FleetRun) -> Explanation:
    """Explain a bag; InputError if it cannot be used, or it is not known how, NoAnswerError with too little motion."""
    from trainid_ros.explain.workflow import explain  # noqa: PLC0415 - takes long to load

    row, setup = run
    if setup is None:
        raise InputError('the plan of the table is missing')
    train_file = load_train_file(setup.train)
    inputs = mapped_inputs(setup.mapping, train_file)
    found = read_runs([Path(row['bag'])], train_file, setup.namespace, setup.max_chunk, inputs)
    return explain(found, train_file, provenance='trainid fleet report')
