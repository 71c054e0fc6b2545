# SPDX-License-Identifier: Apache-2.0
"""Tables and plots of the experiment of Liu et al. 2018: accuracy of its methods on synthetic coasts."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from benchmarks.tables import Plot, Table
from research.papers import coasts as data
from research.papers.liu_claims import judged
from research.papers.liu_streams import (
    BY_FLAG,
    FAULTS,
    PLANS,
    PREPARATIONS,
    SETTLINGS,
    STREAMS,
    TRACKERS,
    TRUTHS,
    Settling,
    Trial,
)
from research.papers.liu_table1 import FIG2, LENGTHS, PRINTED, WINDOWS, dilution, seen_by
from trainid_lab.resistance.segments import Cutter

_TARGETED: Final = '11 samples, 50 % overlap, LS'
_EARLY: Final = 70
_LATE: Final = 100.0


def preparations(trials: list[Trial]) -> Table:
    """Return the table of data preparations, with the bound from raw speed."""
    rows = []
    for i, name in enumerate(PREPARATIONS):
        cells = [name]
        for k in range(len(PLANS)):
            error = data.pooled([trial.prepared[k].errors[i] for trial in trials])
            cells += [f'{error:.4f}', f'{error / bound(trials, k):.2f}']
        rows.append(tuple(cells))
    bounds = [cell for k in range(len(PLANS)) for cell in (f'{bound(trials, k):.4f}', '1')]
    header = tuple(cell for name, _ in PLANS for cell in (name, 'ratio'))
    return Table(
        'Preparation of the data: RMSE of w over 20-80 km/h, N/kN, and its ratio to the bound',
        ('preparation', *header),
        (*rows, ('Cramer-Rao bound of raw speed', *bounds)),
        'Bound: initial speed of each coast unknown, statistics of gusts and map errors known. '
        f'Standard error of a ratio over these seeds: {_percent_error(trials)} %.',
    )


def _percent_error(trials: list[Trial]) -> str:
    """Return the relative standard error of a root mean square over the seeds, windows of 11 samples in gusts."""
    index = PREPARATIONS.index(_TARGETED)
    squares = np.square([trial.prepared[1].errors[index] for trial in trials])
    return f'{100.0 * 0.5 * np.std(squares) / (np.mean(squares) * np.sqrt(len(squares))):.0f}'


def bound(trials: list[Trial], plan: int) -> float:
    """Return the bound over all seeds [N/kN]."""
    return data.pooled([trial.prepared[plan].bound for trial in trials])


def batches(trials: list[Trial]) -> Table:
    """Return the table of batch estimators."""
    names = ('LS', 'regularised LS, lambda = 50', 'non-negative LS', 'LS with prior 20 % off')
    rows = []
    for i, name in enumerate(names):
        cells = [name]
        for field in ('full', 'narrow'):
            for k in range(len(TRUTHS)):
                errors = [getattr(trial, field)[k].errors[i] for trial in trials]
                cells.append(f'{data.pooled(errors):.3f}')
        rows.append(tuple(cells))
    header = tuple(f'{what}, {name}' for what in ('24 coasts', '4 short ones') for name, _ in TRUTHS)
    return Table(
        'Batch estimators on fixed windows of 11 samples: RMSE of w, N/kN',
        ('estimator', *header),
        tuple(rows),
        'Short coasts: 24 s each from 50-64 km/h in gusts of 0.3 N/kN, evaluated over 20-80 km/h as well.',
    )


def convergence(trials: list[Trial]) -> Table:
    """Return the check of the claim of Fig. 8 that parameters settle after about 70 recursions."""
    rows = []
    for i, (truth, single, penalty) in enumerate(SETTLINGS):
        record = 'one coast 80 to 20 km/h' if single else '24 coasts'
        cells = _settled([trial.settled[i] for trial in trials])
        rows.append((f'{record}, {TRUTHS[truth][0]}, lambda = {penalty}', f'{_EARLY}', *cells))
    header = ('record', 'paper', 'a / b / c settle', 'curve settles', 'error at 70', 'error at end', 'verdict')
    return Table(
        'Fig. 8: observations until estimates stay within 10 % of their last value (median)',
        header,
        tuple(rows),
        'Fixed windows of 11 samples; lambda = 50 as printed. Errors: RMSE of w, N/kN, median at 70.',
    )


def _settled(settled: list[Settling]) -> tuple[str, ...]:
    a, b, c = (float(x) for x in np.median([item.parameters for item in settled], axis=0))
    early = float(np.median([item.early for item in settled]))
    return (
        f'{a:.0f} / {b:.0f} / {c:.0f}',
        f'{np.median([item.curve for item in settled]):.0f}',
        f'{early:.3f}',
        f'{data.pooled([item.end for item in settled]):.3f}',
        judged(max(a, b, c) > _LATE, 'parameters take longer'),
    )


def bad_data(trials: list[Trial]) -> Table:
    """Return the check of the claim of Fig. 9 that V-MILS skips bad data."""
    rows = []
    for i, fault in enumerate(FAULTS):
        ratios = [data.pooled([trial.spoiled[i][k] for trial in trials]) for k in range(len(BY_FLAG))]
        verdict = 'no bad data' if fault == 'clean' else _fault_verdict(ratios)
        rows.append((fault, *(f'{ratio:.2f}' for ratio in ratios), verdict))
    return Table(
        'Fig. 9: bad data, RMSE of w over the bound of the good observations',
        ('bad observations (4-14 N/kN off)', *BY_FLAG, 'verdict on V-MILS p = 4'),
        tuple(rows),
        'True flags: error-free, not available on a train; the paper does not say how bad data are detected. Gate: '
        '3 robust standard deviations of the last 51 innovations.',
    )


def _fault_verdict(ratios: list[float]) -> str:
    ls, flagged, single, gated = ratios
    if flagged >= ls:
        return 'refuted: worse than LS'
    worse = ', worse than p = 1' if flagged > 1.1 * single else ''
    return f'confirmed with true flags{worse}' + ('' if gated < 2.0 else '; refuted with a gate')


def tracking(trials: list[Trial]) -> Table:
    """Return the table of tracking a jump with forgetting."""
    rows = []
    for i, (name, _) in enumerate(TRACKERS):
        delay = float(np.median([trial.delays[i] for trial in trials]))
        error = data.pooled([trial.before[i] for trial in trials])
        rows.append((name, f'{delay:.0f}' if np.isfinite(delay) else '> 1032', f'{error:.3f}'))
    return Table(
        'A jump of a by 1.22 N/kN after 1032 observations',
        ('recursion', '90 % followed after (median)', 'RMSE before, N/kN'),
        tuple(rows),
        'White noise of 0.57 N/kN. No forgetting factor gives both fast tracking and low noise.',
    )


def consistency(trials: list[Trial]) -> Table:
    """Return the table of the consistency (NEES) of the streaming estimators."""
    means = np.mean([trial.nees for trial in trials], axis=0)
    rows = tuple((name, f'{mean:.2f}', '1') for name, mean in zip(STREAMS, means, strict=True))
    note = '24 coasts in gusts of 0.3 N/kN, covariance p sigma^2 P with sigma^2 and its correlation from residuals.'
    return Table('Consistency of the streaming estimators', ('algorithm', 'NEES/3', 'ideal'), rows, note)


def targets(trials: list[Trial]) -> Table:
    """Return the targets and the reached values."""
    exact = max(trial.errata.exact for trial in trials)
    weighted = max(trial.errata.weighted for trial in trials)
    windows = PREPARATIONS.index(_TARGETED)
    ratio = data.pooled([trial.prepared[1].errors[windows] for trial in trials]) / bound(trials, 1)
    rows = (
        ('RLS from P(0) = I/lambda minus (7), every t, lambda = 1, 50, 5000', 1e-9, exact, '.0e'),
        ('MILS minus weighted LS, N/kN, p = 1, 2, 4, 6', 1e-6, weighted, '.0e'),
        ('windows of 11 samples + LS over the bound, gusts 0.3 N/kN', 1.15, ratio, '.3f'),
    )
    return Table(
        'Targets of liu2018',
        ('quantity', 'target', 'reached', 'met?'),
        tuple(
            (name, f'<= {limit:g}', format(value, form), 'yes' if value <= limit else 'no')
            for name, limit, value, form in rows
        ),
    )


_BANDS: Final = np.arange(25.0, 80.0, 5.0)


def segments(seed: int) -> Plot:
    """Return the plot of the observations of Fig. 2 and of fixed windows on the same coasts."""
    coasts = data.drive(data.CoastPlan(coasts=96), np.random.default_rng(seed))
    figure = Figure(figsize=(9.0, 3.6), layout='constrained')
    axes = figure.subplots(1, 2, sharey=True)
    cases: tuple[tuple[Cutter, str], ...] = (
        (FIG2, 'Fig. 2: until speed has changed by 0.5 km/h'),
        (WINDOWS, 'fixed windows of 11 samples'),
    )
    for ax, (cutter, title) in zip(axes, cases, strict=True):
        seen = seen_by(coasts, cutter)
        error = seen.y - data.resistance(data.PAPER, seen.v)
        bins = [error[(low <= seen.v) & (seen.v < low + 5.0)] for low in _BANDS]
        ax.plot(seen.v, error, '.', ms=1.5, color='0.75', rasterized=True)
        ax.errorbar(_BANDS + 2.5, [np.mean(x) for x in bins], [np.std(x) for x in bins], fmt='o-', color='C3', ms=4)
        ax.axhline(0.0, color='k', lw=0.8)
        ax.set(title=title, xlabel='speed [km/h]', ylim=(-3.0, 4.0))
    axes[0].set_ylabel('error of observed resistance [N/kN]')
    return Plot(
        'liu2018_segments',
        'Effect of ending segments at a change of speed',
        figure,
        'Errors of single observations without gusts, mean and standard deviation by speed. Segments that end where '
        'noise crosses a limit overestimate the slope, more so at high speed; fixed windows do not.',
    )


def dilution_plot(trials: list[Trial]) -> Plot:
    """Return the plot of the parameter a against p, printed and ours."""
    figure = Figure(figsize=(6.4, 3.6), layout='constrained')
    ax = figure.subplots()
    a4, a1 = dilution()
    a2, a6 = PRINTED[2][1], PRINTED[4][1]
    ax.plot(LENGTHS, (a1, a2, a4, a6), 'k--', lw=1.0, label='diluted penalty fitted to p = 2 and p = 6')
    ax.plot(LENGTHS, [row[1] for row in PRINTED[1:]], 'o', color='C0', label='Table 1')
    ax.plot([1], [PRINTED[0][1]], 's', color='C0', mfc='w', label='Table 1, "LS"')
    growth = np.mean([trial.shape.a for trial in trials], axis=0)
    ax.plot(LENGTHS, growth, 'o-', color='C3', label='ours as printed, lambda = 50')
    ax.axhline(data.PAPER[0], color='C3', lw=0.8, ls=':', label='truth of ours')
    ax.set(xlabel='innovation length p', ylabel='a [N/kN]', xticks=LENGTHS)
    ax.legend(fontsize=8)
    return Plot(
        'liu2018_dilution',
        'Why a grows with the innovation length in Table 1',
        figure,
        'Regularised MILS is ridge regression with lambda/p: more innovations reduce the penalty, not the error.',
    )
