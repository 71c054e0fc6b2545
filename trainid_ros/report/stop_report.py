# SPDX-License-Identifier: Apache-2.0
"""Report of stops on a simulated day: by the train file, a learned bias, live estimates and the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.report.page import captioned, page
from trainid_ros.report.style import BAD, BRAKE, ESTIMATE, MUTED, SECOND, TRACTION, styled_figure, to_svg
from trainid_ros.report.tables import html_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from trainid_ros.ato.days import DayPlan, Drive

WINDOW: Final = 0.30
"""Largest error of a good stop [m]."""
_COLOURS: Final = {
    'nominal': BAD,
    'fast': BRAKE,
    'learning': SECOND,
    'rate': TRACTION,
    'live': ESTIMATE,
    'truth': MUTED,
}
_FOOTER: Final = (
    'The same controller and the same day with different values: nominal, those of the train file; fast, the same with '
    'four times the integral action; learning, that with a bias learned from the last stops; rate, with a brake rate '
    'learned from them; live, estimates of this service; truth, those of the simulated train.'
)


def stop_page(plan: DayPlan, drives: Mapping[str, Drive]) -> str:
    """Return the report as HTML text; drives by controller."""
    rows = [(name, *_numbers(drive)) for name, drive in drives.items()]
    head = ('values', 'mean, m', 'sd, m', 'largest, m', f'within {WINDOW:.2f} m', 'energy, kWh', 'time, s')
    figures = (
        ('Errors of the stops', 'Above zero beyond the stop; band: ±0.30 m.', _errors_figure(drives)),
        ('Brake rate of the day', 'Actual over commanded braking; dashed: that of the train file.', _rate_figure(plan)),
    )
    return page('trainid demo: stops', html_table('Stops of one day', head, rows) + captioned(figures), _FOOTER)


def stop_lines(drives: Mapping[str, Drive]) -> list[str]:
    """Return the errors in a line of text for each controller."""
    lines = []
    for name, drive in drives.items():
        mean, sd, largest, within, *_ = _numbers(drive)
        lines.append(f'{name:9} mean {mean} m, sd {sd} m, largest {largest} m, within {WINDOW:.2f} m {within}')
    return lines


def _numbers(drive: Drive) -> Sequence[str]:
    errors = drive.errors
    return (
        f'{errors.mean():+.2f}',
        f'{errors.std():.2f}',
        f'{np.abs(errors).max():.2f}',
        f'{np.mean(np.abs(errors) <= WINDOW):.0%}',
        f'{drive.energy:.0f}',
        f'{drive.duration_s:.0f}',
    )


def _errors_figure(drives: Mapping[str, Drive]) -> str:
    with styled_figure(3.0) as figure:
        axes = figure.subplots()
        for name, drive in drives.items():
            at = np.arange(1, drive.errors.size + 1)
            axes.plot(at, drive.errors, color=_COLOURS[name], marker='.', label=name)
        axes.axhspan(-WINDOW, WINDOW, color=MUTED, alpha=0.2, linewidth=0)
        axes.set_yscale('symlog', linthresh=WINDOW)
        axes.yaxis.set_major_formatter('{x:g}')
        axes.set_xlabel('stop')
        axes.set_ylabel('error, m')
        axes.legend(ncols=len(drives))
        return to_svg(figure, 'Errors of the stops of a day')


def _rate_figure(plan: DayPlan) -> str:
    changes = plan.case.scenario.changes
    times = [change.time_s / 60.0 for change in changes]
    rates = [change.brake_rate or np.nan for change in changes]
    with styled_figure(2.0) as figure:
        axes = figure.subplots()
        axes.step(times, rates, where='post', color=BRAKE)
        axes.axhline(plan.case.stated.brake.rate, color=MUTED, linestyle='--')
        axes.set_xlabel('time, min')
        axes.set_ylabel('brake rate')
        return to_svg(figure, 'Brake rate over the day')
