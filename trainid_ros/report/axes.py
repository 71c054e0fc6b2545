# SPDX-License-Identifier: Apache-2.0
"""Elements shared by the figures of a report: bands, steps of the truth, spans, time axes, legends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros.report.scores import SIGMA_95
from trainid_ros.report.style import ESTIMATE, INK, MUTED

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from trainid_ros.report.traces import Array, Span

# More points than a figure has pixels add no information.
POINTS: Final = 700
_LIGHT: Final = 0.16
_DARK: Final = 0.3

ESTIMATE_LINE: Final = Line2D([], [], color=ESTIMATE, label='estimate')
BAND_68: Final = Patch(color=ESTIMATE, alpha=_LIGHT + _DARK, linewidth=0, label='68 %')
BAND_95: Final = Patch(color=ESTIMATE, alpha=_LIGHT, linewidth=0, label='95 %')
TRUTH_LINE: Final = Line2D([], [], color=INK, linestyle=(0, (5, 2)), label='truth')
PRIOR_LINE: Final = Line2D([], [], color=MUTED, linestyle=(0, (1, 1.5)), label='train file (prior)')


def pick(length: int) -> slice:
    """Return a slice that thins ``length`` points to at most :data:`POINTS`."""
    return slice(None, None, max(1, -(-length // POINTS)))


def minutes(time_s: Array) -> Array:
    """Convert seconds to minutes, the unit of all time axes."""
    return time_s / 60.0


def draw_band(axes: Axes, x: Array, value: Array, std: Array, colour: str = ESTIMATE) -> None:
    """Draw an estimate with its 68 and 95 % bands."""
    for sigmas, alpha in ((SIGMA_95, _LIGHT), (1.0, _DARK)):
        low, high = value - sigmas * std, value + sigmas * std
        axes.fill_between(x, low, high, color=colour, alpha=alpha, linewidth=0)
    axes.plot(x, value, color=colour)


def draw_steps(axes: Axes, x: Array, value: Array) -> None:
    """Draw a truth that changes in steps."""
    axes.plot(x, value, color=INK, linestyle=(0, (5, 2)), linewidth=1.2, drawstyle='steps-post')


def draw_prior(axes: Axes, value: float) -> None:
    """Draw the value of the train file."""
    axes.axhline(value, color=MUTED, linestyle=(0, (1, 1.5)), linewidth=1.2)


def draw_spans(axes: Axes, spans: Iterable[Span], colours: Mapping[str, str], alpha: float = 0.25) -> None:
    """Shade spans of time behind a plot, over its whole height."""
    for label, colour in colours.items():
        bars = [(span.start_s / 60.0, (span.end_s - span.start_s) / 60.0) for span in spans if span.label == label]
        if bars:
            axes.broken_barh(
                bars,
                (0.0, 1.0),
                facecolors=colour,
                alpha=alpha,
                linewidth=0,
                transform=axes.get_xaxis_transform(),
            )


def limit(axes: Axes, values: Sequence[Array], margins: float = 0.12) -> None:
    """Fit the value axis to these values, so that a wide band at the start does not compress the rest."""
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    if not len(known):
        return
    low, high = float(known.min()), float(known.max())
    room = margins * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_ylim(low - room, high + room)


def time_axis(axes: Axes, duration_s: float) -> None:
    """Label a time axis in minutes."""
    axes.set_xlim(0.0, max(duration_s / 60.0, 1e-3))
    axes.set_xlabel('time since start [min]')


def legend_above(figure: Figure, handles: Sequence[Artist]) -> None:
    """Draw one legend for all panels in a row above them."""
    figure.legend(handles=list(handles), loc='outside upper right', ncols=len(handles))
