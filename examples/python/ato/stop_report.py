# SPDX-License-Identifier: Apache-2.0
"""Report of stops on a simulated day: by the train file, what is learned stop by stop, live estimates, the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

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
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from ato.days import DayPlan, Drive

WINDOW: Final = 0.30
"""Largest error of a good stop [m]."""
_COLOURS: Final = {
    'nominal': BAD,
    'fast': BRAKE,
    'learning': SECOND,
    'rate': TRACTION,
    'rate_fast': WAIT,
    'live': ESTIMATE,
    'truth': MUTED,
}
_FOOTER: Final = (
    'The same controller and the same day with different values: nominal, those of the train file; fast, the same with '
    'four times the integral action; learning, that with a bias learned from the last stops; rate, with a brake rate '
    'learned from them; rate_fast, with that rate and four times the integral action; live, estimates of this service; '
    'truth, those of the simulated train.'
)

_RATE_CAPTION: Final = (
    'Actual over commanded braking, with the true mass. Line: cold brake; band: down to the hottest one; '
    'dashed: train file.'
)


def stop_page(plan: DayPlan, drives: Mapping[str, Drive]) -> str:
    """Return the report as HTML text; drives by controller."""
    rows = [(name, *_numbers(plan, drive)) for name, drive in drives.items()]
    sizes = ('mean, m', 'sd, m', 'largest, m', f'within {WINDOW:.2f} m', 'brake steady')
    table = html_table('Stops of one day', ('values', *sizes, 'energy, kWh', 'time, s'), rows)
    caption = 'Above zero beyond the stop; band: ±0.30 m; circled: the brake changed during the braking.'
    figures = (
        ('Errors of the stops', caption, _errors_figure(plan, drives)),
        ('Brake rate of the day', _RATE_CAPTION, _rate_figure(plan)),
    )
    body = table + bullets([*comparison(drives), *brake_changes(plan, drives)]) + captioned(figures)
    return page('stops of a simulated train', body, _FOOTER)


def stop_lines(plan: DayPlan, drives: Mapping[str, Drive]) -> list[str]:
    """Return the errors in a line of text for each controller."""
    lines = []
    for name, drive in drives.items():
        mean, sd, largest, within, steady, *_ = _numbers(plan, drive)
        errors = f'mean {mean} m, sd {sd} m, largest {largest} m'
        lines.append(f'{name:9} {errors}, within {WINDOW:.2f} m {within}, with a steady brake {steady}')
    return lines


def comparison(drives: Mapping[str, Drive]) -> list[str]:
    """Return in lines of text which controllers stopped worse than that with live estimates, and which did not."""
    sizes = {name: float(np.abs(drive.errors).mean()) for name, drive in drives.items()}
    live = sizes.pop('live')
    others = {f'{name} ({size:.3f} m)': size for name, size in sizes.items()}
    better = ', '.join(name for name, size in others.items() if live < size)
    rest = ', '.join(name for name, size in others.items() if live >= size)
    lines = [f'mean absolute error with live estimates {live:.3f} m; only that with nominal must be larger']
    lines += [f'live estimates stopped better than {better}'] if better else []
    return lines + ([f'live estimates did not stop better than {rest}'] if rest else [])


def brake_changes(plan: DayPlan, drives: Mapping[str, Drive]) -> list[str]:
    """Return in lines of text the stops during whose braking the brake changed at once."""
    found = [
        f'{name} at stop {number} ({drive.errors[number - 1]:+.2f} m)'
        for name, drive in drives.items()
        for number in changed_stops(plan, drive)
    ]
    if not plan.events_s:
        return ['the brake did not change at once on this day']
    # With other values, the train may stand or be elsewhere on its way at the same time.
    without = [name for name, drive in drives.items() if not changed_stops(plan, drive)]
    if found and without:
        found.append(f'not with {", ".join(without)}')
    times = ' and '.join(f'{event_s / 60.0:.1f} min' for event_s in plan.events_s)
    during = f'while the train braked: {", ".join(found)}' if found else 'but never while the train braked to a stop'
    return [f'rain began or a brake unit was isolated at {times}, {during}']


def changed_stops(plan: DayPlan, drive: Drive) -> list[int]:
    """Return the numbers, from 1, of the stops during whose braking the brake changed at once."""
    return [number for number, changed in enumerate(plan.surprised(drive), 1) if changed]


def _numbers(plan: DayPlan, drive: Drive) -> Sequence[str]:
    errors = drive.errors
    steady = np.abs(errors[~np.array(plan.surprised(drive))]) <= WINDOW
    return (
        f'{errors.mean():+.2f}',
        f'{errors.std():.2f}',
        f'{np.abs(errors).max():.2f}',
        f'{np.mean(np.abs(errors) <= WINDOW):.0%}',
        f'{steady.mean():.0%} of {steady.size}' if steady.size else '-',
        f'{drive.energy_kwh:.0f}',
        f'{drive.duration_s:.0f}',
    )


def _errors_figure(plan: DayPlan, drives: Mapping[str, Drive]) -> str:
    with styled_figure(3.0) as figure:
        axes = figure.subplots()
        for name, drive in drives.items():
            at = np.arange(1, drive.errors.size + 1)
            axes.plot(at, drive.errors, color=_COLOURS[name], marker='.', label=name)
            changed = np.array(plan.surprised(drive))
            axes.plot(at[changed], drive.errors[changed], 'o', color=_COLOURS[name], markersize=9.0, fillstyle='none')
        axes.axhspan(-WINDOW, WINDOW, color=MUTED, alpha=0.2, linewidth=0)
        axes.set_yscale('symlog', linthresh=WINDOW)
        axes.yaxis.set_major_formatter('{x:g}')
        axes.set_xlabel('stop')
        axes.set_ylabel('error, m')
        axes.legend(ncols=len(drives))
        return to_svg(figure, 'Errors of the stops of a day')


def actual_rates(plan: DayPlan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return actual over commanded braking [1] from each change of the day on, with a cold brake and the hottest."""
    scenario = plan.case.scenario
    effects = scenario.train_file.effects
    # As for the values of the truth: a train heavier than stated brakes less.
    mass_ratio = effect_value(effects, 'mass_error', 'ratio', 1.0)
    cold = np.array([change.brake_rate or np.nan for change in scenario.changes]) / mass_ratio
    return cold, cold * (1.0 - effect_value(effects, 'brake_fade', 'loss', 0.0))


def _rate_figure(plan: DayPlan) -> str:
    times = [change.time_s / 60.0 for change in plan.case.scenario.changes]
    cold, hottest = actual_rates(plan)
    with styled_figure(2.0) as figure:
        axes = figure.subplots()
        axes.step(times, cold, where='post', color=BRAKE)
        axes.fill_between(times, hottest, cold, step='post', color=BRAKE, alpha=0.2, linewidth=0)
        axes.axhline(plan.case.stated.brake.rate, color=MUTED, linestyle='--')
        axes.set_xlabel('time, min')
        axes.set_ylabel('brake rate')
        return to_svg(figure, 'Brake rate over the day')
