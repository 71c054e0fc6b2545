# SPDX-License-Identifier: Apache-2.0
"""Strict YAML loader, separate from :mod:`fields` so that only code that reads a file loads PyYAML."""

from __future__ import annotations

import re
from collections.abc import Hashable

import yaml

from trainid_ros.errors import InputError

try:
    from yaml import CSafeLoader as SafeLoader  # five times as fast
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]


class StrictLoader(SafeLoader):
    """Safe loader that reads 1e5 as a number and rejects duplicate keys."""

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


# YAML 1.1 reads 1e5 as a string, but a number is meant.
StrictLoader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'), list('-+.0123456789')
)


def load(text: str, source: str) -> object:
    """Return the content of a YAML text; ``source`` is the file named in errors.

    Raises:
        InputError: The text is not YAML, or a key is given twice.

    """
    try:
        value: object = StrictLoader(text).get_single_data()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f' line {mark.line + 1}, column {mark.column + 1}' if mark is not None else ''
        msg = f'{source}:{where} is not valid YAML: {_one_line(error.problem)}'
        raise InputError(msg) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        msg = f'{source}: is not valid YAML: {_one_line(error)}'
        raise InputError(msg) from error
    return value


def _one_line(problem: object) -> str:
    return ' '.join(str(problem).split())
