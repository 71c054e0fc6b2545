# SPDX-License-Identifier: Apache-2.0
"""Report of a fleet: the trains that stand out, what they have in common, then a section per train."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from markupsafe import Markup

from trainid_ros.fleet.changes import Level
from trainid_ros.fleet.mixed_model import MIN_TRAINS
from trainid_ros.interface.text import pluralise
from trainid_ros.report.page import (
    BAD,
    BRAKE,
    ESTIMATE,
    GRID,
    INK,
    MUTED,
    SECOND,
    TRACTION,
    Table,
    render,
    styled_figure,
    to_svg,
)
from trainid_ros.report.words import DASH, plus_minus

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from trainid_ros.fleet.analysis import ChannelView, FleetView, LevelOutlier, TrainView
    from trainid_ros.fleet.changes import Change, Departure

MAX_PAGES: Final = 60
"""Trains with a page of their own: those that stand out, and of the others the first."""
# Channels of a change that are worth a line: ln of their Bayes factor.
_TELLING: Final = 3.0
_NAMED: Final = (BAD, BRAKE, SECOND, TRACTION, ESTIMATE)
_SIGMAS: Final = 2.0
_MAX_LINES: Final = 200
_MAX_TICKS: Final = 8


def fleet_page(view: FleetView, tables: str, limit: float, notes: Mapping[str, tuple[str, ...]]) -> str:
    """Return the report as HTML text.

    Args:
        view: What was found.
        tables: Names of the tables.
        limit: Train-days for one false alarm.
        notes: Further sentences by name of the train, such as what ``explain`` found in its bags.
    """
    shown = view.trains[: max(MAX_PAGES, len(view.found))]
    return render(
        'fleet.html.j2',
        'trainid fleet report',
        facts=_facts(view, tables, limit),
        summary=summary(view),
        tables=(_ranking(view), _spread_table(view)),
        all_trains=fleet_over_days(view),
        common=common_over_days(view),
        trains=[
            {
                'number': train.number,
                'name': train.name,
                'lines': (*findings(view, train), *notes.get(train.name, ())) or ('Nothing stands out.',),
                'figure': train_over_days(view, train),
            }
            for train in shown
        ],
    )


def summary(view: FleetView) -> str:
    """Return the outcome in one sentence."""
    trains = pluralise(len(view.trains), 'train')
    few = (
        f' Of fewer than {MIN_TRAINS} trains the weather of a day cannot be told from a dragging brake.'
        if len(view.trains) < MIN_TRAINS
        else ''
    )
    few += _left_out(view)
    if not view.found:
        return f'No train of {trains} stands out.{few}'
    verb = 'stands' if len(view.found) == 1 else 'stand'
    return f'{len(view.found)} of {trains} {verb} out: {", ".join(train.name for train in view.found)}.{few}'


def _left_out(view: FleetView) -> str:
    """Return which runs are not compared, '' if all are."""
    if not view.contradicted:
        return ''
    runs = ', '.join(f'{train} ({count})' for train, count in view.contradicted)
    return f' Runs left out as their inputs contradict each other, see the column contradiction: {runs}.'


def findings(view: FleetView, train: TrainView) -> tuple[str, ...]:
    """Return what stands out of a train, one sentence each."""
    lines = [_departure_text(view, departure) for departure in train.departures]
    lines += [_outlier_text(outlier) for outlier in train.outliers]
    if train.causes:
        which = f', of {view.labels.days[train.main.first]}' if train.main and len(train.departures) > 1 else ''
        causes = ', '.join(f'{c.title} ({c.probability:.0%})' for c in train.causes)
        lines.append(f'By the channels alone{which}: {causes}.')
    return tuple(lines)


def _departure_text(view: FleetView, departure: Departure) -> str:
    days = view.labels.days
    steps = [
        f'{v.channel.title} {v.fit.mean + s.before.mean:.4g} to {plus_minus(v.fit.mean + s.after.mean, s.after.std)} '
        f'{v.channel.unit}'
        for v, s in zip(view.channels, departure.steps, strict=True)
        if s is not None and s.evidence > _TELLING
    ]
    what = '; '.join(step.rstrip() for step in steps) or 'in several channels a little'
    until = '' if departure.end is None else f' until {days[departure.end - 1]}'
    if departure.first == 0:
        return f'Different{until}, from the first day on, certain on {days[departure.alarm]}: {what}.'
    return f'Changed on {days[departure.first]}{until}, certain on {days[departure.alarm]}: {what}.'


def _outlier_text(outlier: LevelOutlier) -> str:
    size = plus_minus(outlier.size, outlier.std)
    text = f'{outlier.channel.title} always {size} {outlier.channel.unit}'.rstrip()
    return f'{text} from that of the fleet, {abs(outlier.sigmas):.0f} standard deviations among trains.'


def _facts(view: FleetView, tables: str, limit: float) -> tuple[tuple[str, str], ...]:
    labels = view.labels
    return (
        ('Tables', tables),
        ('Trains', str(len(labels.trains))),
        ('Days', f'{len(labels.days)}, {labels.days[0]} to {labels.days[-1]}'),
        ('Runs', ', '.join(f'{v.channel.title} {v.cells.value.size}' for v in view.channels)),
        ('False alarms', f'at most one in {limit:.0f} train-days, if the model holds'),
    )


def _ranking(view: FleetView) -> Table:
    rows = [
        (
            Markup('<a href="#train-{}">{}</a>').format(train.number, train.name),
            ' '.join(findings(view, train)),
            f'{train.evidence:.0f}',
        )
        for train in view.found
    ]
    caption = 'Trains that stand out; evidence is the natural logarithm of the odds of a change'
    return Table(caption, ('train', 'what', 'evidence'), rows, 2)


def _spread_table(view: FleetView) -> Table:
    """Return the table of what the values vary by."""
    names = tuple(dict.fromkeys(name for v in view.channels for name in v.fit.stds if name != 'stated'))
    rows = [(v.channel.title, *_spread(v, names)) for v in view.channels]
    head = ('channel', 'mean', *names, 'stated std counts', 'degrees of freedom')
    return Table('Mean of the fleet, and standard deviations of what it varies by', head, rows)


def _spread(view: ChannelView, names: tuple[str, ...]) -> tuple[str, ...]:
    stds = (f'{view.fit.stds[name]:.2g}' if name in view.fit.stds else DASH for name in names)
    return (f'{view.fit.mean:.4g}', *stds, f'{view.fit.stds["stated"]:.0%}', f'{view.fit.degrees:g}')


def fleet_over_days(view: FleetView) -> str:
    """Plot each channel of all trains, less what they have in common; those that stand out in colour."""
    with styled_figure(2.1 * len(view.channels)) as figure:
        panels = figure.subplots(len(view.channels), 1, sharex=True, squeeze=False)[:, 0]
        for k, (axes, channel) in enumerate(zip(panels, view.channels, strict=True)):
            _fleet_band(axes, channel, len(view.labels.days))
            for train in view.trains[len(view.found) : _MAX_LINES]:
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
    every = max(1, -(-len(days) // _MAX_TICKS))
    axes.set_xticks(range(0, len(days), every), days[::every])
    axes.set_xlim(-0.5, len(days) - 0.5)
