# SPDX-License-Identifier: Apache-2.0
"""Figures of the resistance that a model lacks, along the line and by speed, driving mode and so on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.figure import Figure

from trainid_ros.report.axes import legend_above, limit
from trainid_ros.report.gap_figures import AFTER, AFTER_LINE, BEFORE, BEFORE_LINE, draw_place, line_handles
from trainid_ros.report.style import MUTED, house_style, to_svg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from trainid_ros.explain.explanation import Explanation, Location, Place
    from trainid_ros.report.gap_figures import Stretches
    from trainid_ros.train.train_file import Line

    Array = NDArray[np.float64]

_WIDE: Final = 10.4
_ACROSS: Final = 2
_SIGMAS: Final = 2.0
_MISSING: Final = 'missing [N/kN]'
# With more labels they would not be readable.
_NAMES: Final = 10
# Multiple of the median std beyond which a part does not define the axis: with little driving it is almost the prior.
_MAX_STD: Final = 4.0


def missing_along_line(explanation: Explanation, line: Line, found: Stretches) -> str:
    """Plot the missing resistance by position, before and after."""
    shown = [location for location in explanation.locations if _is_position(location) and location.places]
    if not shown:
        return ''
    with house_style():
        figure = Figure(figsize=(_WIDE, 0.9 + 2.6 * len(shown)), layout='constrained')
        panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for axes, location in zip(panels, shown, strict=True):
            _draw_ranges(axes, location)
            draw_place(axes, line, found)
            axes.set_title(f'Missing resistance by {location.axis}')
        low = min(place.low for location in shown for place in location.places)
        high = max(place.high for location in shown for place in location.places)
        panels[-1].set_xlim(low, high)
        panels[-1].set_xlabel('position [m], dotted: stops')
        legend_above(figure, [BEFORE_LINE, AFTER_LINE, *line_handles(line, found)])
        return to_svg(figure, 'Missing resistance by position')


def missing_by_part(explanation: Explanation) -> str:
    """Plot the missing resistance along all other axes."""
    shown = [location for location in explanation.locations if not _is_position(location) and location.places]
    if not shown:
        return ''
    rows = -(-len(shown) // _ACROSS)
    with house_style():
        figure = Figure(figsize=(_WIDE, 0.5 + 2.5 * rows), layout='constrained')
        panels = figure.subplots(rows, _ACROSS, squeeze=False).ravel()
        for axes, location in zip(panels, shown, strict=False):
            _draw_location(axes, location)
        for axes in panels[len(shown) :]:
            axes.set_visible(False)
        legend_above(figure, [BEFORE_LINE, AFTER_LINE])
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
