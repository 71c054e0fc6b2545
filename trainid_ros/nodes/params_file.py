# SPDX-License-Identifier: Apache-2.0
"""Parameter files whose sections miss the node: ROS ignores those in silence."""

from __future__ import annotations

import difflib
import re
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

import yaml

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_CLOSE: Final = 0.75


def params_files(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the parameter files that ROS arguments name."""
    return tuple(Path(value) for option, value in pairwise(arguments) if option == '--params-file')


def find_misses(path: Path, node: str, usual_name: str) -> tuple[str, bool] | None:
    """Return a complaint, and whether it is certain, if no section of a file is meant for a node.

    Args:
        path: Parameter file; one that cannot be read is left to ROS, which refuses it.
        node: Fully qualified name of the node.
        usual_name: Its name before remapping.

    Returns:
        None if a section matches. A complaint is certain if a section is named almost like the node
        or as the node is usually named.

    """
    try:
        sections = list(_sections(yaml.safe_load(path.read_text(encoding='utf-8')), ''))
    except (OSError, ValueError, yaml.YAMLError):
        return None
    if not sections or any(_pattern(section).fullmatch(node) for section in sections):
        return None
    names = {section: section.rsplit('/', 1)[-1] for section in sections}
    near = difflib.get_close_matches(node.rsplit('/', 1)[-1], list(names.values()), n=1, cutoff=_CLOSE)
    likely = [section for section, name in names.items() if name == usual_name or name in near]
    if likely:
        return f'{path}: section {likely[0]!r} does not apply to this node, did you mean {node!r}?', True
    return f'{path}: no section for {node!r}; it has {", ".join(sections)}', False


def _sections(tree: object, prefix: str) -> Iterator[str]:
    if not isinstance(tree, dict):
        return
    for key, value in tree.items():
        name = f'{prefix}/{str(key).strip("/")}'
        if isinstance(value, dict) and 'ros__parameters' in value:
            yield name
        else:
            yield from _sections(value, name)


def _pattern(section: str) -> re.Pattern[str]:
    wild = {'*': r'/[^/]+', '**': r'(?:/[^/]+)*'}
    return re.compile(''.join(wild.get(token, f'/{re.escape(token)}') for token in section.strip('/').split('/')))
