# SPDX-License-Identifier: Apache-2.0
"""Views as a screen of a terminal of any size, with rich."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal

from rich.console import Group
from rich.table import Table
from rich.text import Text

from trainid_ros.cli.output import in_ascii, printable
from trainid_ros.monitor.chart import ASCII, UNICODE, chart
from trainid_ros.monitor.view import (
    EstimateView,
    InputView,
    Level,
    TrainView,
    duration,
    number,
    rejections,
    state_of,
    with_band,
)
from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult

_SPAN_S: Final = 120.0
"""Time that the charts cover [s]."""
_COLUMN_S: Final = 0.6
"""Least time of a column, longer than the step of past values [s]."""
_STYLES: Final = {
    Status.VALID: 'bold green',
    Status.HOLDING: 'cyan',
    Status.CONVERGING: 'yellow',
    Status.UNINITIALIZED: 'yellow',
}
_BAD: Final = 'bold red'
_LEVEL_STYLES: Final = {Level.ERROR: _BAD, Level.STALE: _BAD, Level.WARN: 'yellow'}
_ONE_ROW, _TALL = 30, 48
_NARROW: Final = 72
_SILENT_S: Final = 1.5


class Screen:
    """A screen with one train in full, or with one line for each of several."""

    def __init__(self, views: Sequence[TrainView], notice: str = '') -> None:
        """Set what to show; the notice is shown where there is no train."""
        self._views = views
        self._notice = notice

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw for the present size of the terminal."""
        size = _Size(options.max_width, options.height or console.height, ascii_only=options.ascii_only)
        if not self._views:
            yield Text(self._notice)
        elif len(self._views) == 1:
            yield _train(self._views[0], size, console)
        else:
            yield _overview(self._views, size)


class _Size:
    """Room and characters of the terminal."""

    def __init__(self, width: int, height: int, *, ascii_only: bool) -> None:
        self.width = width
        self.height = height
        self.ascii_only = ascii_only

    @property
    def is_narrow(self) -> bool:
        return self.width < _NARROW

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
    parts: list[RenderableType] = [_head(view, size), _inputs(view.inputs, size)]
    used = 2 + len(view.inputs)
    for item in view.estimates:
        lines = _estimate(item, size)
        parts += lines
        used += len(lines)
    return Group(*parts, *_findings(view, size, console, max(size.height - used - 2, 1)))


def _head(view: TrainView, size: _Size) -> Text:
    running = sum(item.status is not None and not item.is_silent for item in view.estimates)
    speed = f'{number(view.speed_kmh, 1)} km/h'
    text = f'trainid monitor  {view.namespace}  {view.time}  {speed}  {running} of {len(view.estimates)} estimates'
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
        style = _input_style(item)
        cells = [size.text(item.name, style), size.text(_rate(item), style), size.text(_age(item), style)]
        if not size.is_narrow:
            cells += [size.text(item.value), size.text(', '.join(item.publishers) or 'none', 'dim')]
        table.add_row(*cells)
    return table


def _input_style(item: InputView) -> str:
    if item.silent_s < _SILENT_S:
        return ''
    return 'dim' if item.optional else _BAD


def _rate(item: InputView) -> str:
    return f'{number(item.rate, 1)} Hz' if math.isfinite(item.rate) else '–'


def _age(item: InputView) -> str:
    """Return the age of the newest stamp, and for how long nothing has come."""
    if math.isinf(item.silent_s):
        return 'never' if not item.optional else '–'
    if item.silent_s >= _SILENT_S:
        return f'none for {duration(item.silent_s)}'
    return f'{number(item.age_s, 2)} s' if math.isfinite(item.age_s) else 'other clock'


def _estimate(item: EstimateView, size: _Size) -> list[Text]:
    """Return the lines of an estimate: value and status, its chart, details and rejections."""
    style = _BAD if item.is_silent else 'dim' if item.status is None else _STYLES.get(item.status, _BAD)
    state = size.text(state_of(item), style)
    name = size.text(f'{item.name:<12}', 'bold')
    if item.status is None:
        return [Text(), Text.assemble(name, ' ', state)]
    headline = size.text(f'{item.quantity}  {with_band(item)}')
    # The end of a line may be cut: on a narrow terminal the status begins the last one.
    first, last = ('', state) if size.is_narrow else (state, '')
    lines = [Text.assemble(name, ' ', headline, '  ', first, no_wrap=True, overflow=headline.overflow)]
    lines += _chart(item, size)
    if size.height > _ONE_ROW or not size.is_narrow:
        lines.append(size.text(f'  {item.details}', 'dim'))
    counts = size.text(f'  {rejections(item)}', 'dim')
    lines.append(Text.assemble('  ', last, counts, no_wrap=True, overflow=counts.overflow) if last else counts)
    return [Text(), *lines] if size.height > _ONE_ROW else lines


def _chart(item: EstimateView, size: _Size) -> list[Text]:
    rows = 1 if size.height <= _ONE_ROW else 3 if size.height < _TALL else 5
    columns = max(size.width - 12, 8)
    oldest_s = item.history[0].ago_s if item.history else 0.0
    span_s = max(min(oldest_s, _SPAN_S), _COLUMN_S * columns)
    drawn = chart(item.history, columns, rows, span_s, ASCII if size.ascii_only else UNICODE)
    labels = [''] * rows
    labels[-1], labels[0] = number(drawn.low), number(drawn.high)
    return [size.text(f'  {line} {label}', 'green') for line, label in zip(drawn.lines, labels, strict=True)]


def _findings(view: TrainView, size: _Size, console: Console, room: int) -> list[Text]:
    """Return the findings in the lines that are left, and how many do not fit."""
    if not view.findings:
        return [Text(), size.text('diagnostics: nothing to report', 'dim')]
    lines: list[Text] = []
    for count, item in enumerate(view.findings):
        text = size.text(f'{item.level.name} {item.source}: {item.text}', _LEVEL_STYLES[item.level])
        text.no_wrap = False
        wrapped = list(text.wrap(console, size.width))
        left = len(view.findings) - count
        if lines and len(lines) + len(wrapped) > room - (left > 1):
            lines.append(size.text(f'… and {left} more', 'dim'))
            break
        lines += wrapped
    return [Text(), *lines] if size.height > _ONE_ROW else lines


def _overview(views: Sequence[TrainView], size: _Size) -> Group:
    """Return one line for each train, and its worst finding."""
    table = Table(box=None, pad_edge=False, header_style='dim')
    speeds = [f'{number(view.speed_kmh, 1)} km/h' for view in views]
    # Names are needed to ask for one train in full: where there is little room, estimates are cut first.
    for name, shown in (('train', [view.namespace for view in views]), ('speed', speeds)):
        least = min(max(map(len, shown)), size.width // 2)
        table.add_column(name, no_wrap=True, overflow=size.overflow, min_width=least)
    for item in views[0].estimates:
        table.add_column(item.name, no_wrap=True, overflow=size.overflow)
    findings: list[Text] = []
    for view, speed in zip(views, speeds, strict=True):
        cells = [size.text(view.namespace, 'bold'), size.text(speed)]
        for item in view.estimates:
            style = _BAD if item.is_silent or item.status is None else _STYLES.get(item.status, _BAD)
            known = '' if item.status is None else f'{number(item.value)} ± {number(item.std)} '
            value = size.text(known)
            cells.append(Text.assemble(value, size.text(state_of(item), style), overflow=value.overflow))
        table.add_row(*cells)
        findings += [
            size.text(f'{view.namespace} {item.level.name} {item.source}: {item.text}', _LEVEL_STYLES[item.level])
            for item in view.findings[:1]
        ]
    head = size.text(f'trainid monitor  {len(views)} trains  {views[0].time}  one in full: --namespace NAME', 'bold')
    return Group(head, table, Text(), *findings)
