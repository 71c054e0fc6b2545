# SPDX-License-Identifier: Apache-2.0
"""A suggested mapping: what each input may come from, why, and what the reader must decide; and its text."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.bag.number_series import NumberSeries

_PLAIN: Final = re.compile(r'[A-Za-z/][A-Za-z0-9_/.]*')


@dataclass(frozen=True, slots=True)
class Part:
    """One source of a quantity, with what is not usual about it."""

    series: NumberSeries
    unit: str
    sign: float = 1.0
    table: tuple[tuple[float, float], ...] = ()

    def text(self, more: str = '') -> str:
        """Return it as in a mapping file; ``more`` are further keys."""
        words = [f'topic: {_quoted(self.series.topic)}', f'field: {_quoted(self.series.field)}']
        if self.table:
            words.append(f'table: {{{", ".join(f"{raw:g}: {value:g}" for raw, value in self.table)}}}')
        else:
            words.append(f'unit: {_quoted(self.unit)}')
        if self.sign < 0.0:
            words.append('sign: -1')
        if not self.series.has_stamps:
            words.append('stamp: receive')
        return f'{{{", ".join(words)}{more}}}'


@dataclass(slots=True)
class Choice:
    """What is suggested for one quantity."""

    quantity: str  # The quantity
    parts: tuple[Part, ...] = ()  # Its sources, which are summed
    text: str = ''  # What the file says in place of sources, '' with some
    reasons: list[str] = field(default_factory=list)  # What speaks for it
    decisions: list[str] = field(default_factory=list)  # What the reader must decide
    on_change: bool = False  # Whether commands come only when they change

    def lines(self) -> list[str]:
        """Return its lines in the file."""
        heads = [f'{self.quantity}: {described(part.series)}' for part in self.parts]
        said = [*(heads or [f'{self.quantity}: not on a topic']), *(f'  {reason}' for reason in self.reasons)]
        return [
            *(comment(line) for line in said),
            *(comment(f'  decide: {decision}') for decision in self.decisions),
            *self._body(),
        ]

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
        blocks = [[comment(line) for line in self.head], *(choice.lines() for choice in self.choices)]
        blocks.append([comment(line) for line in self.notes])
        if not any(choice.parts or choice.text for choice in self.choices):
            blocks.append(['{}'])
        return '\n\n'.join('\n'.join(block) for block in blocks if block)


def comment(text: str) -> str:
    """Return a text as one comment, whatever characters a name in it has."""
    return f'# {"".join(char if char.isprintable() else repr(char)[1:-1] for char in text)}'


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return names with commas, no more than some of them."""
    more = f' and {len(names) - most} more' if len(names) > most else ''
    return f'{", ".join(names[:most])}{more}'


def described(series: NumberSeries) -> str:
    """Return topic, field, type and rate of a series."""
    rate = '' if math.isnan(series.rate) else f', {series.rate:.3g} Hz'
    return f'{series.topic} {series.field} ({series.type}{rate})'


def _quoted(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else json.dumps(text)
