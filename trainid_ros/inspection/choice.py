# SPDX-License-Identifier: Apache-2.0
"""A suggested mapping: its sources, units, reasons and what is left to decide, written as a mapping file."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field

from trainid_ros.inspection.number_series import NumberSeries
from trainid_ros.interface.text import printable


@dataclass(frozen=True, slots=True)
class Part:
    """One source of a quantity, with its unit, sign and table."""

    series: NumberSeries
    unit: str
    sign: float = 1.0
    table: tuple[tuple[float, float], ...] = ()

    def text(self, more: str = '') -> str:
        """Return it as in a mapping file; ``more`` are further keys."""
        words = [f'topic: {quoted(self.series.topic)}'] if self.series.topic else []
        words.append(f'field: {quoted(self.series.field)}')
        if self.table:
            words.append(f'table: {{{", ".join(f"{raw:g}: {value:g}" for raw, value in self.table)}}}')
        else:
            words.append(f'unit: {quoted(self.unit)}')
        if self.sign < 0.0:
            words.append('sign: -1')
        if not self.series.has_stamps:
            words.append('stamp: receive')
        return f'{{{", ".join(words)}{more}}}'


@dataclass(slots=True)
class Choice:
    """The suggestion for one quantity."""

    quantity: str  # The quantity
    parts: tuple[Part, ...] = ()  # Its sources, which are summed
    text: str = ''  # What the file says in place of sources, '' with some
    reasons: list[str] = field(default_factory=list)  # What speaks for it
    decisions: list[str] = field(default_factory=list)  # What the reader must decide
    on_change: bool = False  # Whether commands come only when they change
    head: str = ''  # What it is in place of sources

    def lines(self) -> list[str]:
        """Return its lines in the file."""
        heads = [f'{self.quantity}: {described(part.series)}' for part in self.parts]
        said = heads or [self.head or f'{self.quantity}: not on a topic']
        said += [f'  {reason}' for reason in self.reasons]
        said += [f'  decide: {decision}' for decision in self.decisions]
        return [*map(comment, said), *self._body()]

    def _body(self) -> list[str]:
        more = ', on_change: true' if self.on_change else ''
        if not self.parts:
            return [f'{self.quantity}: {self.text}'] if self.text else []
        if len(self.parts) == 1:
            return [f'{self.quantity}: {self.parts[0].text(more)}']
        return [f'{self.quantity}:', '  sum:', *(f'    - {part.text()}' for part in self.parts)]


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested mapping."""

    head: tuple[str, ...]  # What was read
    choices: tuple[Choice, ...]  # What is suggested for each quantity
    missing: tuple[str, ...]  # Required quantities for which nothing was found
    notes: tuple[str, ...]  # What else there is to know

    def text(self) -> str:
        """Return the mapping file, with reasons as comments."""
        blocks = [[*map(comment, self.head)], *(choice.lines() for choice in self.choices), [*map(comment, self.notes)]]
        if not any(choice.parts or choice.text for choice in self.choices):
            blocks.append(['{}'])
        return '\n\n'.join('\n'.join(block) for block in blocks if block)


def comment(text: str) -> str:
    """Return a text as one comment, whatever characters a name in it has."""
    return '# ' + printable(text).replace('\n', r'\n')


def described(series: NumberSeries) -> str:
    """Return topic, field, type and rate of a series."""
    rate = '' if math.isnan(series.rate) else f'{series.rate:.3g} Hz'
    return f'{series.name} ({", ".join(filter(None, (series.type, rate)))})'


def quoted(text: str) -> str:
    """Return a text as in YAML."""
    is_word = re.fullmatch(r'[A-Za-z/][A-Za-z0-9_/.]*', text) and text.lower() not in {'yes', 'no', 'on', 'off'}
    return text if is_word else json.dumps(text, ensure_ascii=False)
