# SPDX-License-Identifier: Apache-2.0
"""Plots of the identification rate over the visibility of an effect, and of the remaining gap."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure

from benchmarks.explain_score import VISIBLE, exact, rate, within_two
from benchmarks.tables import Plot

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.explain_trial import Outcome

_EDGES: Final = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, float('inf'))
_TICKS: Final = (0.5, 1.0, 2.0, 5.0, 10.0)


def visibility_plot(outcomes: Sequence[Outcome]) -> Plot:
    """Return the share of single effects identified, over their visibility."""
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    single = [one for one in outcomes if one.answer.kind == 'single']
    bins = [[one for one in single if low <= one.answer.visible < high] for low, high in pairwise(_EDGES)]
    filled = [(k, chosen) for k, chosen in enumerate(bins) if chosen]
    for text, holds, aside in (('exact name', exact, -0.1), ('in a set of at most two', within_two, 0.1)):
        rates = [rate(chosen, holds) for _, chosen in filled]
        share = np.array([100.0 * one.share for one in rates])
        ends = 100.0 * np.array([one.interval() for one in rates]).reshape(-1, 2).T
        spread = np.clip([share - ends[0], ends[1] - share], 0.0, None)
        axes.errorbar([k + aside for k, _ in filled], share, yerr=spread, fmt='o', capsize=3.0, label=text)
    axes.axvline(_EDGES.index(VISIBLE) - 0.5, color='0.5', linestyle=':')
    axes.set_xticks(range(len(bins)), [f'{low:.0f} .. {high:.0f}' for low, high in pairwise(_EDGES)])
    axes.set_xlabel('rise of the gap over the noise floor, %')
    axes.set_ylim(0.0, 105.0)
    axes.set_ylabel('of the cases, %')
    axes.legend()
    note = 'Single effects of both generators, 95 % intervals. The targets count cases to the right of the dotted line.'
    return Plot('explain_visibility', 'Correctly named effects by visibility', figure, note)


def gap_plot(outcomes: Sequence[Outcome]) -> Plot:
    """Return the gap before and after over the noise floor, for correctly named single effects."""
    figure = Figure(figsize=(8.0, 3.6), layout='constrained')
    axes = figure.subplots()
    right = [one for one in outcomes if one.answer.kind == 'single' and exact(one)]
    gaps = np.array([one.gap for one in right if one.gap is not None]).reshape(-1, 3)
    before, after = np.sort(gaps[:, 0] / gaps[:, 2]), np.sort(gaps[:, 1] / gaps[:, 2])
    share = 100.0 * (np.arange(len(gaps)) + 0.5) / max(len(gaps), 1)
    axes.plot(before, share, label='before')
    axes.plot(after, share, label='after')
    axes.axvline(1.1, color='0.5', linestyle=':')
    axes.set_xscale('log')
    axes.set_xticks(_TICKS, [f'{tick:g}' for tick in _TICKS])
    axes.minorticks_off()
    axes.set_xlabel('held-out gap / noise floor')
    axes.set_ylabel('of the cases below, %')
    axes.legend()
    note = 'Correctly named single effects of both generators. Dotted: 10 % above the floor.'
    return Plot('explain_gap', 'Held-out gap before and after the effect is added', figure, note)
