# SPDX-License-Identifier: Apache-2.0
"""Figures of the gap between simulation and data; each returns an SVG element, or an empty string without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros.report.axes import legend_above, limit, pick
from trainid_ros.report.style import BRAKE, ESTIMATE, GOOD, MUTED, STAND, WAIT, house_style, to_svg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from trainid_ros.explain.explanation import Explanation, RunTrace
    from trainid_ros.train.train_file import Line

    Array = NDArray[np.float64]

BEFORE: Final = BRAKE
AFTER: Final = ESTIMATE
BEFORE_LINE: Final = Line2D([], [], color=BEFORE, label='current model')
AFTER_LINE: Final = Line2D([], [], color=AFTER, label='with the effects')
NOISE_BAND: Final = Patch(color=STAND, alpha=0.35, linewidth=0, label='±2 std of noise')
_STRETCH: Final = Patch(color=WAIT, alpha=0.3, linewidth=0, label='effect found here')
_TUNNEL: Final = Patch(color=STAND, alpha=0.35, linewidth=0, label='tunnel')
_CURVE: Final = Patch(color=GOOD, alpha=0.35, linewidth=0, label='curve')
_WIDE: Final = 10.4
_RUNS: Final = 12
_ACROSS: Final = 3
# With more lines in one panel they cannot be distinguished.
_LINES: Final = 60
Stretches = tuple[tuple[float, float], ...]


def gap_bars(explanation: Explanation) -> str:
    """Plot the gap before and after, with the noise floor."""
    gap = explanation.gap
    if gap is None:
        return ''
    bars = [('noise alone', gap.noise_floor, STAND), ('current model', gap.before, BEFORE)]
    if explanation.effects:
        bars.insert(1, ('with the effects', gap.after, AFTER))
    names, values, colours = zip(*bars, strict=True)
    with house_style():
        figure = Figure(figsize=(_WIDE, 0.7 + 0.4 * len(bars)), layout='constrained')
        axes = figure.subplots()
        drawn = axes.barh(names, values, color=colours)
        axes.bar_label(drawn, [f'{value:.3f}' for value in values], padding=4)
        axes.set_xlabel('RMS of simulated less measured speed on held-out runs [m/s]')
        axes.set_xlim(0.0, 1.12 * max(values) or 1.0)
        axes.grid(visible=False, axis='y')
        return to_svg(figure, 'Gap before and after, with the noise floor')


def gap_along_line(explanation: Explanation, line: Line, found: Stretches) -> str:
    """Plot the speed gap by position, each direction separately, of at most about 60 runs each."""
    seen = [trace for trace in explanation.traces if _has_gap(trace)]
    ways = [way for way in (1, -1) if any(trace.direction == way for trace in seen)]
    if not ways:
        return ''
    with house_style():
        figure = Figure(figsize=(_WIDE, 1.0 + 2.1 * len(ways)), layout='constrained')
        panels = figure.subplots(len(ways), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, way in zip(panels, ways, strict=True):
            axes.axhline(0.0, color=MUTED, linewidth=0.8)
            traces = [trace for trace in seen if trace.direction == way]
            for trace in traces[:: -(-len(traces) // _LINES)]:
                kept = pick(len(trace.time))
                axes.plot(trace.position[kept], trace.before[kept], color=BEFORE, linewidth=0.9, alpha=0.8)
                axes.plot(trace.position[kept], trace.after[kept], color=AFTER, linewidth=0.9, alpha=0.8)
            axes.set_title('towards rising positions' if way > 0 else 'towards falling positions')
            axes.set_ylabel('speed gap [m/s]')
            draw_place(axes, line, found)
        _fit_positions(panels[-1], np.concatenate([trace.position for trace in seen]))
        legend_above(figure, [BEFORE_LINE, AFTER_LINE, *line_handles(line, found)])
        return to_svg(figure, 'Speed gap by position in both directions')


def line_handles(line: Line, found: Stretches) -> list[Patch]:
    """Return the legend entries of :func:`draw_place`."""
    curved = any(radius > 0.0 for _, radius in line.curve)
    shown = ((_STRETCH, bool(found)), (_TUNNEL, bool(line.tunnel)), (_CURVE, curved))
    return [handle for handle, there in shown if there]


def draw_place(axes: Axes, line: Line, found: Stretches) -> None:
    """Draw tunnels, curves and stops of a line into a plot by position, and shade the sections of effects found."""
    across = axes.get_xaxis_transform()
    for start, end in found:
        axes.axvspan(start, end, color=WAIT, alpha=0.3, linewidth=0)
    tunnels = [(start, end - start) for start, end in line.tunnel]
    axes.broken_barh(tunnels, (0.0, 0.05), facecolors=STAND, linewidth=0, transform=across)
    ends = [*(start for start, _ in line.curve[1:]), 1e9]
    curves = [(start, end - start) for (start, radius), end in zip(line.curve, ends, strict=False) if radius > 0.0]
    axes.broken_barh(curves, (0.05, 0.05), facecolors=GOOD, linewidth=0, transform=across)
    for stop in line.stops:
        axes.axvline(stop, color=MUTED, linewidth=0.7, linestyle=(0, (1, 2)))


def _fit_positions(axes: Axes, positions: Array) -> None:
    low, high = float(positions.min()), float(positions.max())
    room = 0.01 * (high - low) + 1.0
    axes.set_xlim(low - room, high + room)
    axes.set_xlabel('position [m], dotted: stops')


def gap_of_runs(explanation: Explanation) -> str:
    """Plot speed gaps by time with the noise band, for the runs with the largest gaps."""
    traces = _worst(explanation.traces)
    if not traces:
        return ''
    rows = -(-len(traces) // _ACROSS)
    with house_style():
        figure = Figure(figsize=(_WIDE, 0.7 + 1.75 * rows), layout='constrained')
        panels = figure.subplots(rows, _ACROSS, sharey=True, squeeze=False).ravel()
        for axes, (index, trace) in zip(panels, traces, strict=False):
            _draw_run(axes, trace, f'run {index + 1}, {_way(trace)}')
        for axes in panels[len(traces) :]:
            axes.set_visible(False)
        for axes in panels[::_ACROSS]:
            axes.set_ylabel('gap [m/s]')
        shown = [part for _, trace in traces for part in (trace.before, trace.after, 2.0 * trace.band)]
        limit(panels[0], shown)
        legend_above(figure, [BEFORE_LINE, AFTER_LINE, NOISE_BAND])
        return to_svg(figure, 'Speed gap of single runs by time')


def _has_gap(trace: RunTrace) -> bool:
    """Return False for a run without a gap: it could not be held out because there are too few runs."""
    return bool(trace.time.size and np.isfinite(trace.before).any())


def _worst(traces: Sequence[RunTrace]) -> list[tuple[int, RunTrace]]:
    """Return the runs with the largest gaps, in the order in which they were driven."""
    seen = [(k, trace) for k, trace in enumerate(traces) if _has_gap(trace)]
    sizes = {k: float(np.sqrt(np.nanmean(np.square(trace.before)))) for k, trace in seen}
    chosen = sorted(sizes, key=lambda k: -sizes[k])[:_RUNS]
    return [(k, trace) for k, trace in seen if k in chosen]


def _draw_run(axes: Axes, trace: RunTrace, title: str) -> None:
    kept = pick(len(trace.time))
    time, band = trace.time[kept], 2.0 * trace.band[kept]
    axes.fill_between(time, -band, band, color=STAND, alpha=0.35, linewidth=0)
    axes.plot(time, trace.before[kept], color=BEFORE)
    axes.plot(time, trace.after[kept], color=AFTER)
    axes.set_title(title, fontsize=9, fontweight='normal')
    axes.set_xlabel('time since departure [s]')


def _way(trace: RunTrace) -> str:
    return f'{trace.position[0] / 1000.0:.1f} → {trace.position[-1] / 1000.0:.1f} km'
