# SPDX-License-Identifier: Apache-2.0
"""Report of an explanation: the answer and what follows from it, then the figures and tables that show it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros.explain.result import Explanation, Learned, Location, Place, RunTrace, Verdict
from trainid_ros.report import page, words
from trainid_ros.report.proposal import what_if_rows
from trainid_ros.report.recording import Array
from trainid_ros.train.train_file import Line, TrainFile

# The tag has the colours of the estimators' statuses.
_TAGS: Final = {
    Verdict.EXPLAINED: 'VALID',
    Verdict.NO_GAP: 'HOLDING',
    Verdict.AMBIGUOUS: 'CONVERGING',
    Verdict.UNEXPLAINED: 'FAULT',
}
BEFORE: Final = page.BRAKE
AFTER: Final = page.ESTIMATE
NOISE_BAND: Final = Patch(color=page.STAND, alpha=0.35, linewidth=0, label='±2 std of noise')
_RUNS_ACROSS: Final = 3
_SIGMAS: Final = 2.0
Stretches = tuple[tuple[float, float], ...]


def render_explained(
    title: str,
    explanation: Explanation,
    train_file: TrainFile,
    train_file_name: str,
    bags: Sequence[str],
    notes: Sequence[str] = (),
) -> str:
    """Return the report as HTML text; ``train_file`` is the one explained, ``notes`` are further sentences."""
    line = train_file.line
    found = _stretches(explanation)
    return page.render(
        'explained.html.j2',
        title,
        status=_TAGS[explanation.verdict],
        verdict=explanation.verdict.value.replace('_', ' '),
        headline=words.headline(explanation),
        notes=notes,
        facts=(
            *((name, '\n'.join(lines)) for name, lines in _answers(explanation) if lines),
            ('Drive', words.drive_text(explanation)),
            ('Bags', ', '.join(bags)),
            ('Train file', train_file_name),
        ),
        worst_run=worst_run(explanation),
        learned=learned_curve(explanation.learned),
        other_causes=words.rejected_rows(explanation),
        changes=what_if_rows(train_file, explanation.train_file),
        runs=len(explanation.traces),
        missing_along_line=missing_along_line(explanation, line, found),
        gap_along_line=gap_along_line(explanation, line, found),
        missing_by_part=missing_by_part(explanation),
        gap_of_runs=gap_of_runs(explanation),
        davis=[(name, unit, old, new) for name, old, new, unit in words.davis_rows(explanation, train_file)],
        noise=words.noise_rows(explanation),
    )


def _answers(explanation: Explanation) -> tuple[tuple[str, list[str]], ...]:
    sides = {'sensor': 'This is a sensor error.', 'physics': 'This is physical, not a sensor error.'}
    effects = explanation.effects
    what = [
        f'{one.name}, {one.title}: {words.parameters_text(one)}. {sides[one.origin]} {one.equation}' for one in effects
    ]
    where = [f'{effect.name}: {effect.where}' for effect in effects]
    sure = [*(f'{effect.name}: {words.how_sure(effect)}' for effect in effects), words.gap_sentence(explanation)]
    return (
        ('What', what or [explanation.remaining, *filter(None, [words.learned_sentence(explanation.learned)])]),
        ('Where', where or words.strongest(explanation)),
        ('How sure', [*sure, explanation.remaining] if what else sure),
        ('What next', words.next_steps(explanation)),
    )


def _stretches(explanation: Explanation) -> Stretches:
    """Return start and end [m] of the effects that act on a section of the line."""
    given = [dict(effect.parameters) for effect in explanation.effects if words.unit_of(effect.name, 'start') == 'm']
    return tuple((values['start'], values['end']) for values in given if {'start', 'end'} <= values.keys())


def worst_run(explanation: Explanation) -> str:
    """Plot measured and simulated speed of the run with the largest gap, and the gap with the noise band."""
    traces = _worst(explanation.traces, 1)
    if not traces:
        return ''
    ((index, trace),) = traces
    kept = page.pick(len(trace.time))
    with page.styled_figure(4.4) as figure:
        speeds, gaps = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for colour, gap in ((BEFORE, trace.before), (AFTER, trace.after)):
            speeds.plot(trace.time[kept], (trace.speed - gap)[kept], color=colour)
        speeds.plot(trace.time[kept], trace.speed[kept], color=page.INK, linestyle=page.DASHES)
        # A train that stands is held.
        speeds.set(title='Measured and simulated speed', ylabel='speed [m/s]', ylim=(0.0, None))
        _draw_run(gaps, index, trace)
        gaps.set_ylabel('gap [m/s]')
        measured = Line2D([], [], color=page.INK, linestyle=page.DASHES, label='measured')
        page.legend_above(figure, [measured, *file_lines(explanation), NOISE_BAND])
        return page.to_svg(figure, 'Measured and simulated speed of the run with the largest gap')


def learned_curve(learned: Learned | None) -> str:
    """Plot the missing resistance as a curve over one variable, with its 95 % band."""
    if learned is None:
        return ''
    x = learned.x if learned.unit else learned.x + 1.0  # the first run is number 1
    with page.styled_figure(3.2) as figure:
        axes = figure.subplots()
        band = _SIGMAS * learned.std
        axes.axhline(0.0, color=page.MUTED, linewidth=0.8)
        axes.fill_between(x, learned.value - band, learned.value + band, color=AFTER, alpha=0.18, linewidth=0)
        axes.plot(x, learned.value, color=AFTER, marker='' if learned.unit else 'o')
        axes.set_xlabel(f'{learned.text} [{learned.unit}]' if learned.unit else learned.text)
        axes.set_ylabel(f'share of {learned.of}' if learned.of else 'missing [N/kN]')
        return page.to_svg(figure, 'Learned curve of the missing resistance')


def gap_along_line(explanation: Explanation, line: Line, found: Stretches) -> str:
    """Plot the speed gap by position, each direction separately, of at most about 60 runs each."""
    seen = [trace for trace in explanation.traces if _has_gap(trace)]
    ways = [way for way in (1, -1) if any(trace.direction == way for trace in seen)]
    if not ways:
        return ''
    with page.styled_figure(1.0 + 2.1 * len(ways)) as figure:
        panels = page.column_of_axes(figure, len(ways), sharey=True)
        for axes, way in zip(panels, ways, strict=True):
            axes.axhline(0.0, color=page.MUTED, linewidth=0.8)
            traces = [trace for trace in seen if trace.direction == way]
            for trace in traces[:: -(-len(traces) // 60)]:  # more lines cannot be distinguished
                kept = page.pick(len(trace.time))
                axes.plot(trace.position[kept], trace.before[kept], color=BEFORE, linewidth=0.9, alpha=0.8)
                axes.plot(trace.position[kept], trace.after[kept], color=AFTER, linewidth=0.9, alpha=0.8)
            axes.set_title('towards rising positions' if way > 0 else 'towards falling positions')
            axes.set_ylabel('speed gap [m/s]')
            draw_place(axes, line, found)
        positions = np.concatenate([trace.position for trace in seen])
        low, high = float(positions.min()), float(positions.max())
        room = 0.01 * (high - low) + 1.0
        panels[-1].set(xlim=(low - room, high + room), xlabel='position [m], dotted: stops')
        page.legend_above(figure, [*file_lines(explanation), *line_handles(line, found)])
        return page.to_svg(figure, 'Speed gap by position in both directions')


def file_lines(explanation: Explanation) -> list[Line2D]:
    """Return the legend entries of the gaps by both train files; they are one line if nothing was changed."""
    gap, read = explanation.gap, (BEFORE, 'train file read')
    if gap is not None and gap.after == gap.before:
        return _lines([(AFTER, 'train file read and written')])
    return _lines([read, (AFTER, 'train file written')] if gap else [read])


def model_lines(explanation: Explanation) -> list[Line2D]:
    """Return the legend entries of what a model lacks before and after; without an effect they are one line."""
    both = ((BEFORE, 'without the effects'), (AFTER, 'with the effects'))
    return _lines(both if explanation.effects else ((AFTER, 'a, b and c fitted'),))


def _lines(named: Iterable[tuple[str, str]]) -> list[Line2D]:
    return [Line2D([], [], color=colour, label=label, linewidth=1.5) for colour, label in named]


def line_handles(line: Line, found: Stretches) -> list[Patch]:
    """Return the legend entries of :func:`draw_place`."""
    curved = any(radius > 0.0 for _, radius in line.curve)
    shown = (
        (bool(found), page.WAIT, 0.3, 'effect found here'),
        (bool(line.tunnel), page.STAND, 0.35, 'tunnel'),
        (curved, page.GOOD, 0.35, 'curve'),
    )
    return [Patch(color=colour, alpha=a, linewidth=0, label=label) for there, colour, a, label in shown if there]


def draw_place(axes: Axes, line: Line, found: Stretches) -> None:
    """Draw tunnels, curves and stops of a line into a plot by position, and shade the sections of effects found."""
    across = axes.get_xaxis_transform()
    for start, end in found:
        axes.axvspan(start, end, color=page.WAIT, alpha=0.3, linewidth=0)
    tunnels = [(start, end - start) for start, end in line.tunnel]
    axes.broken_barh(tunnels, (0.0, 0.05), facecolors=page.STAND, linewidth=0, transform=across)
    ends = [*(start for start, _ in line.curve[1:]), 1e9]
    curves = [(start, end - start) for (start, radius), end in zip(line.curve, ends, strict=False) if radius > 0.0]
    axes.broken_barh(curves, (0.05, 0.05), facecolors=page.GOOD, linewidth=0, transform=across)
    for stop in line.stops:
        axes.axvline(stop, color=page.MUTED, linewidth=0.7, linestyle=(0, (1, 2)))


def gap_of_runs(explanation: Explanation) -> str:
    """Plot speed gaps by time with the noise band, for the runs with the largest gaps."""
    traces = _worst(explanation.traces, 12)
    if not traces:
        return ''
    with page.styled_figure(0.7 + 1.75 * math.ceil(len(traces) / _RUNS_ACROSS)) as figure:
        panels = _grid(figure, len(traces), _RUNS_ACROSS, sharey=True)
        for axes, (index, trace) in zip(panels, traces, strict=False):
            _draw_run(axes, index, trace)
        for axes in panels[::_RUNS_ACROSS]:
            axes.set_ylabel('gap [m/s]')
        shown = [part for _, trace in traces for part in (trace.before, trace.after, 2.0 * trace.band)]
        page.limit(panels[0], shown)
        page.legend_above(figure, [*file_lines(explanation), NOISE_BAND])
        return page.to_svg(figure, 'Speed gap of single runs by time')


def _grid(figure: Figure, count: int, across: int, **options: Any) -> Any:
    """Return the axes of a grid, of which only the first ones are shown."""
    panels = figure.subplots(math.ceil(count / across), across, squeeze=False, **options).ravel()
    for axes in panels[count:]:
        axes.set_visible(False)
    return panels


def _has_gap(trace: RunTrace) -> bool:
    """Return False for a run that could not be held out because there are too few runs."""
    return bool(trace.time.size and np.isfinite(trace.before).any())


def _worst(traces: Sequence[RunTrace], count: int) -> list[tuple[int, RunTrace]]:
    """Return a number of runs with the largest gaps, in the order in which they were driven."""
    seen = [(k, trace) for k, trace in enumerate(traces) if _has_gap(trace)]
    sizes = {k: float(np.sqrt(np.nanmean(np.square(trace.before)))) for k, trace in seen}
    chosen = sorted(sizes, key=lambda k: -sizes[k])[:count]
    return [(k, trace) for k, trace in seen if k in chosen]


def _draw_run(axes: Axes, index: int, trace: RunTrace) -> None:
    kept = page.pick(len(trace.time))
    time, band = trace.time[kept], 2.0 * trace.band[kept]
    axes.fill_between(time, -band, band, color=page.STAND, alpha=0.35, linewidth=0)
    axes.plot(time, trace.before[kept], color=BEFORE)
    axes.plot(time, trace.after[kept], color=AFTER)
    way = f'{trace.position[0] / 1000.0:.1f} → {trace.position[-1] / 1000.0:.1f} km'
    axes.set_title(f'Gap of run {index + 1}, {way}', fontsize=9, fontweight='normal')
    axes.set_xlabel('time since departure [s]')


def _locations(explanation: Explanation, *, by_position: bool) -> list[Location]:
    known = (location for location in explanation.locations if location.places)
    return [location for location in known if location.axis.startswith('position') == by_position]


def missing_along_line(explanation: Explanation, line: Line, found: Stretches) -> str:
    """Plot the missing resistance by position, before and after."""
    shown = _locations(explanation, by_position=True)
    if not shown:
        return ''
    with page.styled_figure(0.9 + 2.6 * len(shown)) as figure:
        panels = page.column_of_axes(figure, len(shown))
        for axes, location in zip(panels, shown, strict=True):
            _draw_ranges(axes, location)
            draw_place(axes, line, found)
            axes.set_title(f'Missing resistance by {location.axis}')
        low = min(place.low for location in shown for place in location.places)
        high = max(place.high for location in shown for place in location.places)
        panels[-1].set(xlim=(low, high), xlabel='position [m], dotted: stops')
        page.legend_above(figure, [*model_lines(explanation), *line_handles(line, found)])
        return page.to_svg(figure, 'Missing resistance by position')


def missing_by_part(explanation: Explanation) -> str:
    """Plot the missing resistance along all other axes."""
    shown = _locations(explanation, by_position=False)
    if not shown:
        return ''
    with page.styled_figure(0.5 + 2.5 * math.ceil(len(shown) / 2)) as figure:
        for axes, location in zip(_grid(figure, len(shown), 2), shown, strict=False):
            _draw_location(axes, location)
        page.legend_above(figure, [*model_lines(explanation)])
        return page.to_svg(figure, 'Missing resistance by speed, driving mode and so on')


def _draw_location(axes: Axes, location: Location) -> None:
    if all(math.isfinite(place.low) and math.isfinite(place.high) for place in location.places):
        _draw_ranges(axes, location)
        axes.set_xlabel(f'{location.axis} [{location.unit}]' if location.unit else location.axis)
    else:
        _draw_kinds(axes, location.places)
        labels = [place.label for place in location.places]
        every = math.ceil(len(labels) / 10)  # more labels would not be readable
        axes.set_xticks(range(0, len(labels), every), labels[::every])
    axes.set_title(f'by {location.axis}')


def _draw_ranges(axes: Axes, location: Location) -> None:
    places = sorted(location.places, key=lambda place: place.low)
    x, std = _steps(places, [place.std for place in places])
    axes.axhline(0.0, color=page.MUTED, linewidth=0.8)
    for colour, values in _values(places):
        value = _steps(places, values)[1]
        axes.fill_between(x, value - _SIGMAS * std, value + _SIGMAS * std, color=colour, alpha=0.18, linewidth=0)
        axes.plot(x, value, color=colour)
    axes.set_ylabel('missing [N/kN]')
    _fit(axes, places)


def _values(places: Sequence[Place]) -> tuple[tuple[str, list[float]], ...]:
    return (BEFORE, [place.before for place in places]), (AFTER, [place.after for place in places])


def _steps(places: Sequence[Place], values: Sequence[float]) -> tuple[Array, Array]:
    """Return x and a quantity at both ends of each range, with a break where ranges do not touch."""
    steps: list[tuple[float, float]] = []
    for place, value in zip(places, values, strict=True):
        if steps and place.low > steps[-1][0] + 1e-6 * abs(place.low):
            steps.append((place.low, math.nan))
        steps += [(place.low, value), (place.high, value)]
    x, y = np.array(steps).T
    return x, y


def _draw_kinds(axes: Axes, places: Sequence[Place]) -> None:
    at = np.arange(len(places))
    std = np.array([place.std for place in places])
    axes.axhline(0.0, color=page.MUTED, linewidth=0.8)
    for shift, (colour, values) in zip((-0.12, 0.12), _values(places), strict=True):
        axes.errorbar(at + shift, values, _SIGMAS * std, fmt='o', markersize=4, color=colour, capsize=3, linewidth=1.2)
    axes.set(xlim=(-0.6, len(places) - 0.4), ylabel='missing [N/kN]')
    axes.grid(visible=False, axis='x')
    _fit(axes, places)


def _fit(axes: Axes, places: Sequence[Place]) -> None:
    # With little driving the std is almost that of the prior, which must not define the axis.
    largest = 4.0 * float(np.median([place.std for place in places]))
    known = [place for place in places if place.std <= largest]
    ends = [
        np.array([value - _SIGMAS * place.std, value + _SIGMAS * place.std, 0.0])
        for place in known
        for value in (place.before, place.after)
    ]
    page.limit(axes, ends, 0.08)
