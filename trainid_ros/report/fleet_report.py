# SPDX-License-Identifier: Apache-2.0
"""Report of a fleet: the trains that stand out, then a page per train."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

from trainid_ros.fleet.mixed_model import LEAST_TRAINS
from trainid_ros.interface.text import pluralise
from trainid_ros.report.fleet_figures import common_over_days, fleet_over_days, train_over_days
from trainid_ros.report.page import bullets, captioned, facts_list, page
from trainid_ros.report.tables import html_table
from trainid_ros.report.words import plus_minus

if TYPE_CHECKING:
    from collections.abc import Mapping

    from trainid_ros.fleet.analysis import ChannelView, FleetView, LevelOutlier, TrainView
    from trainid_ros.fleet.changes import Departure

MOST_PAGES: Final = 60
"""Trains with a page of their own: those that stand out, and of the others the first."""
_FOOTER: Final = (
    'Values are less what trains have in common on a day, a line and in a weather. Points: mean of a day and its '
    'standard deviation; line and band: level of the train ± 2 standard deviations; grey: ± 2 standard deviations of '
    'the trains of the fleet.'
)
# Channels of a change that are worth a line: ln of their Bayes factor.
_TELLING: Final = 3.0


def fleet_page(view: FleetView, tables: str, limit: float, notes: Mapping[str, tuple[str, ...]]) -> str:
    """Return the report as HTML text.

    Args:
        view: What was found.
        tables: Names of the tables.
        limit: Train-days for one false alarm.
        notes: Further sentences by name of the train, such as what ``explain`` found in its bags.
    """
    shown = view.trains[: max(MOST_PAGES, len(view.found))]
    body = _head(view, tables, limit) + _ranking(view) + _spread_table(view) + _overview(view)
    return page('trainid fleet report', body + ''.join(_train(view, train, notes) for train in shown), _FOOTER)


def summary(view: FleetView) -> str:
    """Return the outcome in one sentence."""
    trains = pluralise(len(view.trains), 'train')
    few = (
        f' Of fewer than {LEAST_TRAINS} trains the weather of a day cannot be told from a dragging brake.'
        if len(view.trains) < LEAST_TRAINS
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


def _head(view: FleetView, tables: str, limit: float) -> str:
    labels = view.labels
    facts = (
        ('Tables', tables),
        ('Trains', str(len(labels.trains))),
        ('Days', f'{len(labels.days)}, {labels.days[0]} to {labels.days[-1]}'),
        ('Runs', ', '.join(f'{v.channel.title} {v.cells.value.size}' for v in view.channels)),
        ('False alarms', f'at most one in {limit:.0f} train-days, if the model holds'),
    )
    return facts_list(facts) + f'<h2>{escape(summary(view))}</h2>'


def _ranking(view: FleetView) -> str:
    rows = [
        (
            f'<a href="#train-{train.number}">{escape(train.name)}</a>',
            escape(' '.join(findings(view, train))),
            f'{train.evidence:.0f}',
        )
        for train in view.found
    ]
    caption = 'Trains that stand out; evidence is the natural logarithm of the odds of a change'
    return html_table(caption, ('train', 'what', 'evidence'), rows, text_columns=2) if rows else ''


def _spread_table(view: FleetView) -> str:
    """Return the table of what the values vary by."""
    names = tuple(dict.fromkeys(name for v in view.channels for name in v.fit.stds if name != 'stated'))
    rows = [(escape(v.channel.title), *_spread(v, names)) for v in view.channels]
    head = ('channel', 'mean', *names, 'stated std counts', 'degrees of freedom')
    return html_table('Mean of the fleet, and standard deviations of what it varies by', head, rows)


def _spread(view: ChannelView, names: tuple[str, ...]) -> tuple[str, ...]:
    stds = (f'{view.fit.stds[name]:.2g}' if name in view.fit.stds else '–' for name in names)
    return (f'{view.fit.mean:.4g}', *stds, f'{view.fit.stds["stated"]:.0%}', f'{view.fit.degrees:g}')


def _overview(view: FleetView) -> str:
    return captioned(
        (
            ('All trains', 'Less what trains have in common; those that stand out in colour.', fleet_over_days(view)),
            ('What trains have in common', 'Weather, wind and so on: no train stands out by it.',
             common_over_days(view)),
        )
    )  # fmt: skip


def _train(view: FleetView, train: TrainView, notes: Mapping[str, tuple[str, ...]]) -> str:
    lines = (*findings(view, train), *notes.get(train.name, ())) or ('Nothing stands out.',)
    return (
        f'<section><h2 id="train-{train.number}">Train {escape(train.name)}</h2>{bullets(lines)}'
        f'<figure>{train_over_days(view, train)}</figure></section>'
    )
