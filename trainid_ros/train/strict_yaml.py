# SPDX-License-Identifier: Apache-2.0
"""Strict YAML loader, separate from :mod:`fields` so that only code that reads a file loads PyYAML."""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable
from typing import Any, Final, TypeVar

import yaml

from trainid_ros.interface.errors import InputError

try:
    from yaml import CSafeLoader as SafeLoader  # five times as fast
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]

ResultT = TypeVar('ResultT')

_MAX_VALUES: Final = 100_000
"""Maximum number of values in a file, those of an alias counted again; about 2 s and 100 MB."""
_MAX_DEPTH: Final = 100
"""Maximum depth of nested collections: the reader is recursive."""
_NUMBERS: Final = {
    'int': re.compile(r'[-+]?(0|[1-9][0-9_]{0,300})$'),
    # Within a length: the time to find that something is no number grows with the square of its length.
    'float': re.compile(
        r'(?=.{1,300}$)(?:'
        r'[-+]?([0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)[eE][-+]?[0-9]+$'
        r'|[-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)$'
        r'|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$)'
    ),
}


class StrictLoader(SafeLoader):
    """Safe loader that reads numbers as in YAML 1.2 and rejects duplicate keys.

    In YAML 1.1, 1:30 is 90, 0777 is 511, and 1e5 is a string. Here the first two are strings, so that a field that must
    be a number rejects them.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        """Build a mapping; PyYAML by itself would keep the last of two equal keys without an error."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                problem = f'key {key.value!r} is given twice'
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag.rpartition(':')[2] not in _NUMBERS]
    for first, resolvers in SafeLoader.yaml_implicit_resolvers.items()
}
for _name, _pattern in _NUMBERS.items():
    StrictLoader.add_implicit_resolver(f'tag:yaml.org,2002:{_name}', _pattern, list('-+.0123456789'))


def load(text: str, source: str) -> object:
    """Return the content of a YAML text; ``source`` is the file named in errors.

    InputError if the text is not YAML, a key is given twice, or the values are too many or too deeply nested.
    """
    return _checked(text, source, lambda: StrictLoader(text).get_single_data())


def compose(text: str, source: str) -> yaml.Node | None:
    """Return the nodes of a YAML text, None if it is empty; the rest as in :func:`load`."""
    return _checked(text, source, lambda: yaml.compose(text, Loader=StrictLoader))


def _checked(text: str, source: str, read: Callable[[], ResultT]) -> ResultT:
    try:
        _check_size(text)
        return read()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f' line {mark.line + 1}, column {mark.column + 1}' if mark is not None else ''
        raise InputError(f'{source}:{where} is not valid YAML: {_one_line(error.problem)}') from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f'{source}: is not valid YAML: {_one_line(error)}') from error


def _check_size(text: str) -> None:
    """Raise a YAMLError if the values of a text are too many or too deeply nested, before they are built."""
    sizes: dict[str, int] = {}
    open_collections: list[tuple[str | None, int]] = []
    count = 0
    for event in yaml.parse(text, Loader=StrictLoader):
        anchor = getattr(event, 'anchor', None)
        if isinstance(event, yaml.AliasEvent):
            if anchor not in sizes:
                raise _error(event, f'alias {anchor!r} is not defined before')
            count += sizes[anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            open_collections.append((anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_collections.pop()
            sizes[anchor or ''] = count - before
        elif isinstance(event, yaml.ScalarEvent):
            sizes[anchor or ''] = 1
            count += 1
        if count > _MAX_VALUES:
            raise _error(event, f'more than {_MAX_VALUES} values')
        if len(open_collections) > _MAX_DEPTH:
            raise _error(event, f'nested more than {_MAX_DEPTH} deep')


def _error(event: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


def _one_line(problem: object) -> str:
    return ' '.join(str(problem).split())
