# SPDX-License-Identifier: Apache-2.0
"""Style of reports: colours for light and dark pages, figures as inline SVG, and elements shared by the figures."""

from __future__ import annotations

import re
from contextlib import contextmanager
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from trainid_ros.report.accuracy_scores import SIGMA_95

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from trainid_ros.report.traces import Array, Span

# Figures are drawn in these colours, which are then replaced by CSS variables: (colour, variable, dark colour).
INK: Final = '#1b1f24'
MUTED: Final = '#6b7280'
GRID: Final = '#d9dde3'
PAPER: Final = '#fdfdfe'
ESTIMATE: Final = '#1f5fa8'
SECOND: Final = '#0f766f'
TRACTION: Final = '#2a9d62'
COAST: Final = '#9cc9ea'
BRAKE: Final = '#d5602b'
STAND: Final = '#aab0b8'
GOOD: Final = '#2f8f5b'
WAIT: Final = '#e0b23c'
BAD: Final = '#c0392f'
_COLOURS: Final = (
    (INK, 'ink', '#e8eaee'),
    (MUTED, 'muted', '#98a1ad'),
    (GRID, 'grid', '#3a414b'),
    (PAPER, 'paper', '#15181c'),
    (ESTIMATE, 'estimate', '#6fb1ff'),
    (SECOND, 'second', '#4cc7bd'),
    (TRACTION, 'traction', '#3fbf7f'),
    (COAST, 'coast', '#4f86b3'),
    (BRAKE, 'brake', '#f08a5a'),
    (STAND, 'stand', '#5f6874'),
    (GOOD, 'good', '#49b97f'),
    (WAIT, 'wait', '#e3bd5a'),
    (BAD, 'bad', '#ee7a70'),
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


_WIDTH: Final = 10.4


@contextmanager
def styled_figure(height: float) -> Iterator[Figure]:
    """Yield a figure as wide as the page, to be drawn in the style of the reports whatever the user's settings.

    Args:
        height: Height of the figure [inch].
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)
        yield Figure(figsize=(_WIDTH, height), layout='constrained')


def to_svg(figure: Figure, label: str) -> str:
    """Return a figure as an SVG element for a page; ``label`` is its description for screen readers."""
    buffer = StringIO()
    figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None})
    text = buffer.getvalue()
    text = text[text.index('<svg') :]
    text = re.sub(r'<metadata>.*?</metadata>', '', text, flags=re.DOTALL)
    # Namespaces are implied in HTML, and the page scales the figure.
    text = re.sub(r'\s(xmlns|xmlns:xlink)="[^"]*"', '', text)
    text = re.sub(r'(<svg[^>]*?)\swidth="[^"]*"', r'\1', text, count=1)
    text = re.sub(r'(<svg[^>]*?)\sheight="[^"]*"', r'\1', text, count=1)
    text = text.replace('<svg', f'<svg role="img" aria-label="{escape(label)}"', 1)
    for colour, variable, _ in _COLOURS:
        text = text.replace(colour, f'var(--{variable})')
    return text


def css() -> str:
    """Return the style sheet of a report."""
    light = ''.join(f'--{name}:{colour};' for colour, name, _ in _COLOURS)
    dark = ''.join(f'--{name}:{colour};' for _, name, colour in _COLOURS)
    return (
        f':root{{color-scheme:light dark;{light}}}'
        f'@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}' + _RULES
    )


_RULES: Final = """
*{box-sizing:border-box}
body{margin:0 auto;max-width:1120px;padding:28px 24px 60px;background:var(--paper);color:var(--ink);
 font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",Arial,sans-serif}
h1{font-size:27px;line-height:1.2;margin:0 0 4px}
h2{font-size:21px;margin:44px 0 6px;padding-top:14px;border-top:3px solid var(--estimate)}
h3{font-size:16px;margin:30px 0 2px}
p{margin:4px 0 10px;max-width:85ch}
.sub,.caption{color:var(--muted)}
.caption{font-size:13.5px;margin:0 0 6px}
dl{display:grid;grid-template-columns:max-content 1fr;gap:2px 18px;margin:10px 0 14px}
dt{color:var(--muted)}dd{margin:0;overflow-wrap:anywhere}
.wide{overflow-x:auto}
table{border-collapse:collapse;margin:10px 0 16px;font-variant-numeric:tabular-nums}
caption{text-align:left;color:var(--muted);font-size:13.5px;padding-bottom:4px}
th,td{padding:4px 14px 4px 0;text-align:right;border-bottom:1px solid var(--grid);vertical-align:baseline}
th{font-weight:600;font-size:13px}
th:first-child,td:first-child{text-align:left}
td.text,th.text{text-align:left}
.cards{display:flex;flex-wrap:wrap;gap:12px;margin:14px 0 18px}
.card{flex:1 1 220px;border:1px solid var(--grid);border-radius:6px;padding:10px 14px}
.card .name{color:var(--muted);font-size:13px}
.card .value{font-size:23px;font-weight:600;line-height:1.3;font-variant-numeric:tabular-nums}
.card .value small{font-size:14px;font-weight:400;color:var(--muted)}
.card .more{font-size:13px;color:var(--muted)}
.tag{display:inline-block;border-radius:3px;padding:0 7px;font-size:12.5px;font-weight:600;color:var(--paper)}
.VALID{background:var(--good)}.HOLDING{background:var(--coast);color:#10202e}.CONVERGING,.UNINITIALIZED{background:var(--wait)}
.STALE,.FAULT{background:var(--bad)}
ul{margin:6px 0 12px;padding-left:20px}
figure{margin:6px 0 10px;break-inside:avoid;overflow-x:auto}
svg{display:block;width:100%;min-width:640px;height:auto}
nav a{margin-right:18px;color:var(--estimate)}
footer{margin-top:50px;color:var(--muted);font-size:13px}
@media print{body{max-width:none;padding:0;font-size:12px}svg{min-width:0}h2{break-before:page}nav{display:none}}
"""


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
