# SPDX-License-Identifier: Apache-2.0
"""Plots of the algorithms on station lines."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from benchmarks.tables import Plot
from research.papers.line_scores import acceleration, moving, true
from research.papers.lockstep import Track
from research.papers.station_lines import Lines
from research.papers.yuan_methods import PRINTED


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
