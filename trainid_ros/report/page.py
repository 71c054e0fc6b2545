# SPDX-License-Identifier: Apache-2.0
"""Reports as one self-contained HTML file, from the templates in this folder, and the figures in it as inline SVG.

Figures have the colours of light and dark pages.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from html import escape
from importlib.metadata import PackageNotFoundError, version
from io import StringIO
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros import __version__
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.report import HTML_START
from trainid_ros.report.recording import Array, Panel, Span

SIGMA_95: Final = 1.959964
"""Two-sided normal quantile of 95 %."""
COLOURS: Final = (
    ('ink', '#1b1f24', '#e8eaee'),
    ('muted', '#6b7280', '#98a1ad'),
    ('grid', '#d9dde3', '#3a414b'),
    ('paper', '#fdfdfe', '#15181c'),
    ('estimate', '#1f5fa8', '#6fb1ff'),
    ('second', '#0f766f', '#4cc7bd'),
    ('traction', '#2a9d62', '#3fbf7f'),
    ('coast', '#9cc9ea', '#4f86b3'),
    ('brake', '#d5602b', '#f08a5a'),
    ('stand', '#aab0b8', '#5f6874'),
    ('good', '#2f8f5b', '#49b97f'),
    ('wait', '#e0b23c', '#e3bd5a'),
    ('bad', '#c0392f', '#ee7a70'),
)
"""CSS variables, with their colours on light and dark pages. Figures are drawn in the light ones, then replaced."""
INK, MUTED, GRID, PAPER, ESTIMATE, SECOND, TRACTION, COAST, BRAKE, STAND, GOOD, WAIT, BAD = (
    light for _, light, _ in COLOURS
)
# Any: rcParams takes only the literal names it knows.
_RC: Final[Any] = {
    'svg.fonttype': 'none',
    'svg.hashsalt': 'trainid',
    'font.family': 'sans-serif',
    'font.sans-serif': ['DejaVu Sans'],
    'font.size': 9.0,
    'text.color': INK,
    'axes.labelcolor': INK,
    'axes.edgecolor': MUTED,
    'axes.facecolor': 'none',
    'axes.titlesize': 10.0,
    'axes.titleweight': 'bold',
    'axes.titlelocation': 'left',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.formatter.useoffset': False,  # an axis with 0.0002 and '+1' beside it is misread
    'grid.color': GRID,
    'grid.linewidth': 0.6,
    'xtick.color': MUTED,
    'ytick.color': MUTED,
    'xtick.labelcolor': INK,
    'ytick.labelcolor': INK,
    'legend.frameon': False,
    'legend.fontsize': 8.5,
    'legend.handlelength': 1.6,
    'lines.linewidth': 1.3,
    'figure.facecolor': 'none',
    'path.simplify_threshold': 0.3,
}


@contextmanager
def styled_figure(height: float) -> Iterator[Figure]:
    """Yield a figure of a height [inch], as wide as the page, in the style of the reports whatever the user's."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)
        yield Figure(figsize=(10.4, height), layout='constrained')


def to_svg(figure: Figure, label: str) -> Markup:
    """Return a figure as an SVG element for a page; ``label`` is its description for screen readers."""
    buffer = StringIO()
    figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None})
    text = buffer.getvalue()
    text = text[text.index('<svg') :]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    # Namespaces are implied in HTML, and the page scales the figure.
    text = re.sub(r'\s(xmlns|xmlns:xlink)="[^"]*"', '', text)
    for size in ('width', 'height'):
        text = re.sub(rf'(<svg[^>]*?)\s{size}="[^"]*"', r'\1', text, count=1)
    text = text.replace('<svg', f'<svg role="img" aria-label="{escape(label)}"', 1)
    for variable, light, _ in COLOURS:
        text = text.replace(light, f'var(--{variable})')
    return Markup(text)


_LIGHT: Final = 0.16
_DARK: Final = 0.3

DASHES: Final = (0, (5, 2))
"""Line style of a truth."""
PRIOR_DASHES: Final = (0, (1, 1.5))
"""Line style of the values of the train file."""
ESTIMATE_LINE: Final = Line2D([], [], color=ESTIMATE, label='estimate')
BAND_68: Final = Patch(color=ESTIMATE, alpha=_LIGHT + _DARK, linewidth=0, label='68 %')
BAND_95: Final = Patch(color=ESTIMATE, alpha=_LIGHT, linewidth=0, label='95 %')
TRUTH_LINE: Final = Line2D([], [], color=INK, linestyle=DASHES, label='truth')
PRIOR_LINE: Final = Line2D([], [], color=MUTED, linestyle=PRIOR_DASHES, label='train file (prior)')


def pick(length: int) -> slice:
    """Return a slice that thins ``length`` points to at most 700, since a figure has not many more pixels."""
    return slice(None, None, max(1, -(-length // 700)))


def draw_band(axes: Axes, x: Array, value: Array, std: Array, colour: str = ESTIMATE) -> None:
    """Draw an estimate with its 68 and 95 % bands."""
    for sigmas, alpha in ((SIGMA_95, _LIGHT), (1.0, _DARK)):
        low, high = value - sigmas * std, value + sigmas * std
        axes.fill_between(x, low, high, color=colour, alpha=alpha, linewidth=0)
    axes.plot(x, value, color=colour)


def draw_panel(axes: Axes, panel: Panel, colour: str = ESTIMATE, width: float | None = None) -> None:
    """Draw a panel of a recording, with its band, the value of the train file and the truth if there are any."""
    time_min = panel.time_ns / NS_PER_S / 60.0
    if panel.std is None:
        axes.plot(time_min, panel.value, color=colour, linewidth=width)
    else:
        draw_band(axes, time_min, panel.value, panel.std, colour)
    if panel.prior is not None:
        axes.axhline(panel.prior, color=MUTED, linestyle=PRIOR_DASHES, linewidth=1.2)
    if panel.truth is not None:
        axes.plot(time_min, panel.truth, color=INK, linestyle=DASHES, linewidth=1.2, drawstyle='steps-post')
    if panel.std is not None:
        # The axis shows the band where the estimate is usable, otherwise the estimate.
        shown, usable = [panel.value], panel.usable
        if usable is not None and usable.any():
            shown = [(panel.value - SIGMA_95 * panel.std)[usable], (panel.value + SIGMA_95 * panel.std)[usable]]
        limit(axes, [*shown, *(np.atleast_1d(other) for other in (panel.prior, panel.truth) if other is not None)])
    axes.set(title=panel.title, ylabel=panel.label)


def draw_spans(
    axes: Axes, spans: Iterable[Span], colours: Mapping[str, str], *,
    alpha: float | None = None, lane: tuple[float, float] | None = None, edge: float = 0.0,
) -> None:  # fmt: skip
    """Shade spans of time: by default over the whole height, behind a plot; otherwise from a height on, and how far.

    ``edge`` is the share of the height over which the upper edge is drawn opaque, before the plot [1].
    """
    place: dict[str, Any] = {'transform': axes.get_xaxis_transform()} if lane is None else {}
    for label, colour in colours.items():
        bars = [(span.start_s / 60.0, (span.end_s - span.start_s) / 60.0) for span in spans if span.label == label]
        if bars:
            axes.broken_barh(bars, lane or (0.0, 1.0), facecolors=colour, alpha=alpha, linewidth=0, **place)
            if edge:
                axes.broken_barh(bars, (1.0 - edge, edge), facecolors=colour, linewidth=0, zorder=3, **place)


FAULTS: Final = {'contradiction': (BAD, 0.18), 'gap': (MUTED, 0.3), 'rejected': (WAIT, 0.3), 'slip': (BAD, 0.3)}
"""Colour and opacity of what is wrong with the inputs, by the labels of its spans."""


def draw_faults(axes: Axes, spans: Sequence[Span], duration_s: float) -> list[Patch]:
    """Shade what is wrong with the inputs, each at least as wide as a line; return the entries for the legend."""
    patches, least_s = [], duration_s / 700.0
    for label, (colour, alpha) in FAULTS.items():
        joined: list[Span] = []
        for span in (span for span in spans if span.label == label):
            end_s = max(span.end_s, span.start_s + least_s)
            if joined and span.start_s - joined[-1].end_s < least_s:
                joined[-1] = joined[-1]._replace(end_s=end_s)
            else:
                joined.append(span._replace(end_s=end_s))
        if joined:
            # A wide band, as of a prior, hides the shade, but not its edge.
            draw_spans(axes, joined, {label: colour}, alpha=alpha, edge=0.05)
            patches.append(Patch(color=colour, alpha=alpha, linewidth=0, label=label))
    return patches


def limit(axes: Axes, values: Sequence[Array], margins: float = 0.12) -> None:
    """Fit the value axis to these values, so that a wide band at the start does not compress the rest."""
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    if not len(known):
        return
    low, high = float(known.min()), float(known.max())
    room = margins * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_ylim(low - room, high + room)


def keep_room(axes: Axes, least: float) -> None:
    """Widen the value axis until it shows at least so much on either side of its middle: what is finer is noise."""
    low, high = axes.get_ylim()
    middle = 0.5 * (low + high)
    axes.set_ylim(min(low, middle - least), max(high, middle + least))


def time_axis(axes: Axes, duration_s: float) -> None:
    """Label a time axis in minutes."""
    axes.set(xlim=(0.0, max(duration_s / 60.0, 1e-3)), xlabel='time since start [min]')


def legend_above(figure: Figure, handles: Sequence[Artist]) -> None:
    """Draw one legend for all panels in a row above them."""
    figure.legend(handles=list(handles), loc='outside upper right', ncols=len(handles))


_TEMPLATES: Final = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_PARTS: Final[Any] = _TEMPLATES.get_template('parts.html.j2').module
# For pages made by others: lists of text, figures as (heading, caption, SVG), tables.
bullets: Final = _PARTS.bullets
captioned: Final = _PARTS.figures
facts: Final = _PARTS.facts
html_table: Final = _PARTS.table


def render(template: str, title: str, **content: Any) -> str:
    """Return a page as HTML text, with its heading and what its template shows, by the names used there."""
    versions = [f'trainid_ros {__version__}', f'Python {platform.python_version()}']
    for library in ('numpy', 'scipy', 'rclpy'):
        with suppress(PackageNotFoundError):
            versions.append(f'{library} {version(library)}')
    shown = {'start': Markup(HTML_START), 'version': __version__, 'versions': versions, 'colours': COLOURS}
    return _TEMPLATES.get_template(template).render(title=title, **shown, **content)


def page(title: str, body: str, footer: str) -> str:
    """Return a page as HTML text; the body is HTML, heading and last line are text."""
    return render('page.html.j2', title, body=Markup(body), footer=footer)


def column_of_axes(figure: Figure, count: int, **options: Any) -> Any:
    """Return axes one above the other, with one horizontal axis."""
    return figure.subplots(count, 1, sharex=True, squeeze=False, **options)[:, 0]
