# SPDX-License-Identifier: Apache-2.0
"""Which trains stand out in a table: those that have changed, and those that always differed from the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.errors import NoAnswerError
from trainid_ros.fleet.causes import Cause, causes_of
from trainid_ros.fleet.changes import Change, Series, Step, find_changes
from trainid_ros.fleet.channels import CHANNELS, Cells, Channel, Labels, cells_of, labels_of
from trainid_ros.fleet.mixed_model import MixedFit, fit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.fleet.columns import Row

    Array = NDArray[np.float64]

_LEAST_CELLS: Final = 4
_PASSES: Final = 2
# What may change from day to day without meaning anything, as a share of a step that matters.
_SMALLEST: Final = 0.02
# A train that always differed is named beyond so many standard deviations among trains.
_LEVEL_SIGMAS: Final = 5.0


@dataclass(frozen=True, slots=True)
class ChannelView:
    """One channel of the fleet.

    Attributes:
        channel: Which.
        cells: Its values.
        fit: The fitted model.

    """

    channel: Channel
    cells: Cells
    fit: MixedFit

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
        std = np.sqrt(variance + (_SMALLEST * step_std) ** 2)
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
    """One train.

    Attributes:
        name: Its name.
        number: Index in the labels.
        series: Its values by channel.
        changes: Its changes.
        outliers: Channels in which it always differed.
        causes: What the last change may be, the most probable first.

    """

    name: str
    number: int
    series: tuple[Series, ...]
    changes: tuple[Change, ...]
    outliers: tuple[LevelOutlier, ...]
    causes: tuple[Cause, ...]

    @property
    def evidence(self) -> float:
        """Evidence that it stands out: ln R of its strongest change, or half the square of its largest difference."""
        levels = (0.5 * outlier.sigmas**2 for outlier in self.outliers)
        return max((*(change.evidence for change in self.changes), *levels), default=0.0)

    @property
    def stands_out(self) -> bool:
        """Whether it is named."""
        return bool(self.changes or self.outliers)


@dataclass(frozen=True, slots=True)
class FleetView:
    """The whole fleet: labels, channels, and trains by evidence, the strongest first."""

    labels: Labels
    channels: tuple[ChannelView, ...]
    trains: tuple[TrainView, ...]

    @property
    def found(self) -> tuple[TrainView, ...]:
        """Trains that stand out."""
        return tuple(train for train in self.trains if train.stands_out)


def analyse(rows: Sequence[Row], limit: float) -> FleetView:
    """Return what stands out in the rows of a fleet.

    The model is fitted, changes are found, and the model is fitted again without what came after them.

    Args:
        rows: Rows of one table or several.
        limit: Train-days for one false alarm.

    Raises:
        NoAnswerError: Too few runs of known trains and days have an estimate.

    """
    labels = labels_of(rows)
    cells = [(channel, cells_of(rows, channel, labels)) for channel in CHANNELS]
    cells = [(channel, found) for channel, found in cells if found.value.size >= _LEAST_CELLS]
    if not cells:
        msg = f'too few runs with train, day and estimate ({len(rows)} rows): see the columns train, day and error'
        raise NoAnswerError(msg)
    ends: Array | None = None
    for _ in range(_PASSES):
        views = tuple(ChannelView(channel, c, fit(c, labels, _before(c, ends))) for channel, c in cells)
        series = [tuple(view.series(k, len(labels.days)) for view in views) for k in range(len(labels.trains))]
        changes = [find_changes(own, limit) for own in series]
        ends = np.array([own[0].day if own else np.inf for own in changes])
    trains = [_train(labels, views, k, series[k], changes[k]) for k in range(len(labels.trains))]
    return FleetView(labels, views, tuple(sorted(trains, key=lambda train: (-train.evidence, train.name))))


def _before(cells: Cells, ends: Array | None) -> NDArray[np.bool_] | None:
    """Return which cells came before the first change of their train."""
    return None if ends is None else cells.day < ends[cells.train]


def _train(
    labels: Labels, views: Sequence[ChannelView], number: int, series: tuple[Series, ...], changes: Sequence[Change]
) -> TrainView:
    outliers = () if changes else tuple(filter(None, (_outlier(view, number) for view in views)))
    causes: tuple[Cause, ...] = ()
    if changes:
        causes = causes_of({v.channel.name: s for v, s in zip(views, _relative(views, changes[-1]), strict=True)})
    elif outliers:
        sizes = {v.channel.name: _level(v, number) for v in views}
        causes = causes_of(sizes)
    return TrainView(labels.trains[number], number, series, tuple(changes), outliers, causes)


def _relative(views: Sequence[ChannelView], change: Change) -> list[tuple[float, float] | None]:
    """Return the steps of a change and their standard deviations as shares of the mean of the fleet."""
    return [None if step is None else _share(view, step) for view, step in zip(views, change.steps, strict=True)]


def _share(view: ChannelView, step: Step) -> tuple[float, float]:
    return step.size / view.fit.mean, step.std / abs(view.fit.mean)


def _level(view: ChannelView, number: int) -> tuple[float, float]:
    spread = float(np.hypot(view.fit.train_std[number], view.fit.stds['train']))
    return float(view.fit.train[number]) / view.fit.mean, spread / abs(view.fit.mean)


def _outlier(view: ChannelView, number: int) -> LevelOutlier | None:
    """Return by how much a train differs, in robust standard deviations among trains; None if it does not."""
    effects = view.fit.train
    spread = 1.4826 * float(np.median(np.abs(effects - np.median(effects))))
    spread = max(spread, view.fit.stds['train'] * 0.5, float(view.fit.train_std[number]))
    sigmas = float(effects[number] - np.median(effects)) / spread
    if abs(sigmas) < _LEVEL_SIGMAS:
        return None
    return LevelOutlier(view.channel, float(effects[number]), float(view.fit.train_std[number]), sigmas)
