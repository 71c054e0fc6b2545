# SPDX-License-Identifier: Apache-2.0
"""Plots of the experiment of Zheng et al. 2015 and of a jump of the brake rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure

from benchmarks.tables import Plot
from research.papers.brake_runs import JUMP_AFTER_S, jump_run
from research.papers.zheng2015_metro import FIRST_SEED, SHIPPED, trace
from research.papers.zheng2015_paper import gsma, gsma_free, kalman, paper_run, sma

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN_S: Final = (8.0, 30.0)


def plot_claims() -> Plot:
    """Return the plot of one run of the paper's experiment."""
    run = paper_run(FIRST_SEED)
    figure = Figure(figsize=(8.0, 4.0), layout='constrained')
    axes: Axes = figure.subplots()
    k = np.arange(1, len(run.f) + 1)
    axes.plot(k, run.f, 'k', label='true')
    axes.plot(k, sma(run, FIRST_SEED).f, lw=0.8, label='SMA as printed')
    axes.plot(k, gsma(run, FIRST_SEED).f, lw=0.8, label='GSMA as printed')
    axes.plot(k, gsma_free(run, FIRST_SEED).f, lw=1.2, label='GSMA corrected')
    axes.plot(k, kalman(run, 0.0, 2e-4, (0.0, 0.01)).f, lw=1.2, label='linear KF with trend')
    axes.set(xlabel='step of 1 s', ylabel='brake rate f')
    axes.legend(fontsize=8)
    note = 'One seed. As printed, f depends on the grid and on the newest sample; without a grid it follows the ramp.'
    return Plot('zheng2015_ramp', 'Brake rate on the data of Zheng et al.', figure, note)


def plot_jump() -> Plot:
    """Return the plot of a jump during braking."""
    run = jump_run(FIRST_SEED)
    shown = (run.phase == run.phase[-1]) & (run.braked_s > _SHOWN_S[0]) & (run.braked_s < _SHOWN_S[1])
    t = run.braked_s[shown] - JUMP_AFTER_S
    figure = Figure(figsize=(8.0, 4.0), layout='constrained')
    axes: Axes = figure.subplots()
    axes.plot(t, run.rate[shown], 'k', label='true')
    for name in ('GSMA', 'IMM', 'KF'):
        got = trace(run, name, FIRST_SEED, SHIPPED)[shown]
        (line,) = axes.plot(t, got[:, 0], label=name)
        if name == 'GSMA':
            axes.fill_between(t, got[:, 0] - got[:, 1], got[:, 0] + got[:, 1], color=line.get_color(), alpha=0.2, lw=0)
    axes.set(xlabel='time since the jump, s', ylabel='brake rate f')
    axes.legend(fontsize=8)
    note = 'One seed; the band is one standard deviation of GSMA.'
    return Plot('zheng2015_jump', 'A jump of the brake rate during braking', figure, note)
