# SPDX-License-Identifier: Apache-2.0
"""Report of a fleet: the trains that stand out, what they have in common, then a section per train."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, pairwise
from typing import Final

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes

from trainid_ros.fleet.analysis import ChannelView, FleetView, TrainView
from trainid_ros.fleet.changes import Departure, Level
from trainid_ros.fleet.mixed_model import MIN_TRAINS, Array, MixedFit
from trainid_ros.interface.text import in_step, pluralise, plus_minus
from trainid_ros.report import page
from trainid_ros.report.words import DASH

_NAMED: Final = (page.BAD, page.BRAKE, page.SECOND, page.TRACTION, page.ESTIMATE)
_LABELLED: Final = 10  # Trains drawn in colour, with their names
_LINE: Final = 0.09  # Height of a line of text [of axes of 2.1 inch]
_SIGMAS: Final = 2.0


def fleet_page(view: FleetView, tables: str, limit: float, notes: Mapping[str, tuple[str, ...]]) -> str:
    """Return the report as HTML text, with a section of each train that stands out, and of others up to 60.

    ``tables`` are names, ``limit`` the train-days for one false alarm, ``notes`` further sentences by name of train.
    """
    labels = view.labels
    shown = view.trains[: max(60, len(view.found))]
    names = [*dict.fromkeys(name for v in view.channels for name in v.fit.stds if name != 'stated')]
    return page.render(
        'fleet.html.j2',
        'trainid fleet report',
        facts=(
            ('Tables', tables),
            ('Trains', str(len(labels.trains))),
            ('Days', f'{len(labels.days)}, {labels.days[0]} to {labels.days[-1]}'),
            ('Runs', ', '.join(f'{v.channel.title} {v.cells.value.size}' for v in view.channels)),
            ('False alarms', f'at most one in {limit:.0f} train-days, if the model holds'),
        ),
        summary=summary(view),
        ranking=[
            (
                Markup('<a href="#train-{}">{}</a>').format(train.number, train.name),
                ' '.join(findings(view, train)),
                f'{train.evidence:.0f}',
            )
            for train in view.found
        ],
        hidden=view.hidden,
        names=[f'std by {name}' for name in names],
        spread=[(f'{v.channel.title} {v.channel.unit}'.rstrip(), *_spread(v.fit, names)) for v in view.channels],
        all_trains=fleet_over_days(view),
        common=common_over_days(view),
        trains=[
            {
                'number': train.number,
                'name': train.name,
                'lines': (*findings(view, train), *notes.get(train.name, ())) or ('Nothing stands out.',),
                'checks': checks(train),
                'figure': train_over_days(view, train),
            }
            for train in shown
        ],
    )


def summary(view: FleetView) -> str:
    """Return the outcome, and what was not compared."""
    trains = pluralise(len(view.trains), 'train')
    text = f'No train of {trains} stands out.'
    if view.found:
        verb = 'stands' if len(view.found) == 1 else 'stand'
        text = f'{len(view.found)} of {trains} {verb} out: {", ".join(train.name for train in view.found)}.'
    if len(view.trains) < MIN_TRAINS:
        text += f' Of fewer than {MIN_TRAINS} trains the weather of a day cannot be told from a dragging brake.'
    if view.contradicted:
        runs = ', '.join(f'{train} ({count})' for train, count in view.contradicted)
        text += f' Runs left out as their inputs contradict each other, see the column contradiction: {runs}.'
    return text


def findings(view: FleetView, train: TrainView) -> tuple[str, ...]:
    """Return what stands out of a train, one sentence each."""
    lines = [_departure_text(view, departure) for departure in train.departures]
    for outlier in train.outliers:
        size = plus_minus(outlier.size, outlier.std)
        text = f'{outlier.channel.title} always {size} {outlier.channel.unit}'.rstrip()
        lines.append(f'{text} from that of the fleet, {abs(outlier.sigmas):.0f} standard deviations among trains.')
    if train.causes:
        which = f', of {view.labels.days[train.main.first]}' if train.main and len(train.departures) > 1 else ''
        causes = ', '.join(f'{c.title} ({c.probability:.0%})' for c in train.causes)
        lines.append(f'By the channels alone{which}: {causes}.')
    return tuple(lines)


def checks(train: TrainView) -> tuple[str, ...]:
    """Return what to check of a train in the depot, the likeliest cause first."""
    return tuple(dict.fromkeys(f'{cause.title}: {cause.check}.' for cause in train.causes))


def _departure_text(view: FleetView, departure: Departure) -> str:
    days = view.labels.days
    steps = []
    for v, s in zip(view.channels, departure.steps, strict=True):
        if s is not None and s.evidence > 3.0:  # ln of the Bayes factor
            before, _ = in_step(v.fit.mean + s.before.mean, s.after.std)
            after = plus_minus(v.fit.mean + s.after.mean, s.after.std)
            steps.append(f'{v.channel.title} {before} to {after} {v.channel.unit}')
    what = '; '.join(step.rstrip() for step in steps) or 'in several channels a little'
    until = '' if departure.end is None else f' until {days[departure.end - 1]}'
    first = (
        f'Changed on {days[departure.first]}{until}' if departure.first else f'Different{until}, from the first day on'
    )
    return f'{first}, certain on {days[departure.alarm]}: {what}.'


def _spread(fit: MixedFit, names: Sequence[str]) -> tuple[str, ...]:
    stds = (f'{fit.stds[name]:.2g}' if name in fit.stds else DASH for name in names)
    return in_step(fit.mean, fit.stds.get('train', math.nan))[0], *stds, f'{fit.stds["stated"]:.0%}', f'{fit.degrees:g}'


def fleet_over_days(view: FleetView) -> str:
    """Plot each channel of all trains, less what they have in common; those that stand out in colour."""
    named = view.found[:_LABELLED]

    def draw(axes: Axes, k: int, channel: ChannelView) -> None:
        _fleet_band(axes, channel, len(view.labels.days))
        for train in view.trains[len(named) : 200]:
            axes.plot(channel.fit.mean + train.series[k].value, color=page.MUTED, linewidth=0.5, alpha=0.5)
        for train, colour in zip(named, cycle(_NAMED)):
            axes.plot(channel.fit.mean + train.series[k].value, color=colour, marker='.')
        page.keep_room(axes, float(np.median(channel.cells.std)))
        _name_ends(axes, [(t.name, channel.fit.mean + t.series[k].value) for t in named])

    return _over_days(view, 2.1, 'Values of all trains over the days', draw)


def _name_ends(axes: Axes, lines: Sequence[tuple[str, Array]]) -> None:
    """Write the name of each line at its end, none over another."""
    low, high = axes.get_ylim()
    ends = []
    for number, (name, value) in enumerate(lines):
        if (known := value[np.isfinite(value)]).size:
            ends.append(((float(known[-1]) - low) / (high - low), name, _NAMED[number % len(_NAMED)]))
    place = -math.inf
    for at, name, colour in sorted(ends):
        place = max(at, place + _LINE)
        axes.text(1.005, place, name, transform=axes.transAxes, color=colour, va='center', fontsize=8.5)


def common_over_days(view: FleetView) -> str:
    """Plot what trains have in common on each day: the mean of the fleet."""

    def draw(axes: Axes, _: int, channel: ChannelView) -> None:
        cells, days = channel.cells, len(view.labels.days)
        count = np.bincount(cells.day, minlength=days)
        with np.errstate(invalid='ignore', divide='ignore'):
            mean = np.bincount(cells.day, channel.fit.common, days) / count
        axes.plot(mean, color=page.ESTIMATE, marker='.')
        page.keep_room(axes, float(np.median(channel.cells.std)))

    return _over_days(view, 1.6, 'What trains have in common on each day', draw)


def train_over_days(view: FleetView, train: TrainView) -> str:
    """Plot each channel of one train over the days with its levels and the band of the fleet."""

    def draw(axes: Axes, k: int, channel: ChannelView) -> None:
        series = train.series[k]
        _fleet_band(axes, channel, len(view.labels.days))
        at, value = np.arange(series.value.size), channel.fit.mean + series.value
        axes.errorbar(at, value, series.std, fmt='.', color=page.INK, elinewidth=0.8, markersize=4)
        _levels(axes, channel, k, train)
        page.keep_room(axes, float(np.median(channel.cells.std)))

    return _over_days(view, 1.8, f'Train {train.name} over the days', draw)


def _over_days(view: FleetView, height: float, label: str, draw: Callable[[Axes, int, ChannelView], None]) -> str:
    """Return a figure with axes of a height [inch] for each channel, which a function draws."""
    days = view.labels.days
    with page.styled_figure(height * len(view.channels)) as figure:
        panels = page.column_of_axes(figure, len(view.channels))
        for k, (axes, channel) in enumerate(zip(panels, view.channels, strict=True)):
            draw(axes, k, channel)
            unit = f' [{channel.channel.unit}]' if channel.channel.unit else ''
            axes.set_title(f'{channel.channel.title}{unit}')
        every = max(1, -(-len(days) // 8))
        panels[-1].set_xticks(range(0, len(days), every), days[::every])
        panels[-1].set_xlim(-0.5, len(days) - 0.5)
        return page.to_svg(figure, label)


def _levels(axes: Axes, channel: ChannelView, k: int, train: TrainView) -> None:
    """Draw the levels before, between and after the changes with their bands."""
    first = train.changes[0].steps[k] if train.changes else None
    usual = Level(float(channel.fit.train[train.number]), float(channel.fit.train_std[train.number]))
    steps = (change.steps[k] for change in train.changes)
    levels = [first.before if first else usual, *(step.after if step else None for step in steps)]
    edges = [0, *(change.day for change in train.changes), len(train.series[k].value)]
    for (start, end), part in zip(pairwise(edges), levels, strict=True):
        if part is None:
            continue
        level, std = part
        x = np.array([start - 0.5, end - 0.5])
        low, high = channel.fit.mean + level - _SIGMAS * std, channel.fit.mean + level + _SIGMAS * std
        axes.fill_between(x, low, high, color=page.ESTIMATE, alpha=0.25, linewidth=0)
        axes.plot(x, [channel.fit.mean + level] * 2, color=page.ESTIMATE)
    for change in train.changes:
        axes.axvline(change.day - 0.5, color=page.BAD, linewidth=1.0)


def _fleet_band(axes: Axes, channel: ChannelView, days: int) -> None:
    mean, spread = channel.fit.mean, _SIGMAS * channel.fit.stds['train']
    axes.fill_between([-0.5, days - 0.5], mean - spread, mean + spread, color=page.GRID, alpha=0.6)
