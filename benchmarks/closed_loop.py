# SPDX-License-Identifier: Apache-2.0
"""Stops of an ATO with the values of the train file, stronger feedback, learning, live estimates, and the truth.

Random days on three lines; the days are the same for all controllers. See ``ato.days``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ato.days import CONTROLLERS, DayPlan, Drive, drive_day, plan_day
from ato.stop_report import WINDOW
from benchmarks.seeds import over_seeds
from benchmarks.tables import Plot, Table

Array = NDArray[np.float64]
# Lines, and runs from stop to stop on a day.
_LINES: Final = (('metro', 6), ('emu', 4), ('tram', 10))
# Seeds from here on were not used during development.
_FIRST_SEED: Final = 9001
# Controllers that also drive days whose brake rate changes over speed, which no train file states; the mark of these.
_ALSO: Final = ('nominal', 'rate_fast', 'live', 'truth')
_SHAPED: Final = '*'
# Stops after a sudden change of the brake that are counted.
_AFTER: Final = 3


@dataclass(frozen=True, slots=True)
class Trial:
    """A day of a world with a controller; ``shaped`` if the brake rate changes over speed."""

    world: str
    runs: int
    controller: str
    seed: int
    shaped: bool = False

    @property
    def line(self) -> str:
        return self.world + _SHAPED * self.shaped


@dataclass(frozen=True, slots=True)
class Outcome:
    drive: Drive  # The drive
    after: tuple[float, ...]  # Errors of the first stops after each sudden change of the brake [m]
    unknown: tuple[bool, ...]  # For each bound, whether the brake has changed since the last stop, unknown to all
    surprised: tuple[bool, ...]  # For each stop, whether the brake has changed while the train braked to it


def measure(seeds: int) -> tuple[Table | Plot, ...]:
    """Return tables and a plot over as many days on each of the three lines."""
    trials = [
        Trial(world, runs, controller, _FIRST_SEED + k, shaped)
        for shaped, controllers in ((False, CONTROLLERS), (True, _ALSO))
        for world, runs in _LINES
        for controller in controllers
        for k in range(seeds)
    ]
    chosen: Chosen = {}
    for trial, outcome in zip(trials, over_seeds(run, trials, 'closed_loop'), strict=True):
        chosen.setdefault((trial.line, trial.controller), []).append(outcome)
    return (_stops(chosen), _rides(chosen), _bounds(chosen), _plot(chosen))


def run(trial: Trial) -> Outcome:
    plan = plan_day(trial.world, trial.runs, np.random.default_rng(trial.seed), shaped=trial.shaped)
    return outcome_of(plan, drive_day(plan, trial.controller, trial.seed))


def outcome_of(plan: DayPlan, drive: Drive) -> Outcome:
    """Return a drive with what the sudden changes of the brake have to do with it."""
    after = []
    for event_s in plan.events_s:
        later = [arrival.error for arrival in drive.arrivals if arrival.time_s > event_s]
        after += later[:_AFTER]
    unknown = tuple(plan.changes(_last_stop(drive, row.time_s), row.time_s) for row in drive.bounds)
    return Outcome(drive, tuple(after), unknown, plan.surprised(drive))


def _last_stop(drive: Drive, time_s: float) -> float:
    """Return the time of the last stop before a time [s]."""
    return max((arrival.time_s for arrival in drive.arrivals if arrival.time_s < time_s), default=0.0)


Chosen = dict[tuple[str, str], list[Outcome]]


def _errors(outcomes: Sequence[Outcome]) -> Array:
    return np.concatenate([outcome.drive.errors for outcome in outcomes])


def _p95(errors: Array) -> float:
    return float(np.quantile(np.abs(errors), 0.95))


def _stops(chosen: Chosen) -> Table:
    rows = []
    for (world, controller), outcomes in chosen.items():
        errors = _errors(outcomes)
        nominal, truth = (_p95(_errors(chosen[world, other])) for other in ('nominal', 'truth'))
        closed = (nominal - _p95(errors)) / (nominal - truth)
        after = np.array([error for outcome in outcomes for error in outcome.after])
        good = np.abs(errors) <= WINDOW
        usual = ~np.array([changed for outcome in outcomes for changed in outcome.surprised])
        rows.append(
            (
                world,
                controller,
                str(errors.size),
                f'{errors.mean():+.3f}',
                f'{errors.std():.3f}',
                f'{_p95(errors):.3f}',
                f'{good.mean():.1%}',
                f'{good[usual].mean():.1%} of {good[usual].size}',
                f'{closed:.0%}',
                f'{np.abs(after).mean():.3f}' if after.size else '-',
            )
        )
    sizes = ('mean, m', 'sd, m', 'p95, m', 'within .30 m', 'brake steady', 'gap closed', 'after a change, m')
    header = ('line', 'values', 'stops', *sizes)
    note = (
        'Nominal: values of the train file; fast: the same with four times the integral action; learning: fast, with a '
        'bias learned from the last stops; rate: nominal, with a brake rate learned from the last stops; rate_fast: '
        'fast, with that rate. Errors of the stops, > 0 beyond them; p95 of their size. Brake steady: within .30 m, of '
        'the stops during whose braking no rain began and no brake unit was isolated. Gap closed: of '
        'the p95 between nominal and truth. After a change: mean size of the first '
        f'{_AFTER} errors after rain begins or a brake unit is isolated. These come at given times of the day, so '
        'controllers that drive faster or slower meet them in different brakings. '
        f'{_SHAPED}: the brake rate also changes over '
        'speed, which no train file states: from standstill to full speed with a standard deviation of .08, at the '
        'changeover between brakes of .06.'
    )
    return Table('Stops', header, tuple(rows), note)


def _rides(chosen: Chosen) -> Table:
    rows = []
    for (world, controller), outcomes in chosen.items():
        drives = [outcome.drive for outcome in outcomes]
        truth = [outcome.drive for outcome in chosen[world, 'truth']]
        energy = sum(drive.energy_kwh for drive in drives) / sum(drive.energy_kwh for drive in truth)
        time = sum(drive.duration_s for drive in drives) / sum(drive.duration_s for drive in truth)
        jerk = _root_mean([drive.jerk for drive in drives]) / _root_mean([drive.jerk for drive in truth])
        rows.append(
            (
                world,
                controller,
                f'{energy - 1.0:+.1%}',
                f'{time - 1.0:+.1%}',
                f'{jerk - 1.0:+.1%}',
                f'{np.mean([drive.jerk_p999 for drive in drives]):.2f}',
                f'{np.mean([drive.final_deceleration for drive in drives]):.2f}',
                f'{_root_mean([drive.tracking for drive in drives]):.2f}',
                f'{max(drive.overspeed for drive in drives):.2f}',
            )
        )
    jerks = ('rms jerk', 'jerk 99.9 %, m/s^3', 'final braking, m/s^2')
    columns = ('energy', 'time', *jerks, 'speed error, m/s', 'overspeed, m/s')
    header = ('line', 'values', *columns)
    note = (
        'Energy, time and jerk relative to those with the truth. Jerk: from departures to standstills, both included, '
        'as means of 0.2 s. Final braking: deceleration just before the train comes to rest, which then ends at once: '
        'the controller has no soft stop. Speed error: root mean square of the true speed less the one that limits, '
        'their margin and the braking curves to lower limits allow, while the controller regulates to that. Most of it '
        "is the controller's own, which stays below the curves by up to that margin. "
        'Overspeed: the highest of all days above a limit.'
    )
    return Table('Rides', header, tuple(rows), note)


def _root_mean(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _bounds(chosen: Chosen) -> Table:
    rows = []
    for (world, controller), outcomes in chosen.items():
        if controller != 'live':
            continue
        rows_of = [row for outcome in outcomes for row in outcome.drive.bounds]
        inside = np.array([row.distance <= row.bound for row in rows_of])
        live = np.array([row.is_live for row in rows_of])
        unknown = np.array([changed for outcome in outcomes for changed in outcome.unknown])
        margin = float(np.median([row.bound / row.distance for row in rows_of])) - 1.0
        groups = (np.ones_like(live), live, ~live, live & ~unknown, live & unknown)
        rows.append((world, *(_share(inside[group]) for group in groups), f'{margin:+.1%}'))
    shares = ('stopped within the 95 % bound', 'live', 'train file', 'live, known brake', 'live, changed brake')
    header = ('line', *shares, 'median margin')
    note = (
        'Stopping distance that the client states at 95 % confidence when the braking to a stop begins, against that '
        'of a copy of the train which keeps one brake command; share and number of brakings. The client is asked with '
        'the true gradient halfway to where the copy stops. Live: as the client says, also with the last valid values '
        'while a change is suspected; train file: the others, most of them before the estimates are first valid. '
        'Changed brake: rain began or a brake unit was isolated since the last stop, which no braking has shown yet; '
        'known brake: all others.'
    )
    return Table('Bounds of the stopping distance', header, tuple(rows), note)


def _share(inside: NDArray[np.bool_]) -> str:
    return f'{inside.mean():.1%} of {inside.size}' if inside.size else '-'


def _plot(chosen: Mapping[tuple[str, str], list[Outcome]]) -> Plot:
    """Return the distribution of the errors of the stops by line and controller."""
    figure = Figure(figsize=(9.0, 3.4), layout='constrained')
    panels = figure.subplots(1, len(_LINES), sharey=True)
    for axes, (world, _) in zip(panels, _LINES, strict=True):
        for controller in CONTROLLERS:
            sizes = np.sort(np.abs(_errors(chosen[world, controller])))
            axes.plot(sizes, np.arange(1, sizes.size + 1) / sizes.size, label=controller)
        axes.axvline(WINDOW, color='0.5', linestyle=':')
        axes.set_xscale('log')
        axes.set_xlim(0.01, 10.0)
        axes.set_xlabel('size of the stop error, m')
        axes.set_title(world)
    panels[0].set_ylabel('share of the stops')
    panels[0].legend()
    note = 'Share of the stops with an error up to a size; the dotted line is the window of 0.30 m.'
    return Plot('closed_loop_stops', 'Errors of the stops', figure, note)
