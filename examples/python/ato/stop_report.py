# SPDX-License-Identifier: Apache-2.0
"""Report of stops on simulated days: by the train file, what is learned stop by stop, live estimates, the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.interface.text import pluralise
from trainid_ros.report.page import (
    BAD,
    BRAKE,
    ESTIMATE,
    MUTED,
    SECOND,
    TRACTION,
    WAIT,
    bullets,
    captioned,
    html_table,
    page,
    styled_figure,
    to_svg,
)
from trainid_ros.train.effects import effect_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ato.days import DayPlan, Drive

WINDOW: Final = 0.30
"""Largest error of a good stop [m]."""
LABELS: Final = {
    'nominal': 'train file',
    'fast': 'train file, strong feedback',
    'learning': 'strong feedback, bias learned at stops',
    'rate': 'brake rate learned at stops',
    'rate_fast': 'the same, strong feedback',
    'live': 'live estimates',
    'truth': 'true values',
}
_COLOURS: Final = dict(zip(LABELS, (BAD, BRAKE, SECOND, TRACTION, WAIT, ESTIMATE, MUTED), strict=True))
_FOOTER: Final = (
    'The same controller and the same days with different values. Train file: those of the commissioning; strong '
    'feedback: four times the integral action; learned at stops: from the errors of the last stops, as is usual; live '
    'estimates: those of this service; true values: those of the simulated train, which nobody has.'
)
_ERRORS_CAPTION: Final = (
    'A dot for each stop, a line of dots for each day; right of zero: beyond the stop. Band: ±0.30 m. Circled: the '
    'brake changed during the braking.'
)
_RATE_CAPTION: Final = (
    'Actual over commanded braking, with the true mass. Lines: cold brake; bands: down to the hottest one; '
    'dashed: train file.'
)


@dataclass(frozen=True, slots=True)
class Day:
    """A day and how each of the controllers has driven it."""

    plan: DayPlan
    drives: Mapping[str, Drive]


def stop_page(days: Sequence[Day]) -> str:
    """Return the report of some days as HTML text."""
    sizes = ('mean, m', '95 % within, m', 'largest, m', f'within {WINDOW:.2f} m')
    table = html_table(f'Stops of {pluralise(len(days), "day")}', ('values', *sizes), [*_rows(days)])
    figures = (
        ('Errors of the stops', _ERRORS_CAPTION, _errors_figure(days)),
        ('Brake rate of each day', _RATE_CAPTION, _rate_figure(days)),
    )
    body = table + bullets([*comparison(days), *brake_changes(days)]) + captioned(figures)
    return page('stops of a simulated train', body, _FOOTER)


def errors_of(days: Sequence[Day], name: str) -> NDArray[np.float64]:
    """Return the errors of all stops with a controller, > 0 beyond them [m], shape (n,)."""
    return np.concatenate([day.drives[name].errors for day in days])


def stop_lines(days: Sequence[Day]) -> list[str]:
    """Return the sizes of the errors in a line of text for each controller."""
    return [
        f'{label:38} mean {mean} m, 95 % within {p95} m, largest {largest} m, within {WINDOW:.2f} m {within}'
        for label, mean, p95, largest, within in _rows(days)
    ]


def _rows(days: Sequence[Day]) -> Iterator[tuple[str, str, str, str, str]]:
    for name in days[0].drives:
        size = np.abs(errors_of(days, name))
        mean, p95, largest = (f'{figure:.2f}' for figure in (size.mean(), np.quantile(size, 0.95), size.max()))
        yield LABELS[name], mean, p95, largest, f'{np.mean(size <= WINDOW):.0%}'


def comparison(days: Sequence[Day]) -> list[str]:
    """Return in lines of text which controllers stopped worse than that with live estimates, and which did not."""
    sizes = {name: float(np.abs(errors_of(days, name)).mean()) for name in days[0].drives}
    live = sizes.pop('live')
    others = {f'{LABELS[name]} ({size:.3f} m)': size for name, size in sizes.items()}
    better = '; '.join(name for name, size in others.items() if live < size)
    rest = '; '.join(name for name, size in others.items() if live >= size)
    lines = [f'with live estimates the train stops {live:.3f} m off on average']
    lines += [f'that is better than with: {better}'] if better else []
    return lines + ([f'that is not better than with: {rest}'] if rest else [])


def brake_changes(days: Sequence[Day]) -> list[str]:
    """Return in lines of text, for each day, when the brake changed at once, and during the braking to which stops."""
    lines = []
    for number, (plan, drives) in enumerate(((day.plan, day.drives) for day in days), 1):
        found = [
            f'stop {stop} with {LABELS[name]} ({drive.errors[stop - 1]:+.2f} m)'
            for name, drive in drives.items()
            for stop in changed_stops(plan, drive)
        ]
        times = ' and '.join(f'{event_s / 60.0:.1f} min' for event_s in plan.events_s)
        # With other values, the train may stand or be elsewhere on its way at the same time.
        during = f'while the train braked to {"; ".join(found)}' if found else 'but never in a braking to a stop'
        changed = f'rain began or a brake unit was isolated at {times}, {during}' if times else 'no sudden change'
        lines.append(f'day {number}: {changed}')
    return lines


def changed_stops(plan: DayPlan, drive: Drive) -> list[int]:
    """Return the numbers, from 1, of the stops during whose braking the brake changed at once."""
    return [number for number, changed in enumerate(plan.surprised(drive), 1) if changed]


def _errors_figure(days: Sequence[Day]) -> str:
    names = [*days[0].drives]
    with styled_figure(0.5 + 0.45 * len(names)) as figure:
        axes = figure.subplots()
        for row, name in enumerate(names):
            for number, day in enumerate(days):
                drive, colour = day.drives[name], _COLOURS[name]
                at = np.full(drive.errors.size, row + 0.6 * ((number + 0.5) / len(days) - 0.5))
                axes.plot(drive.errors, at, '.', color=colour)
                changed = np.array(day.plan.surprised(drive))
                axes.plot(drive.errors[changed], at[changed], 'o', color=colour, markersize=9.0, fillstyle='none')
        axes.axvspan(-WINDOW, WINDOW, color=MUTED, alpha=0.2, linewidth=0)
        axes.set_xscale('symlog', linthresh=WINDOW)
        axes.xaxis.set_major_formatter('{x:g}')
        axes.set_xlabel('error, m')
        axes.set_yticks(range(len(names)), [LABELS[name] for name in names])
        axes.invert_yaxis()
        return to_svg(figure, 'Errors of all stops by the values used')


def actual_rates(plan: DayPlan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return actual over commanded braking [1] from each change of the day on, with a cold brake and the hottest."""
    scenario = plan.case.scenario
    effects = scenario.train_file.effects
    # As for the values of the truth: a train heavier than stated brakes less.
    mass_ratio = effect_value(effects, 'mass_error', 'ratio', 1.0)
    cold = np.array([change.brake_rate or np.nan for change in scenario.changes]) / mass_ratio
    return cold, cold * (1.0 - effect_value(effects, 'brake_fade', 'loss', 0.0))


def _rate_figure(days: Sequence[Day]) -> str:
    with styled_figure(2.0) as figure:
        axes = figure.subplots()
        for number, day in enumerate(days, 1):
            times = [change.time_s / 60.0 for change in day.plan.case.scenario.changes]
            cold, hottest = actual_rates(day.plan)
            (line,) = axes.step(times, cold, where='post', label=f'day {number}')
            axes.fill_between(times, hottest, cold, step='post', color=line.get_color(), alpha=0.2, linewidth=0)
        axes.axhline(days[0].plan.case.stated.brake.rate, color=MUTED, linestyle='--')
        axes.set_xlabel('time, min')
        axes.set_ylabel('brake rate')
        axes.legend(ncols=len(days))
        return to_svg(figure, 'Brake rate over each day')
