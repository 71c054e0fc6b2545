# SPDX-License-Identifier: Apache-2.0
"""Save and restore frozen dataclasses as JSON text, to the bit.

States hold numbers, text, tuples, arrays and other dataclasses only. Floats are written so that they read back equal.
"""

from __future__ import annotations

import json
import types
import typing
from dataclasses import asdict, fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from trainid_ros.core.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar('T')
# Beyond all stamps and counts; greater ones overflow when they meet a float.
_MOST_INT: Final = 2**100
_LONGEST: Final = 60


def encode(state: DataclassInstance) -> str:
    """Return a dataclass as JSON text with its class name."""
    return json.dumps({'type': type(state).__name__, 'state': asdict(state)}, default=np.ndarray.tolist)


def decode(text: str, kind: type[T]) -> T:
    """Return the dataclass that :func:`encode` wrote.

    Raises:
        InputError: The text is no JSON, of another class, or a field is missing or of the wrong kind.

    """
    try:
        data = json.loads(text)
        if data['type'] != kind.__name__:
            msg = f'saved state is a {data["type"]}, not a {kind.__name__}'
            raise InputError(msg)
        restored: T = _build(data['state'], kind, kind.__name__)
    # Numbers beyond all floats overflow, lists in lists beyond all measure exhaust the stack.
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        msg = f'saved {kind.__name__} cannot be read: {error}'
        raise InputError(msg) from None
    return restored


def check_restored(fine: bool, kind: str, what: str) -> None:
    """Raise InputError unless a restored part is fine."""
    if not fine:
        msg = f'saved {kind}: {what} is not finite, not of the right size or beyond its bounds'
        raise InputError(msg)


def _build(data: Any, kind: Any, name: str) -> Any:
    if is_dataclass(kind):
        if not isinstance(data, dict):
            msg = f'{name} = {_shown(data)} is no {kind}'
            raise InputError(msg)
        hints = typing.get_type_hints(kind)
        if set(data) != {item.name for item in fields(kind)}:
            msg = f'{name} has other fields than this version: {sorted(data)}'
            raise InputError(msg)
        return kind(**{key: _build(value, hints[key], f'{name}.{key}') for key, value in data.items()})  # type: ignore[operator]
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _build(data, typing.get_args(kind)[0], name)
    if origin is np.ndarray:
        return np.array(data, dtype=float)
    if origin is tuple:
        if not isinstance(data, list):
            msg = f'{name} = {_shown(data)} is no list'
            raise InputError(msg)
        first, *rest = typing.get_args(kind)
        if rest != [...] and len(data) != 1 + len(rest):
            msg = f'{name} has {len(data)} entries, not {1 + len(rest)}'
            raise InputError(msg)
        return tuple(_build(item, first, name) for item in data)
    if not isinstance(data, (int, float)) if kind is float else type(data) is not kind:
        msg = f'{name} = {_shown(data)} is no {kind.__name__}'
        raise InputError(msg)
    if kind is int and abs(data) > _MOST_INT:
        msg = f'{name} is an integer beyond all measure'
        raise InputError(msg)
    return float(data) if kind is float else data


def _shown(data: Any) -> str:
    text = repr(data)
    return text if len(text) <= _LONGEST else f'{text[:_LONGEST]}...'
