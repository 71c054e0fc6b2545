# SPDX-License-Identifier: Apache-2.0
"""Strict reader for YAML documents: every error is one line with file, dotted field and value."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf, isfinite
from pathlib import Path
from stat import S_ISREG
from typing import Final, NoReturn

from trainid_ros.interface.errors import InputError

_MAX_SHOWN: Final = 60
"""Maximum length of a value or name in a message [characters]."""
_MAX_FILE_BYTES: Final = 16 << 20
"""Maximum size of a file that is read into memory [bytes]."""


def shown(value: object) -> str:
    """Format a value for an error message: short and on one line."""
    if isinstance(value, float):
        return f'{value:g}'
    return _cut(' '.join(repr(value).split()))


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else f'{text[: _MAX_SHOWN - 3]}...'


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the hint for an unknown word: the closest known one, or all of them."""
    choices = sorted(known)
    if near := difflib.get_close_matches(word, choices, n=1):
        return f'did you mean {near[0]!r}?'
    return f'known: {", ".join(choices)}'


@dataclass(frozen=True, slots=True)
class Section:
    """A mapping in a YAML document, with its file and dotted path for error messages.

    All methods raise InputError for a value that is missing without a default or not of the kind asked for.
    """

    source: str
    path: str
    data: Mapping[str, object]

    def name(self, key: str) -> str:
        """Return the dotted name of a field of this section."""
        key = _cut(key)
        return f'{self.path}.{key}' if self.path else key

    def fail(self, key: str, problem: str) -> NoReturn:
        """Raise InputError naming a field and its problem."""
        raise InputError(f'{self.source}: {self.name(key)} {problem}')

    def only(self, known: Iterable[str]) -> Section:
        """Return this section; raise InputError for an unknown key."""
        allowed = set(known)
        for key in self.data:
            if key not in allowed:
                self.fail(key, f'is not a known field; {did_you_mean(key, allowed)}')
        return self

    def section(self, key: str, *, required: bool = False) -> Section:
        """Return a nested mapping, empty if absent and not required."""
        value = self.data.get(key)
        if value is None and required:
            self.fail(key, 'is missing')
        return as_section(self.source, self.name(key), {} if value is None else value)

    def number(
        self, key: str, unit: str, default: float | None = None, *, low: float = -inf, high: float = inf
    ) -> float:
        """Return a finite number with ``low <= x <= high``."""
        if key not in self.data:
            if default is None:
                self.fail(key, 'is missing')
            return default
        value = finite_number(self.source, self.name(key), self.data[key], unit)
        self.check(key, value, unit, low=low, high=high)
        return value

    def check(
        self, key: str, value: float, unit: str, *, low: float = -inf, above: float = -inf, high: float = inf
    ) -> None:
        """Raise InputError unless ``low <= x <= high`` and ``x > above``."""
        found = f'= {value:g} {unit}'.rstrip()
        if value <= above:
            self.fail(key, f'{found} must be > {above:g}')
        if value < low:
            self.fail(key, f'{found} must be >= {low:g}')
        if value > high:
            self.fail(key, f'{found} must be <= {high:g}')

    def check_rising(self, name: str, values: Iterable[float], unit: str, rule: str = 'above', *, what: str) -> None:
        """Raise InputError unless values increase; ``name`` is that of each, with {} for its place."""
        for place, (before, after) in enumerate(pairwise(values), start=1):
            if after <= before:
                problem = f'= {after:g} {unit} must be {rule} {before:g} {unit}: {what} must increase'
                self.fail(name.format(place), problem)

    def integer(self, key: str, default: int, *, low: int, high: int) -> int:
        """Return an integer from ``low`` to ``high``."""
        value = self.data.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            self.fail(key, f'= {shown(value)} must be a whole number')
        if value < low:
            self.fail(key, f'= {value} must be >= {low}')
        if value > high:
            self.fail(key, f'= {shown(value)} must be <= {high}')
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string."""
        if key not in self.data and default is not None:
            return default
        value = self.data.get(key)
        if not isinstance(value, str):
            self.fail(key, f'= {shown(value)} must be a string' if key in self.data else 'is missing')
        return value

    def choice(self, key: str, known: Sequence[str], default: str | None = None) -> str:
        """Return one of several words."""
        value = self.text(key, default)
        if value not in known:
            self.fail(key, f'= {shown(value)} must be {" or ".join(known)}')
        return value

    def boolean(self, key: str, *, default: bool) -> bool:
        """Return true or false."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, f'= {shown(value)} must be true or false')
        return value

    def items(self, key: str) -> tuple[object, ...]:
        """Return a list, empty if absent."""
        value = self.data.get(key)
        if value is None:
            return ()
        if not isinstance(value, list):
            self.fail(key, f'= {shown(value)} must be a list')
        return tuple(value)

    def numbers(self, key: str, unit: str) -> tuple[float, ...]:
        """Return a list of finite numbers."""
        items = enumerate(self.items(key))
        return tuple(finite_number(self.source, f'{self.name(key)}[{i}]', item, unit) for i, item in items)

    def counts(self, key: str) -> tuple[int, ...]:
        """Return a list of whole numbers from 1 on, empty if absent."""
        if key in self.data and not self.data[key]:
            self.fail(key, f'= {shown(self.data[key])} must have at least one number')
        found = []
        for i, item in enumerate(self.items(key)):
            if isinstance(item, bool) or not isinstance(item, int) or item < 1:
                self.fail(f'{key}[{i}]', f'= {shown(item)} must be a whole number from 1 on')
            found.append(item)
        return tuple(found)

    def named_numbers(self, key: str) -> tuple[tuple[str, float], ...]:
        """Return names and finite numbers of a nested mapping, empty if absent."""
        inner = self.section(key)
        return tuple((name, finite_number(self.source, inner.name(name), x, '')) for name, x in inner.data.items())

    def rows(self, key: str, units: tuple[str, ...]) -> tuple[tuple[float, ...], ...]:
        """Return a list of rows with one finite number for each unit."""
        out = []
        for i, item in enumerate(self.items(key)):
            name = f'{self.name(key)}[{i}]'
            if not isinstance(item, list) or len(item) != len(units):
                raise InputError(f'{self.source}: {name} = {shown(item)} must be [{", ".join(units)}]')
            cells = enumerate(zip(item, units, strict=True))
            out.append(tuple(finite_number(self.source, f'{name}[{j}]', x, unit) for j, (x, unit) in cells))
        return tuple(out)

    def pairs(self, key: str, units: tuple[str, str]) -> tuple[tuple[float, float], ...]:
        """Return a list of rows of two finite numbers."""
        return tuple((x, y) for x, y in self.rows(key, units))


def finite_number(source: str, name: str, value: object, unit: str) -> float:
    """Return a value as a float; raise InputError if it is not a number (as a boolean is not), or not finite."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f'{source}: {name} = {shown(value)} must be a number{f" in {unit}" if unit else ""}')
    try:
        number = float(value)
    except OverflowError:
        number = inf
    if not isfinite(number):
        raise InputError(f'{source}: {name} = {number:g} must be finite')
    return number


def as_section(source: str, path: str, value: object) -> Section:
    """Return a value as a section; raise InputError if it is not a mapping with string keys."""
    where = f'{source}: {path}' if path else source
    if value is None:
        raise InputError(f'{where} is empty, but must be a mapping of fields')
    if not isinstance(value, dict):
        raise InputError(f'{where} = {shown(value)} must be a mapping of fields')
    for key in value:
        if not isinstance(key, str):
            raise InputError(f'{where} has the key {shown(key)}, which is not a field name')
    return Section(source, path, value)


def read_text(path: str | Path) -> str:
    """Return the text of a file; raise InputError if it cannot be read."""
    try:
        file = Path(path)
        if not (S_ISREG(file.stat().st_mode) or file.is_dir()):  # a pipe or a device may have no end
            raise InputError(f'{path}: cannot be read: is not a file')
        with file.open('rb') as opened:
            content = opened.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise InputError(f'{path}: cannot be read: is larger than {_MAX_FILE_BYTES >> 20} MB')
        return content.decode('utf-8')
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror or error}') from error
    except UnicodeDecodeError as error:
        raise InputError(f'{path}: is not UTF-8 text (byte {error.start})') from error


def parse_yaml(text: str, source: str) -> Section:
    """Return the top-level mapping of a YAML text; raise InputError if it is none, or has a key twice."""
    # Imported here so that only code that reads a file loads PyYAML.
    from trainid_ros.train.strict_yaml import load  # noqa: PLC0415

    return as_section(source, '', load(text, source))
