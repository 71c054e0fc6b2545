# SPDX-License-Identifier: Apache-2.0
"""Views as a screen of a terminal of any size, with rich, or as lines of text where none can be drawn.

A chart shows an estimate over time in characters: a line of blocks, or lines with the band of two standard deviations.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from rich.console import Console, ConsoleOptions, Group, JustifyMethod, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from trainid_ros.interface.results import Status
from trainid_ros.interface.text import in_ascii, printable
from trainid_ros.monitor.trains import (
    EstimateView,
    InputView,
    Level,
    Point,
    TrainView,
    duration,
    number,
    rejections,
    state_of,
    with_band,
)

BAND_STD: Final = 2.0
# Values that differ less than this share of their size are drawn as a level line [1].
_MIN_SPAN: Final = 1e-3
# Larger values are not drawn: messages may hold any number.
_LARGEST: Final = 1e100


class Marks(NamedTuple):
    """Characters of a chart: levels of a single line from low to high, the value and the band of several lines."""

    levels: str
    value: str
    band: str


UNICODE: Final = Marks('▁▂▃▄▅▆▇█', '●', '░')
ASCII: Final = Marks('_.-~=+*#', 'o', ':')


class Chart(NamedTuple):
    """Lines of a chart, the top one first, and the values of its upper and lower edge."""

    lines: tuple[str, ...]
    high: float
    low: float


def chart(points: Sequence[Point], columns: int, rows: int, span_s: float, marks: Marks = UNICODE) -> Chart:
    """Draw the last time of an estimate; lines are empty where no value is in that time.

    Args:
        points: Past values, the oldest first.
        columns: Characters in a line.
        rows: Lines; a single one shows the value alone.
        span_s: Time that the columns cover [s].
        marks: Characters to use.
    """
    binned: list[Point | None] = [None] * columns  # the last point in the time of each column
    for point in points:
        column = columns - 1 - int(point.ago_s / span_s * columns)
        if 0 <= column < columns and abs(point.value) < _LARGEST:
            binned[column] = point
    drawn = [point for point in binned if point is not None]
    if not drawn:
        return Chart((' ' * columns,) * rows, math.nan, math.nan)
    low, high = _range(drawn, with_band=rows > 1)
    lines = [''.join(_chart_cell(point, row, rows, low, high, marks) for point in binned) for row in range(rows)]
    return Chart(tuple(reversed(lines)), high, low)


def _range(drawn: Sequence[Point], *, with_band: bool) -> tuple[float, float]:
    """Return the lower and upper edge: all values, and their bands unless much wider than the narrowest."""
    values = [point.value for point in drawn]
    if with_band:
        widest = 3.0 * min(map(_deviation, drawn))  # wider ones are cut off
        for point in drawn:
            half = BAND_STD * min(_deviation(point), widest)
            values += [point.value - half, point.value + half]
    low, high = min(values), max(values)
    least = _MIN_SPAN * max(abs(low), abs(high), _MIN_SPAN)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), least)
    return middle - half, middle + half


def _deviation(point: Point) -> float:
    return point.std if abs(point.std) < _LARGEST else 0.0


def _chart_cell(point: Point | None, row: int, rows: int, low: float, high: float, marks: Marks) -> str:
    """Return the character of a column; row 0 is the lowest one."""
    if point is None:
        return ' '
    place = (point.value - low) / (high - low) * rows
    if rows == 1:
        return marks.levels[min(int(place * len(marks.levels)), len(marks.levels) - 1)]
    if row == min(int(place), rows - 1):
        return marks.value
    half = BAND_STD * _deviation(point) / (high - low) * rows
    return marks.band if place - half < row + 1 and place + half > row else ' '


class Lines:
    """Turns views into lines: the state of each train every time, findings when they come and go."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], str] = {}
        self._notice = ''

    def of(self, views: Sequence[TrainView], notice: str) -> list[str]:
        """Return what to print now; the notice, where there is no train, only when it changes."""
        lines = [] if views or notice == self._notice else [notice]
        self._notice = '' if views else notice
        present: dict[tuple[str, str, str], str] = {}
        for view in views:
            lines.append(train_line(view))
            for item in view.findings:
                present[view.namespace, item.source, item.level.name] = item.text
        # A finding is news if it says more than other numbers.
        news = (key for key, text in present.items() if _without_numbers(text) != self._known.get(key))
        for namespace, source, level in sorted(news):
            lines.append(f'{namespace} {level} {source}: {present[namespace, source, level]}')
        gone = sorted(self._known.keys() - present.keys())
        shown = {view.namespace for view in views}
        lines += [f'{namespace} {level} {source} cleared' for namespace, source, level in gone if namespace in shown]
        self._known = {key: _without_numbers(text) for key, text in present.items()}
        return [printable(line.replace('\n', ' ')) for line in lines]


def _without_numbers(text: str) -> str:
    return re.sub(r'-?[0-9.]+(e[-+]?[0-9]+)?', '', text)


def train_line(view: TrainView) -> str:
    """Return the state of a train as one line."""
    parts = [f'{view.time} {view.namespace}  {number(view.speed_kmh, 1)} km/h']
    for item in view.estimates:
        known = '' if item.status is None else f' {with_band(item)}'
        parts.append(f'{item.name}{known} {state_of(item)}')
    return ' | '.join((*parts, 'inputs ' + ', '.join(_input_lines(view.inputs))))


def _input_lines(inputs: Iterable[InputView]) -> Iterable[str]:
    """Yield name, rate and age of each input; optional ones only if they come."""
    for item in inputs:
        if not math.isinf(item.silent_s):
            yield f'{item.name} {number(item.rate, 1)} Hz {number(item.silent_s, 1)} s'
        elif not item.optional:
            yield f'{item.name} never'


_STYLES: Final = {
    Status.VALID: 'bold green',
    Status.HOLDING: 'cyan',
    Status.CONVERGING: 'yellow',
    Status.UNINITIALIZED: 'yellow',
}
_BAD: Final = 'bold red'
_LEVEL_STYLES: Final = {Level.ERROR: _BAD, Level.STALE: _BAD, Level.WARN: 'yellow'}
# An input that is silent for longer is shown as late [s].
_SILENT_S: Final = 1.5


# Rows of the charts and what else is shown of a train: gaps between parts, details, counts of samples, inputs. The
# first one that leaves room for findings is drawn: the status of each estimate is always shown.
_LAYOUTS: Final = (
    *((rows, frozenset({'inputs', 'counts', 'details', 'gaps'})) for rows in (5, 3, 1)),
    (1, frozenset({'inputs', 'counts', 'details'})),
    *((rows, frozenset({'inputs', 'counts'})) for rows in (1, 0)),
    (0, frozenset({'inputs'})),
    (0, frozenset()),
)


@dataclass(frozen=True, slots=True)
class Screen:
    """A screen with one train in full, or with one line for each of several."""

    views: Sequence[TrainView]
    notice: str = ''  # What to show where there is no train

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw for the present size of the terminal."""
        size = _Size(options.max_width, options.height or console.height, ascii_only=options.ascii_only)
        if not self.views:
            yield Text(self.notice)
        elif len(self.views) == 1:
            yield _train(self.views[0], size, console)
        else:
            yield _overview(self.views, size)


class _Size(NamedTuple):
    """Room and characters of the terminal."""

    width: int
    height: int
    ascii_only: bool

    @property
    def is_narrow(self) -> bool:
        return self.width < 72

    @property
    def overflow(self) -> Literal['crop', 'ellipsis']:
        """How a text too long for its line ends."""
        return 'crop' if self.ascii_only else 'ellipsis'

    def text(self, content: str, style: str = '') -> Text:
        """Return text that this terminal can show, cut to its line."""
        shown = printable(content)
        text = in_ascii(shown) if self.ascii_only else shown
        return Text(text, style, no_wrap=True, overflow=self.overflow)


def _train(view: TrainView, size: _Size, console: Console) -> RenderableType:
    findings = _findings(view, size, console)
    # With little room, the worst one in full and how many more there are.
    wanted = min(sum(map(len, findings)), max(len(findings[0]) + 1, size.height // 4))
    for rows, shown in _LAYOUTS:
        estimates = _estimates(view.estimates, size, rows, shown)
        used = 1 + (1 + len(view.inputs)) * ('inputs' in shown) + len(estimates) + ('gaps' in shown)
        if used + wanted < size.height:
            break
    inputs = [_inputs(view.inputs, size)] if 'inputs' in shown else []
    gap = [Text()] * ('gaps' in shown)
    return Group(_head(view, size), *inputs, *estimates, *gap, *_shortened(findings, size.height - used - 1, size))


def _head(view: TrainView, size: _Size) -> Text:
    running = sum(item.status is not None and not item.is_silent for item in view.estimates)
    title = '' if size.is_narrow else 'trainid monitor  '
    speed = f'{number(view.speed_kmh, 1)} km/h'
    text = f'{title}{view.namespace}  {view.time}  {speed}  {running} of {len(view.estimates)} estimates'
    return size.text(text, 'bold')


def _inputs(inputs: Iterable[InputView], size: _Size) -> Table:
    table = Table(box=None, pad_edge=False, expand=not size.is_narrow, header_style='dim')
    for name in ('input', 'rate', 'age'):
        justify: JustifyMethod = 'left' if name == 'input' else 'right'
        table.add_column(name, justify=justify, no_wrap=True, overflow=size.overflow)
    if not size.is_narrow:
        for name in ('value', 'publisher'):
            table.add_column(name, no_wrap=True, overflow=size.overflow, ratio=1)
    for item in inputs:
        late = 'dim' if item.optional else _BAD
        style = '' if item.silent_s < _SILENT_S else late
        rate = f'{number(item.rate, 1)} Hz' if math.isfinite(item.rate) else '–'
        cells = [size.text(item.name, style), size.text(rate, style), size.text(_age(item), style)]
        if not size.is_narrow:
            cells += [size.text(item.value), size.text(', '.join(item.publishers) or 'none', 'dim')]
        table.add_row(*cells)
    return table


def _age(item: InputView) -> str:
    """Return the age of the newest stamp, and for how long nothing has come."""
    if math.isinf(item.silent_s):
        return 'never' if not item.optional else '–'
    if item.silent_s >= _SILENT_S:
        return f'none for {duration(item.silent_s)}'
    return f'{number(item.age_s, 2)} s' if math.isfinite(item.age_s) else 'other clock'


def _estimates(items: Sequence[EstimateView], size: _Size, rows: int, shown: frozenset[str]) -> list[Text]:
    """Return the lines of all estimates: status and value, chart, details and samples."""
    lines: list[Text] = []
    states = [_state(item, size) for item in items]
    for item, state in zip(items, states, strict=True):
        name = size.text(f'{item.name:<12} ', 'bold')
        # The end of a line may be cut: the status comes first, then the value.
        state.pad_right(max(map(len, states)) - len(state))
        value = '' if item.status is None else f'  {with_band(item)}  {item.quantity}'
        lines += [Text()] * ('gaps' in shown)
        lines.append(Text.assemble(name, state, size.text(value), no_wrap=True, overflow=size.overflow))
        if item.status is None:
            continue
        lines += _chart(item, size, rows)
        lines += [size.text(f'  {item.details}', 'dim')] * ('details' in shown)
        lines += [size.text(f'  {rejections(item)}', 'dim')] * ('counts' in shown)
    return lines


def _state(item: EstimateView, size: _Size) -> Text:
    known = 'dim' if item.status is None else _BAD if item.is_silent else _STYLES.get(item.status, _BAD)
    return size.text(state_of(item), 'yellow' if item.idle else known)


def _chart(item: EstimateView, size: _Size, rows: int) -> list[Text]:
    if not rows:
        return []
    # The chart covers at most 120 s. A column is longer than the time between past values: 1 s at most.
    columns = min(max(size.width - 12, 8), 100)
    oldest_s = item.history[0].ago_s if item.history else 0.0
    span_s = max(min(oldest_s, 120.0), 1.2 * columns)
    drawn = chart(item.history, columns, rows, span_s, ASCII if size.ascii_only else UNICODE)
    labels = [''] * rows
    labels[-1], labels[0] = number(drawn.low), number(drawn.high)
    return [size.text(f'  {line} {label}', 'green') for line, label in zip(drawn.lines, labels, strict=True)]


def _findings(view: TrainView, size: _Size, console: Console) -> list[Sequence[Text]]:
    if not view.findings:
        nothing = 'nothing to report' if view.has_diagnostics else 'none have arrived'
        return [[size.text(f'diagnostics: {nothing}', 'dim')]]
    found: list[Sequence[Text]] = []
    for item in view.findings:
        text = size.text(f'{item.level.name} {item.source}: {item.text}', _LEVEL_STYLES[item.level])
        text.no_wrap = False
        found.append(list(text.wrap(console, size.width)))
    return found


def _shortened(parts: Sequence[Sequence[Text]], room: int, size: _Size) -> list[Text]:
    """Return the lines of the first parts, as many as there is room for, and how many more there are."""
    lines: list[Text] = []
    for count, part in enumerate(parts):
        left = len(parts) - count
        fitting = room - len(lines) - (left > 1)
        if count and len(part) > fitting:
            return [*lines, size.text(f'… and {left} more', 'dim')]
        lines += part[: max(fitting, 1)]
    return lines


def _overview(views: Sequence[TrainView], size: _Size) -> Group:
    """Return a line for each train, and its worst finding; the worst train comes first."""
    severity = {view.namespace: max((item.level.severity for item in view.findings), default=0) for view in views}
    views = sorted(views, key=lambda view: (-severity[view.namespace], view.namespace))
    head = size.text(f'trainid monitor  {len(views)} trains  {views[0].time}  one in full: --namespace NAME', 'bold')
    titles, *rows = _table(views, size)
    findings = [
        [size.text(f'{view.namespace} {item.level.name} {item.source}: {item.text}', _LEVEL_STYLES[item.level])]
        for view in views
        for item in view.findings[:1]
    ]
    room = size.height - 3  # without the head, the titles and the line of the cursor
    listed = min(len(rows), room - min(len(findings), max(room // 4, 2)))
    shown = _shortened([[row] for row in rows], listed, size)
    return Group(head, titles, *shown, *_shortened(findings, room - len(shown), size))


def _table(views: Sequence[TrainView], size: _Size) -> list[Text]:
    """Return the titles and a line for each train; values of estimates are shown where they fit."""
    names = [size.text('train', 'dim'), *(size.text(view.namespace, 'bold') for view in views)]
    speeds = [size.text('speed', 'dim'), *(size.text(f'{number(view.speed_kmh, 1)} km/h') for view in views)]
    # Names are needed to ask for one train in full.
    columns = [_padded(names, min(max(map(len, names)), size.width // 2), size)]
    if size.width >= 60:
        columns.append(_padded(speeds, max(map(len, speeds)), size))
    count = len(views[0].estimates)
    width = (size.width - sum(len(column[0]) + 2 for column in columns) - 2 * (count - 1)) // count
    for k in range(count):
        cells = [_cell(view.estimates[k], width, size) for view in views]
        columns.append(_padded([size.text(views[0].estimates[k].name, 'dim'), *cells], width, size))
    return [Text('  ', no_wrap=True, overflow=size.overflow).join(cells) for cells in zip(*columns, strict=True)]


def _cell(item: EstimateView, width: int, size: _Size) -> Text:
    state = _state(item, size)
    value = '' if item.status is None else f'  {number(item.value)} ± {number(item.std)}'
    return Text.assemble(state, size.text(value)) if len(state) + len(value) < width else state


def _padded(cells: Sequence[Text], width: int, size: _Size) -> Sequence[Text]:
    for cell in cells:
        cell.truncate(max(width, 1), overflow=size.overflow, pad=True)
    return cells
