# SPDX-License-Identifier: Apache-2.0
"""Tables as aligned text and as Markdown, and plots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Table:
    """Title, header, rows with as many cells as the header, and an explanatory note."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ''


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure with its file name (no extension), title and explanatory note."""

    name: str
    title: str
    figure: Figure
    note: str


def columns(text: str) -> tuple[str, ...]:
    """Return the header that a text names, with `` | `` between the columns."""
    return tuple(text.split(' | '))


def spread(values: NDArray[np.float64], unit: float = 1.0, digits: int = 3, sign: str = '') -> str:
    """Return the mean and its standard error; values that are not finite are left out."""
    finite = unit * values[np.isfinite(values)]
    if not finite.size:
        return '-'
    if finite.size == 1:
        return f'{finite[0]:{sign}.{digits}f}'
    return f'{finite.mean():{sign}.{digits}f} ± {finite.std(ddof=1) / math.sqrt(finite.size):.{digits}f}'


def as_text(table: Table) -> str:
    """Return a table for a terminal: first column left-aligned, all others right-aligned."""
    lines = [table.title, *_lines((table.header, *table.rows), '  ', '')]
    return '\n'.join([*lines, table.note] if table.note else lines)


def as_markdown(table: Table) -> str:
    """Return a table as Markdown, with aligned source."""
    escaped = (tuple(cell.replace('|', r'\|') for cell in row) for row in (table.header, *table.rows))
    rows = _lines(tuple(escaped), ' | ', '| ')
    lines = [f'### {table.title}', '', rows[0] + ' |', _rule(table), *(row + ' |' for row in rows[1:])]
    return '\n'.join([*lines, '', table.note] if table.note else lines)


def _lines(rows: tuple[tuple[str, ...], ...], between: str, before: str) -> list[str]:
    widths = _widths(rows)
    return [before + between.join(_padded(row, widths)) for row in rows]


def _padded(row: tuple[str, ...], widths: list[int]) -> list[str]:
    first, *others = zip(row, widths, strict=True)
    return [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]


def _rule(table: Table) -> str:
    first, *others = _widths((table.header, *table.rows))
    return '|' + '-' * (first + 2) + '|' + ''.join('-' * (width + 1) + ':|' for width in others)


def _widths(rows: tuple[tuple[str, ...], ...]) -> list[int]:
    return [max(3, *(len(row[i]) for row in rows)) for i in range(len(rows[0]))]
