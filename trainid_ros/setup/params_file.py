# SPDX-License-Identifier: Apache-2.0
"""Parameter files: read the values of a node without ROS, and find sections that do not match, which ROS ignores."""

from __future__ import annotations

import difflib
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

import yaml

from trainid_ros.interface.errors import InputError
from trainid_ros.train.fields import read_text
from trainid_ros.train.strict_yaml import compose, load

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_CLOSE: Final = 0.75
_MOST_NAMED: Final = 10
# Types as the parser of ROS assigns them; PyYAML has other rules and reads 1e-05 as a string.
_BOOLS: Final = {
    word: value
    for value, words in ((True, ('y', 'yes', 'true', 'on')), (False, ('n', 'no', 'false', 'off')))
    for plain in words
    for word in (plain, plain.capitalize(), plain.upper())
}
_INTEGER: Final = re.compile(r'[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)')
_REAL: Final = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')
_NOT_FINITE: Final = re.compile(r'[-+]?\.?(nan|inf|infinity)', re.IGNORECASE)
_INT64: Final = 2**63


def params_files(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the parameter files named in ROS arguments."""
    return tuple(Path(value) for option, value in pairwise(arguments) if option == '--params-file')


def find_mismatch(path: Path, node: str, usual_name: str) -> tuple[str, bool] | None:
    """Return a message, and whether it is certainly an error, if no section of a file matches a node.

    Args:
        path: Parameter file; one that cannot be read is left to ROS, which reports it.
        node: Fully qualified name of the node.
        usual_name: Its name before remapping.

    Returns:
        None if a section matches. It is certainly an error if a section has almost the name of the node
        or the usual name of the node.
    """
    try:
        sections = list(_sections(load(read_text(path), str(path)), ''))
    except InputError:
        return None
    if not sections or any(_pattern(section).fullmatch(node) for section in sections):
        return None
    names = {section: section.rsplit('/', 1)[-1] for section in sections}
    near = difflib.get_close_matches(node.rsplit('/', 1)[-1], list(names.values()), n=1, cutoff=_CLOSE)
    likely = [section for section, name in names.items() if name == usual_name or name in near]
    if likely:
        return f'{path}: section {likely[0]!r} does not apply to this node, did you mean {node!r}?', True
    more = f' and {len(sections) - _MOST_NAMED} more' if len(sections) > _MOST_NAMED else ''
    return f'{path}: no section for {node!r}; its sections are {", ".join(sections[:_MOST_NAMED])}{more}', False


def _sections(tree: object, prefix: str) -> Iterator[str]:
    if not isinstance(tree, dict):
        return
    for key, value in tree.items():
        name = f'{prefix}/{str(key).strip("/")}'
        if isinstance(value, dict) and 'ros__parameters' in value:
            yield name
        else:
            yield from _sections(value, name)


def read_overrides(path: Path, node: str) -> dict[str, object]:
    """Return the values that a file gives to a node, as in ROS: of several matching sections, the last one wins.

    Args:
        path: Parameter file.
        node: Fully qualified name of the node.

    Raises:
        InputError: The file cannot be read or is not a parameter file.
    """
    tree = compose(read_text(path), str(path))
    found: dict[str, object] = {}
    if tree is not None:
        for section, values in _given(path, tree, ''):
            if _pattern(section).fullmatch(node):
                found |= _flat(path, values, '')
    return found


def _given(path: Path, tree: yaml.Node, prefix: str) -> Iterator[tuple[str, yaml.Node]]:
    if not isinstance(tree, yaml.MappingNode):
        raise InputError(f'{path}: is not a parameter file: {prefix or "it"} has no section with ros__parameters')
    for key, value in tree.value:
        name = _name(path, key, prefix)
        if name != 'ros__parameters':
            yield from _given(path, value, f'{prefix}/{name.strip("/")}'.replace('//', '/'))
        elif isinstance(value, yaml.MappingNode):
            yield prefix, value
        else:
            raise InputError(f'{path}: ros__parameters of {prefix or "the file"} must map names to values')


def _name(path: Path, key: yaml.Node, prefix: str) -> str:
    if isinstance(key, yaml.ScalarNode):
        return str(key.value)
    raise InputError(
        f'{path}: is not a parameter file: a key of {prefix or "it"} is not a name (line {key.start_mark.line + 1})'
    )


def _flat(path: Path, node: yaml.Node, prefix: str) -> dict[str, object]:
    if not isinstance(node, yaml.MappingNode):
        return {prefix: _value(node)}
    found: dict[str, object] = {}
    for key, value in node.value:
        name = _name(path, key, prefix)
        found |= _flat(path, value, f'{prefix}.{name}' if prefix else name)
    return found


def _value(node: yaml.Node) -> object:
    if isinstance(node, yaml.SequenceNode):
        return [_value(item) for item in node.value]
    text = str(node.value)
    return text if getattr(node, 'style', None) in ("'", '"') else _plain(text)


def _plain(text: str) -> object:
    """Return an unquoted scalar as the parser of ROS reads it."""
    if text in _BOOLS:
        return _BOOLS[text]
    if _INTEGER.fullmatch(text):
        digits = text.lstrip('+-')
        base = 16 if digits[:2].lower() == '0x' else 8 if digits[0] == '0' else 10
        number = int(text, base)
        if -_INT64 <= number < _INT64:
            return number
    if _NOT_FINITE.fullmatch(text):
        return float(text.replace('.', ''))
    if _REAL.fullmatch(text) and math.isfinite(real := float(text)):
        return real
    return text


def _pattern(section: str) -> re.Pattern[str]:
    wild = {'*': r'/[^/]+', '**': r'(?:/[^/]+)*'}
    return re.compile(''.join(wild.get(token, f'/{re.escape(token)}') for token in section.strip('/').split('/')))
