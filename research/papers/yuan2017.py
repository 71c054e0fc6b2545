# SPDX-License-Identifier: Apache-2.0
"""Yuan et al. 2017 (AM-VFF-RLS): its algorithm on station lines, compared with bounds and corrections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.tables import Plot, Table
from research.papers.line_scores import (
    Score,
    acceleration,
    identify,
    lost,
    moving,
    nees,
    over_bound,
    rms,
    score,
    true,
)
from research.papers.lockstep import ManyIntegral, Track
from research.papers.station_lines import LONG_CRUISE, NOISES, ONE_RUN, Lines, Noise, measured, station_lines
from research.papers.yuan_claims import claims_table
from research.papers.yuan_methods import (
    P0,
    PRINTED,
    THETA0,
    Auxiliary,
    Named,
    all_methods,
    am_tuning,
    am_vff,
    ekf,
    oracle,
    paper,
    scaled,
)
from trainid_lab.speed_model import integral_rls
from trainid_lab.speed_model.rls import NO_CLAMP
from trainid_lab.speed_model.speed_model_ekf import ekf_tuning

Array = NDArray[np.float64]

_FIRST_SEED: Final = 5000
_LINES_PER_SEED: Final = 200.0 / 60.0
_WHITE: Final = NOISES[0]
_CRUISE_LINES: Final = 20


@dataclass(frozen=True, slots=True)
class Target:
    """A target: the limit and the values reached by method."""

    name: str
    limit: float
    reached: dict[str, float]

    def row(self) -> tuple[str, ...]:
        """Return the row of the table."""
        met = ', '.join(f'{method}: {"yes" if value <= self.limit else "NO"}' for method, value in self.reached.items())
        values = ', '.join(f'{method} {value:.3g}' for method, value in self.reached.items())
        return self.name, f'<= {self.limit:g}', values, met


def measure(seeds: int) -> list[Table | Plot]:
    """Return all tables and plots; 60 seeds are 200 lines."""
    count = max(12, round(seeds * _LINES_PER_SEED))
    chosen = range(_FIRST_SEED, _FIRST_SEED + count)
    lines = station_lines(chosen)
    tracks = {noise.name: _drive_all(lines, noise, chosen) for noise in NOISES}
    scores = {noise: {name: score(lines, track) for name, track in by.items()} for noise, by in tracks.items()}
    bounds, bound_targets = _bound_table(chosen)
    cruise, cruise_target = _cruise_table()
    targets = [*_ordering_targets(scores), *bound_targets, cruise_target, _standstill_target(lines, tracks)]
    return [
        Table('Targets', ('', 'limit', 'reached', 'met?'), tuple(target.row() for target in targets), _TARGET_NOTE),
        claims_table(lines, tracks[_WHITE.name], scores, chosen),
        _lost_table(lines, chosen),
        *(_ordering_table(noise, scores[noise.name], count) for noise in NOISES),
        _consistency_table(lines, tracks),
        bounds,
        cruise,
        step_plot(lines, tracks[_WHITE.name]),
        error_plot(lines, tracks[_WHITE.name]),
    ]


_TARGET_NOTE: Final = (
    'Ratios are of medians or 95th percentiles over all lines. "VFF-RLS" has the sigma with the least one-step error '
    'for each noise. The integral RLS has a target of its own only.'
)


def _drive_all(lines: Lines, noise: Noise, seeds: Sequence[int]) -> dict[str, Track]:
    y = measured(lines, noise, seeds)
    tracks = {named.name: named.drive(lines, y) for named in all_methods(noise)}
    return tracks | {_ORACLE: oracle(lines, y)}


_ORACLE: Final = 'oracle: true theta, raw y'
_PRODUCT: Final = ('AM-VFF-RLS', 'EKF')


def _ordering_table(noise: Noise, scores: dict[str, Score], count: int) -> Table:
    header = (
        noise.name, 'one step, m/s', 'x ahead', '5 s median', '5 s p95', '30 s median', '30 s p95', 'b1 %', 'R18 mm/s2',
        'step 1130', '1160', '1200', 'lost',
    )  # fmt: skip
    note = (
        f'{count} lines. "x ahead": predicted minus true speed, rms. 5 s, 30 s: free run with true force from the own '
        'state [m/s]. R18: resistance at 18 m/s with the gradient. Step: acceleration error [mm/s2] after the change '
        'of d0 at 1100-1130. Lost: share of lines.'
    )
    return Table(f'Ordering, {noise.name}', header, tuple(_ordering_row(*item) for item in scores.items()), note)


def _ordering_row(name: str, s: Score) -> tuple[str, ...]:
    speeds = (s.error, s.ahead, *s.five, *s.thirty)
    return (
        name,
        *(f'{v:.4f}' if v < 100.0 else 'diverged' for v in speeds),
        f'{s.b1:.2f}',
        f'{s.r18:.1f}',
        *(f'{v:.1f}' for v in s.step),
        f'{s.lost:.1%}',
    )


def _ordering_targets(scores: dict[str, dict[str, Score]]) -> list[Target]:
    white = scores[_WHITE.name]
    vff, best = white['VFF-RLS'], white[_ORACLE]

    def each(name: str, limit: float, ratio: str) -> Target:
        kinds: dict[str, Callable[[str], float]] = {
            'median over VFF': lambda m: white[m].five[0] / vff.five[0],
            'median over oracle': lambda m: white[m].five[0] / best.five[0],
            'p95 over VFF': lambda m: white[m].five[1] / vff.five[1],
            'missing': lambda m: scores['10 % missing'][m].five[0] / white[m].five[0],
            'outliers': lambda m: scores['5 % outliers'][m].five[0] / white[m].five[0],
            'lost': lambda m: sum(by[m].lost for by in scores.values()),
            'step': lambda m: white[m].step[1],
            'AR(1)': lambda m: scores['AR(1) .9, .02'][m].five[0] / scores['AR(1) .9, .02']['VFF-RLS'].five[0],
            'ahead': lambda m: white[m].ahead / _WHITE.std,
        }
        return Target(name, limit, {method: float(kinds[ratio](method)) for method in _PRODUCT})

    return [
        each('5 s median over VFF-RLS', 0.45, 'median over VFF'),
        each('5 s median over oracle', 1.3, 'median over oracle'),
        each('5 s p95 over VFF-RLS', 0.35, 'p95 over VFF'),
        each('one step ahead, rms over the noise', 0.5, 'ahead'),
        each('10 % missing over clean, 5 s median', 1.1, 'missing'),
        each('5 % outliers over clean, 5 s median', 1.4, 'outliers'),
        each('share of lines lost, all noises', 0.0, 'lost'),
        each('AR(1) noise, 5 s median over VFF-RLS', 0.85, 'AR(1)'),
        each('6 s after the change of d0 [mm/s2]', 5.0, 'step'),
    ]


def _lost_table(lines: Lines, seeds: Sequence[int]) -> Table:
    """Return the table of section 2 of the notes: does (7) work as printed?"""
    outliers, missing = NOISES[4], NOISES[3]
    cases = [(_WHITE, 8.0), (_WHITE, 25.0), (_WHITE, 75.0), (missing, 75.0), (outliers, 250.0), (outliers, 2500.0)]
    rows = []
    for noise, scale in cases:
        y, variance = measured(lines, noise, seeds), noise.declared**2
        kinds = (
            paper('', variance, 0.0, scale, NO_CLAMP),
            paper('', variance, 1.0, scale, NO_CLAMP),
            paper('', variance, 0.0, scale),
            am_vff(variance),
        )
        rows.append((f'{noise.name}, sigma {scale:g}', *(_shares(lines, kind.drive(lines, y)) for kind in kinds)))
    header = (
        'share of lines',
        'AM-VFF-RLS as printed',
        'VFF-RLS as printed',
        'AM-VFF, lambda >= .9',
        'AM-VFF-RLS ours',
    )
    note = (
        'Lambda <= 0 at some sample / lost. sigma of (6) in units of the speed variance; (7) in its computable order.'
    )
    return Table('Does (7) work as printed?', header, tuple(rows), note)


def _shares(lines: Lines, track: Track) -> str:
    negative = (track.factor <= 0.0).any(axis=0).mean()
    return f'{negative:.2f} / {lost(lines, track).mean():.2f}'


def _bound_table(seeds: Sequence[int]) -> tuple[Table, list[Target]]:
    """Return the table of section 4: one run with constant parameters, errors over the Cramer-Rao bound."""
    lines = station_lines(seeds, ONE_RUN)
    y, variance = measured(lines, _WHITE, seeds), _WHITE.std**2
    run = identify(lines, y, _WHITE.std)
    wide = scaled(P0, 1e4)
    nothing = ekf_tuning(0.0, 0.0, 0.0, 1e3)
    still = replace(am_tuning(drift=0.0, load=0.0), gate=1e3)
    ratios = {
        'least squares on one step, (5)': over_bound(run, run.one_step),
        'least squares on 25 samples': over_bound(run, run.integral),
        'maximum likelihood': over_bound(run, run.fitted),
        'EKF, no drift': over_bound(run, _at_end(lines, y, Auxiliary('', nothing, variance, wide))),
        'AM-VFF-RLS, no drift': over_bound(run, _at_end(lines, y, Auxiliary('', still, variance, wide))),
        'integral-RLS, fleet prior': over_bound(run, _at_end(lines, y, _integral_still(variance))),
    }
    rows = tuple((name, *(f'{v:.2f}' for v in values)) for name, values in ratios.items())
    relative = np.median(run.bound[:, :4] / np.abs(run.theta - (0.0, 1.0, 0.0, 0.0)), axis=0)
    note = (
        f'{len(seeds)} runs, white noise {_WHITE.std} m/s; root mean square error over the bound, rows 1 to 5 without '
        f'prior. The bound is {relative[0]:.0%} of a1, {relative[1]:.0%} of a2 - 1, {relative[2]:.2%} of b1, '
        f'{relative[3]:.0%} of d0 and {1e3 * float(np.median(run.bound[:, 4])):.2f} mm/s2 at 18 m/s. b1 has a '
        'bias due to Euler steps.'
    )
    table = Table('One run: error over the Cramer-Rao bound', ('', 'a1', 'a2', 'b1', 'd0', 'R18'), rows, note)
    scored = [0, 1, 3, 4]
    exact = ('maximum likelihood', 'EKF, no drift', 'AM-VFF-RLS, no drift')
    return table, [
        Target('error over CRB, largest of a1, a2, d0, R18', 1.1, {n: float(ratios[n][scored].max()) for n in exact}),
        Target(
            'the same, changes over 25 samples', 1.5, {n: float(ratios[n][scored].max()) for n in list(ratios)[1:6:4]}
        ),
    ]


def _integral_still(variance: float) -> Named:
    tuning = integral_rls.Tuning(25, 1, 0.3, 4.0, 0.0, 0.0, 0.0)
    return Named('', ManyIntegral(THETA0, P0, tuning, variance), freeze=True)


def _at_end(lines: Lines, y: Array, method: Named | Auxiliary) -> Array:
    """Return theta at the last sample above the least speed, shape (lines, 4)."""
    track = method.drive(lines, y)
    ends = [int(np.nonzero(column >= 0.5)[0][-1]) for column in y.T]
    return np.stack([track.state[end, 1:, k] for k, end in enumerate(ends)])


def _cruise_table() -> tuple[Table, Target]:
    """Return the table of section 5: one-step error at the first braking after 16 minutes of cruise."""
    seeds = range(_FIRST_SEED, _FIRST_SEED + _CRUISE_LINES)
    lines = station_lines(seeds, LONG_CRUISE)
    y, variance = measured(lines, _WHITE, seeds), _WHITE.std**2
    onset = [int(np.argmax((lines.u[:, k] < -20.0) & (np.arange(len(lines.u)) > 4000))) for k in range(len(seeds))]
    kinds = (
        paper('VFF-RLS', variance, 1.0, 250.0), paper(PRINTED, variance, 0.0, 75.0), ekf(variance), am_vff(variance),
    )  # fmt: skip
    rows, ratios = [], {}
    for kind in kinds:
        wrong = kind.drive(lines, y).predicted - lines.x
        cruise = rms(np.concatenate([wrong[n - 1500 : n - 10, k] for k, n in enumerate(onset)]))
        braking = rms(np.concatenate([wrong[n : n + 25, k] for k, n in enumerate(onset)]))
        ratios[kind.name] = braking / cruise
        rows.append((kind.name, f'{cruise:.4f}', f'{braking:.4f}', f'{braking / cruise:.2f}'))
    header = ('predicted minus true speed, rms m/s', 'cruise', 'first 5 s of braking', 'ratio')
    table = Table('Braking after a long cruise', header, tuple(rows), f'{len(seeds)} lines.')
    return table, Target('brake onset over cruise', 1.3, {name: ratios[name] for name in _PRODUCT})


def _standstill_target(lines: Lines, tracks: dict[str, dict[str, Track]]) -> Target:
    """Return the target for samples at rest for more than two seconds: theta must be constant."""
    rest = lines.x == 0.0
    long = rest[:-1] & rest[1:]
    for n in range(1, 10):
        long[n:] &= rest[:-1][: len(long) - n]
    long[:10] = False

    def moved(track: Track) -> float:
        change = np.abs(np.diff(track.state[:, 1:], axis=0)).max(axis=1)
        return float(np.nanmax(change[long]))

    largest = {name: max(moved(by[name]) for by in tracks.values()) for name in _PRODUCT}
    return Target('largest change of a parameter at standstill', 0.0, largest)


def _consistency_table(lines: Lines, tracks: dict[str, dict[str, Track]]) -> Table:
    mask = moving(lines)
    rows = []
    for noise in NOISES:
        for name in ('AM-VFF-RLS', 'EKF', 'integral-RLS'):
            track = tracks[noise.name][name]
            values = nees(lines, track)
            nis = track.nis[mask & np.isfinite(track.nis)]
            within = float(np.mean(values * 4.0 < 9.488))
            nis_text = f'{nis.mean():.2f}' if len(nis) else '-'
            rows.append(
                (f'{noise.name}: {name}', nis_text, f'{np.median(values):.2f}', f'{values.mean():.2f}', f'{within:.0%}')
            )
    header = ('ideal: 1, .84, 1, 95 %', 'NIS', 'NEES/4 median', 'NEES/4 mean', 'inside 95 %')
    note = (
        'All samples in motion, including those after unknown changes of the gradient, so tails are heavy. NIS: '
        'squared prediction error over its reported variance. NEES: of all four parameters.'
    )
    return Table('Consistency of the reported variances', header, tuple(rows), note)


def step_plot(lines: Lines, tracks: dict[str, Track]) -> Plot:
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    in_motion = moving(lines)[1095:1201].all(axis=0)
    n = np.arange(1080, 1260)
    for name in ('VFF-RLS', PRINTED, 'EKF', 'AM-VFF-RLS'):
        state = np.moveaxis(tracks[name].state, 1, 0)
        wrong = acceleration(state[1:], lines.x, lines.u) - acceleration(true(lines), lines.x, lines.u)
        axes.plot(n, 1e3 * np.median(np.abs(wrong[n][:, in_motion]), axis=1), label=name)
    axes.set_xlabel('sample')
    axes.set_ylabel('median |error of acceleration|, mm/s²')
    axes.legend()
    note = (
        'The gradient falls by 6.5 per mille at samples 1100 to 1130 without being reported; white noise of 0.02 m/s.'
    )
    return Plot('yuan2017_step', 'Tracking a change of d0', figure, note)


def error_plot(lines: Lines, tracks: dict[str, Track]) -> Plot:
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    blocks = np.arange(0, len(lines.x) - 99, 100)
    for name in ('VFF-RLS', 'AM-RLS', PRINTED, 'EKF', 'AM-VFF-RLS'):
        wrong = np.where(moving(lines, 1), (tracks[name].predicted - lines.x) ** 2, np.nan)
        axes.plot(blocks + 50, [math.sqrt(float(np.nanmedian(wrong[b : b + 100]))) for b in blocks], label=name)
    axes.set_yscale('log')
    axes.set_xlabel('sample')
    axes.set_ylabel('median |predicted minus true speed|, m/s')
    axes.legend()
    note = 'As Fig. 5 of the paper, against the true speed instead of the measured one; white noise of 0.02 m/s.'
    return Plot('yuan2017_errors', 'Errors of the algorithms over time', figure, note)
