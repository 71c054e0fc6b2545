# SPDX-License-Identifier: Apache-2.0
"""Figures of the report of a fleet; each function returns an SVG element."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.fleet.changes import Level
from trainid_ros.report.style import BAD, BRAKE, ESTIMATE, GRID, INK, MUTED, SECOND, TRACTION, styled_figure, to_svg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from trainid_ros.fleet.analysis import ChannelView, FleetView, TrainView
    from trainid_ros.fleet.changes import Change

_NAMED: Final = (BAD, BRAKE, SECOND, TRACTION, ESTIMATE)
_SIGMAS: Final = 2.0
_MOST_LINES: Final = 200
_MOST_TICKS: Final = 8


def fleet_over_days(view: FleetView) -> str:
    """Plot each channel of all trains, less what they have in common; those that stand out in colour."""
    with styled_figure(2.1 * len(view.channels)) as figure:
        panels = figure.subplots(len(view.channels), 1, sharex=True, squeeze=False)[:, 0]
        for k, (axes, channel) in enumerate(zip(panels, view.channels, strict=True)):
            _fleet_band(axes, channel, len(view.labels.days))
            for train in view.trains[len(view.found) : _MOST_LINES]:
                axes.plot(channel.fit.mean + train.series[k].value, color=MUTED, linewidth=0.5, alpha=0.5)
            for train, colour in zip(view.found, _NAMED, strict=False):
                axes.plot(channel.fit.mean + train.series[k].value, color=colour, marker='.', label=train.name)
            _label(axes, channel)
        if view.found:
            panels[0].legend(loc='upper left', ncols=len(_NAMED))
        _days(panels[-1], view.labels.days)
        return to_svg(figure, 'Values of all trains over the days')


def common_over_days(view: FleetView) -> str:
    """Plot what trains have in common on each day: the mean of the fleet."""
    with styled_figure(1.6 * len(view.channels)) as figure:
        panels = figure.subplots(len(view.channels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, channel in zip(panels, view.channels, strict=True):
            cells, days = channel.cells, len(view.labels.days)
            count = np.bincount(cells.day, minlength=days)
            with np.errstate(invalid='ignore', divide='ignore'):
                mean = np.bincount(cells.day, channel.fit.common, days) / count
            axes.plot(mean, color=ESTIMATE, marker='.')
            _label(axes, channel)
        _days(panels[-1], view.labels.days)
        return to_svg(figure, 'What trains have in common on each day')


def train_over_days(view: FleetView, train: TrainView) -> str:
    """Plot each channel of one train over the days with its levels and the band of the fleet."""
    with styled_figure(1.8 * len(view.channels)) as figure:
        panels = figure.subplots(len(view.channels), 1, sharex=True, squeeze=False)[:, 0]
        for k, (axes, channel) in enumerate(zip(panels, view.channels, strict=True)):
            series, mean = train.series[k], channel.fit.mean
            _fleet_band(axes, channel, len(view.labels.days))
            at = np.arange(series.value.size)
            axes.errorbar(at, mean + series.value, series.std, fmt='.', color=INK, elinewidth=0.8, markersize=4)
            _levels(axes, channel, k, train)
            _label(axes, channel)
        _days(panels[-1], view.labels.days)
        return to_svg(figure, f'Train {train.name} over the days')


def _levels(axes: Axes, channel: ChannelView, k: int, train: TrainView) -> None:
    """Draw the levels between the changes with their bands."""
    edges = [0, *(change.day for change in train.changes), len(train.series[k].value)]
    for start, end, level, std in _segments(train.changes, edges, k, channel, train.number):
        x = np.array([start - 0.5, end - 0.5])
        low, high = channel.fit.mean + level - _SIGMAS * std, channel.fit.mean + level + _SIGMAS * std
        axes.fill_between(x, low, high, color=ESTIMATE, alpha=0.25, linewidth=0)
        axes.plot(x, [channel.fit.mean + level] * 2, color=ESTIMATE)
    for change in train.changes:
        axes.axvline(change.day - 0.5, color=BAD, linewidth=1.0)


def _segments(
    changes: Sequence[Change], edges: Sequence[int], k: int, channel: ChannelView, number: int
) -> list[tuple[int, int, float, float]]:
    """Return start, end, level and standard deviation of each part between changes."""
    first = changes[0].steps[k] if changes else None
    level = first.before if first else Level(float(channel.fit.train[number]), float(channel.fit.train_std[number]))
    found = [(edges[0], edges[1], *level)]
    for i, change in enumerate(changes):
        if (step := change.steps[k]) is not None:
            found.append((edges[i + 1], edges[i + 2], *step.after))
    return found


def _fleet_band(axes: Axes, channel: ChannelView, days: int) -> None:
    """Draw mean and ±2 standard deviations of the trains."""
    mean, spread = channel.fit.mean, _SIGMAS * channel.fit.stds['train']
    axes.fill_between([-0.5, days - 0.5], mean - spread, mean + spread, color=GRID, alpha=0.6)


def _label(axes: Axes, channel: ChannelView) -> None:
    unit = f' [{channel.channel.unit}]' if channel.channel.unit else ''
    axes.set_title(f'{channel.channel.title}{unit}')


def _days(axes: Axes, days: Sequence[str]) -> None:
    every = max(1, -(-len(days) // _MOST_TICKS))
    axes.set_xticks(range(0, len(days), every), days[::every])
    axes.set_xlim(-0.5, len(days) - 0.5)
