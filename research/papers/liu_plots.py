# SPDX-License-Identifier: Apache-2.0
"""Plots of the experiment of Liu et al. 2018."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure

from benchmarks.tables import Plot
from research.papers import coasts as data
from research.papers.liu_table1 import FIG2, LENGTHS, PRINTED, WINDOWS, dilution, seen_by

if TYPE_CHECKING:
    from research.papers.liu_trial import Trial
    from trainid_lab.resistance.segments import Cutter

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
