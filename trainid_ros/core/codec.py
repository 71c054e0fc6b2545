# SPDX-License-Identifier: Apache-2.0
"""Save and restore frozen dataclasses as JSON text, exact to the bit.

States hold only numbers, text, tuples, arrays and other dataclasses. Floats are written so that they read back equal.
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
# Far above any stamp or count; larger integers may overflow on conversion to float.
_MAX_INT: Final = 2**100
_MAX_SHOWN: Final = 60


def encode(state: DataclassInstance) -> str:
    """Return a dataclass as JSON text with its class name."""
    return json.dumps({'type': type(state).__name__, 'state': asdict(state)}, default=np.ndarray.tolist)


def decode(text: str, kind: type[T]) -> T:
    """Restore a dataclass from the text written by :func:`encode`.

    Raises:
        InputError: The text is not JSON, holds another class, or a field is missing or has the wrong type.

    """
    try:
        data = json.loads(text)
        if data['type'] != kind.__name__:
            msg = f'saved state is a {data["type"]}, not a {kind.__name__}'
            raise InputError(msg)
        restored: T = _build(data['state'], kind, kind.__name__)
    # Integers too large for a float overflow; deeply nested lists exhaust the stack.
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        msg = f'saved {kind.__name__} cannot be read: {error}'
        raise InputError(msg) from None
    return restored


def check_restored(valid: bool, kind: str, what: str) -> None:
    """Raise InputError unless the part ``what`` of a restored state is valid."""
    if not valid:
        msg = f'saved {kind}: {what} is not finite, has the wrong size or is out of bounds'
        raise InputError(msg)


def _build(data: Any, kind: Any, name: str) -> Any:
    if is_dataclass(kind):
        if not isinstance(data, dict):
            msg = f'{name} = {_shown(data)} is not a {kind}'
            raise InputError(msg)
        hints = typing.get_type_hints(kind)
        if set(data) != {item.name for item in fields(kind)}:
            msg = f'{name}: fields do not match this version: {sorted(data)}'
            raise InputError(msg)
        return kind(**{key: _build(value, hints[key], f'{name}.{key}') for key, value in data.items()})  # type: ignore[operator]
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _build(data, typing.get_args(kind)[0], name)
    if origin is np.ndarray:
        return np.array(data, dtype=float)
    if origin is tuple:
        if not isinstance(data, list):
            msg = f'{name} = {_shown(data)} is not a list'
            raise InputError(msg)
        first, *rest = typing.get_args(kind)
        if rest != [...] and len(data) != 1 + len(rest):
            msg = f'{name} has {len(data)} entries, not {1 + len(rest)}'
            raise InputError(msg)
        return tuple(_build(item, first, name) for item in data)
    if not isinstance(data, (int, float)) if kind is float else type(data) is not kind:
        msg = f'{name} = {_shown(data)} is not a {kind.__name__}'
        raise InputError(msg)
    if kind is int and abs(data) > _MAX_INT:
        msg = f'{name} is an integer out of range'
        raise InputError(msg)
    return float(data) if kind is float else data


def _shown(data: Any) -> str:
    text = repr(data)
    return text if len(text) <= _MAX_SHOWN else f'{text[:_MAX_SHOWN]}...'
