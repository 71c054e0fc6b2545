# SPDX-License-Identifier: Apache-2.0
"""Report of an explanation: the findings as text, then the figures of the gap, then the tables."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.report.page import (
    BRAKE,
    ESTIMATE,
    GOOD,
    MUTED,
    STAND,
    WAIT,
    Table,
    legend_above,
    limit,
    pick,
    render,
    styled_figure,
    to_svg,
    write_page,
)
from trainid_ros.report.words import (
    DASH,
    alternatives,
    davis_rows,
    drive_text,
    gap_sentence,
    headline,
    how_sure,
    noise_rows,
    parameters_text,
    plus_minus,
    strong_text,
    strongest,
    unit_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from trainid_ros.explain.result import FoundEffect, Location, Place, RunTrace
    from trainid_ros.report.recording import Array
    from trainid_ros.train.train_file import Line, TrainFile

# The tag has the colours of the estimators' statuses.
_TAGS: Final = {
    Verdict.EXPLAINED: 'VALID',
    Verdict.NO_GAP: 'HOLDING',
    Verdict.AMBIGUOUS: 'CONVERGING',
    Verdict.UNEXPLAINED: 'FAULT',
}
BEFORE: Final = BRAKE
AFTER: Final = ESTIMATE
BEFORE_LINE: Final = Line2D([], [], color=BEFORE, label='current model')
AFTER_LINE: Final = Line2D([], [], color=AFTER, label='with the effects')
UNCHANGED_LINE: Final = Line2D([], [], color=AFTER, label='current model')
NOISE_BAND: Final = Patch(color=STAND, alpha=0.35, linewidth=0, label='±2 std of noise')
_STRETCH: Final = Patch(color=WAIT, alpha=0.3, linewidth=0, label='effect found here')
_TUNNEL: Final = Patch(color=STAND, alpha=0.35, linewidth=0, label='tunnel')
_CURVE: Final = Patch(color=GOOD, alpha=0.35, linewidth=0, label='curve')
_RUNS: Final = 12
_RUNS_ACROSS: Final = 3
# With more lines in one panel they cannot be distinguished.
_LINES: Final = 60
_PARTS_ACROSS: Final = 2
_SIGMAS: Final = 2.0
_MISSING: Final = 'missing [N/kN]'
# With more labels they would not be readable.
_NAMES: Final = 10
# Multiple of the median std beyond which a part does not define the axis: with little driving it is almost the prior.
_MAX_STD: Final = 4.0
Stretches = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Explained:
    """An explanation with the inputs it was made from."""

    title: str  # Heading
    explanation: Explanation  # Result of the workflow
    train_file: TrainFile  # Train file given to the workflow
    train_file_name: str  # Name of the train file
    bags: tuple[str, ...]  # Names of the bags
    notes: tuple[str, ...] = ()  # Further sentences, such as the truth


def write_explained(explained: Explained, path: str | Path) -> None:
    """Write the report and create missing folders.

    Raises:
        InputError: The file cannot be written.
    """
    write_page(render_explained(explained), path)


def render_explained(explained: Explained) -> str:
    """Return the report as HTML text."""
    explanation, line = explained.explanation, explained.train_file.line
    found = _stretches(explanation)
    return render(
        'explained.html.j2',
        explained.title,
        facts=(
            ('Bags', ', '.join(explained.bags)),
            ('Train file', explained.train_file_name),
            ('Drive', drive_text(explanation)),
        ),
        status=_TAGS[explanation.verdict],
        verdict=explanation.verdict.value.replace('_', ' '),
        headline=headline(explanation),
        notes=explained.notes,
        findings=_findings(explanation),
        runs=len(explanation.traces),
        gap=gap_bars(explanation),
        missing_along_line=missing_along_line(explanation, line, found),
        gap_along_line=gap_along_line(explanation, line, found),
        missing_by_part=missing_by_part(explanation),
        gap_of_runs=gap_of_runs(explanation),
        tables=(_effects_table(explanation), _davis_table(explained), _noise_table(explanation)),
    )


def _findings(explanation: Explanation) -> tuple[tuple[str, list[str]], ...]:
    """Return headings, each with its lines of text."""
    where = [f'{effect.name}: {effect.where}' for effect in explanation.effects]
    return (
        ('Missing effects', [_what(effect) for effect in explanation.effects]),
        ('Where', where or [strong_text(strong) for strong in strongest(explanation)]),
        ('Evidence', [f'{effect.name}: {how_sure(effect)}' for effect in explanation.effects]),
        ('Alternatives, and test runs to distinguish them', alternatives(explanation)),
        ('Gap before and after', [gap_sentence(explanation)]),
        ('Remaining gap', [explanation.remaining]),
    )


def _what(effect: FoundEffect) -> str:
    side = 'This is a sensor error.' if effect.origin == 'sensor' else 'This is physical, not a sensor error.'
    return f'{effect.name}, {effect.title}: {effect.equation}, with {parameters_text(effect)}. {side}'


def _stretches(explanation: Explanation) -> Stretches:
    """Return start and end [m] of the effects that act on a section of the line."""
    found = []
    for effect in explanation.effects:
        values = dict(effect.parameters)
        if {'start', 'end'} <= values.keys() and unit_of(effect.name, 'start') == 'm':
            found.append((values['start'], values['end']))
    return tuple(found)


def _effects_table(explanation: Explanation) -> Table:
    rows = []
    for effect in explanation.effects:
        std = dict(effect.std)
        for k, (name, value) in enumerate(effect.parameters):
            title, evidence = (effect.name, f'{effect.evidence:.0f}') if k == 0 else ('', '')
            unit = unit_of(effect.name, name) or DASH
            rows.append((title, name, unit, plus_minus(value, std.get(name, 0.0)), evidence))
    caption = 'Effects added to the model; evidence is 2 ln of the Bayes factor'
    return Table(caption, ('effect', 'parameter', 'unit', 'value ± std', 'evidence'), rows, 3)


def _davis_table(explained: Explained) -> Table:
    rows = [(name, unit, old, new) for name, old, new, unit in davis_rows(explained.explanation, explained.train_file)]
    caption = 'Running resistance w(v) = a + b v + c v²'
    return Table(caption, ('', 'unit', 'train file', 'estimate ± std'), rows, 2)


def _noise_table(explanation: Explanation) -> Table:
    rows = [(name, unit, size) for name, size, unit in noise_rows(explanation)]
    return Table('Noise and nuisances, estimated with the effects', ('', 'unit', 'value'), rows, 2)


def gap_bars(explanation: Explanation) -> str:
    """Plot the gap before and after, with the noise floor."""
    gap = explanation.gap
    if gap is None:
        return ''
    bars = [
        ('noise alone', gap.noise_floor, STAND),
        ('current model', gap.before, BEFORE if explanation.effects else AFTER),
    ]
    if explanation.effects:
        bars.insert(1, ('with the effects', gap.after, AFTER))
    names, values, colours = zip(*bars, strict=True)
    with styled_figure(0.7 + 0.4 * len(bars)) as figure:
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
    with styled_figure(1.0 + 2.1 * len(ways)) as figure:
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
        legend_above(figure, [*model_lines(explanation), *line_handles(line, found)])
        return to_svg(figure, 'Speed gap by position in both directions')


def model_lines(explanation: Explanation) -> list[Line2D]:
    """Return the legend entries of the lines before and after; without an effect they are one line."""
    return [BEFORE_LINE, AFTER_LINE] if explanation.effects else [UNCHANGED_LINE]


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
    rows = -(-len(traces) // _RUNS_ACROSS)
    with styled_figure(0.7 + 1.75 * rows) as figure:
        panels = figure.subplots(rows, _RUNS_ACROSS, sharey=True, squeeze=False).ravel()
        for axes, (index, trace) in zip(panels, traces, strict=False):
            _draw_run(axes, trace, f'run {index + 1}, {_way(trace)}')
        for axes in panels[len(traces) :]:
            axes.set_visible(False)
        for axes in panels[::_RUNS_ACROSS]:
            axes.set_ylabel('gap [m/s]')
        shown = [part for _, trace in traces for part in (trace.before, trace.after, 2.0 * trace.band)]
        limit(panels[0], shown)
        legend_above(figure, [*model_lines(explanation), NOISE_BAND])
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


def missing_along_line(explanation: Explanation, line: Line, found: Stretches) -> str:
    """Plot the missing resistance by position, before and after."""
    shown = [location for location in explanation.locations if _is_position(location) and location.places]
    if not shown:
        return ''
    with styled_figure(0.9 + 2.6 * len(shown)) as figure:
        panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for axes, location in zip(panels, shown, strict=True):
            _draw_ranges(axes, location)
            draw_place(axes, line, found)
            axes.set_title(f'Missing resistance by {location.axis}')
        low = min(place.low for location in shown for place in location.places)
        high = max(place.high for location in shown for place in location.places)
        panels[-1].set_xlim(low, high)
        panels[-1].set_xlabel('position [m], dotted: stops')
        legend_above(figure, [*model_lines(explanation), *line_handles(line, found)])
        return to_svg(figure, 'Missing resistance by position')


def missing_by_part(explanation: Explanation) -> str:
    """Plot the missing resistance along all other axes."""
    shown = [location for location in explanation.locations if not _is_position(location) and location.places]
    if not shown:
        return ''
    rows = -(-len(shown) // _PARTS_ACROSS)
    with styled_figure(0.5 + 2.5 * rows) as figure:
        panels = figure.subplots(rows, _PARTS_ACROSS, squeeze=False).ravel()
        for axes, location in zip(panels, shown, strict=False):
            _draw_location(axes, location)
        for axes in panels[len(shown) :]:
            axes.set_visible(False)
        legend_above(figure, [*model_lines(explanation)])
        return to_svg(figure, 'Missing resistance by speed, driving mode and so on')


def _is_position(location: Location) -> bool:
    return location.axis.startswith('position')


def _draw_location(axes: Axes, location: Location) -> None:
    if all(math.isfinite(place.low) and math.isfinite(place.high) for place in location.places):
        _draw_ranges(axes, location)
        axes.set_xlabel(f'{location.axis} [{location.unit}]' if location.unit else location.axis)
    else:
        _draw_kinds(axes, location.places)
        labels = [place.label for place in location.places]
        every = math.ceil(len(labels) / _NAMES)
        axes.set_xticks(range(0, len(labels), every), labels[::every])
    axes.set_title(f'by {location.axis}')


def _draw_ranges(axes: Axes, location: Location) -> None:
    """Draw steps with bands of ±2 std over the ranges of an axis."""
    places = sorted(location.places, key=lambda place: place.low)
    x, std = _steps(places, [place.std for place in places])
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    for colour, values in ((BEFORE, [place.before for place in places]), (AFTER, [place.after for place in places])):
        value = _steps(places, values)[1]
        axes.fill_between(x, value - _SIGMAS * std, value + _SIGMAS * std, color=colour, alpha=0.18, linewidth=0)
        axes.plot(x, value, color=colour)
    axes.set_ylabel(_MISSING)
    _fit(axes, places)


def _steps(places: Sequence[Place], values: Sequence[float]) -> tuple[Array, Array]:
    """Return x and a quantity at both ends of each range, with a break where ranges do not touch."""
    x: list[float] = []
    y: list[float] = []
    for place, value in zip(places, values, strict=True):
        if x and place.low > x[-1] + 1e-6 * abs(place.low):
            x.append(place.low)
            y.append(math.nan)
        x += [place.low, place.high]
        y += [value, value]
    return np.array(x), np.array(y)


def _draw_kinds(axes: Axes, places: Sequence[Place]) -> None:
    """Draw values with bars of ±2 std side by side."""
    at = np.arange(len(places))
    std = np.array([place.std for place in places])
    axes.axhline(0.0, color=MUTED, linewidth=0.8)
    for shift, colour, values in (
        (-0.12, BEFORE, [place.before for place in places]),
        (0.12, AFTER, [place.after for place in places]),
    ):
        axes.errorbar(at + shift, values, _SIGMAS * std, fmt='o', markersize=4, color=colour, capsize=3, linewidth=1.2)
    axes.set_xlim(-0.6, len(places) - 0.4)
    axes.set_ylabel(_MISSING)
    axes.grid(visible=False, axis='x')
    _fit(axes, places)


def _fit(axes: Axes, places: Sequence[Place]) -> None:
    largest = _MAX_STD * float(np.median([place.std for place in places]))
    known = [place for place in places if place.std <= largest]
    ends = [
        np.array([value - _SIGMAS * place.std, value + _SIGMAS * place.std, 0.0])
        for place in known
        for value in (place.before, place.after)
    ]
    limit(axes, ends, 0.08)
