# SPDX-License-Identifier: Apache-2.0
"""States of estimators: saved and restored as JSON text, exact to the bit, and validated.

States are frozen dataclasses of numbers, text, tuples, arrays and other dataclasses. Floats are written so that they
read back equal; arrays are written as their bytes, which takes a tenth of the time. A file that can be read may still
hold invalid values, so numbers are checked after reading.
"""

from __future__ import annotations

import base64
import json
import math
import types
import typing
from dataclasses import field, fields, is_dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from _typeshed import DataclassInstance
    from numpy.typing import NDArray

T = TypeVar('T')
# Far above any stamp or count; larger integers may overflow on conversion to float.
_MAX_INT: Final = 2**100
_MAX_SHOWN: Final = 60
# Numbers of arrays as bytes: eight of each, little-endian, on every machine.
_BYTES: Final = '<f8'


_ITEMS: Final = 'items'


def several(kind: type[object]) -> Any:
    """Declare a field that is a tuple of dataclasses, empty by default; compiled classes keep no type of its items."""
    return field(default=(), metadata={_ITEMS: kind})


def encode(state: DataclassInstance) -> str:
    """Return a dataclass as JSON text with its class name."""
    return json.dumps({'type': type(state).__name__, 'state': state}, default=_as_json)


def _as_json(value: Any) -> Any:
    """Return an array as its shape and bytes and a dataclass as a dictionary, without copying what is in it."""
    if isinstance(value, np.ndarray):
        return packed(value)
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def packed(array: NDArray[np.float64]) -> dict[str, Any]:
    """Return an array as it is written to JSON: its shape, and its numbers row by row as bytes in base64."""
    numbers = np.asarray(array, dtype=_BYTES)
    return {'shape': list(numbers.shape), 'float64': base64.b64encode(numbers.tobytes()).decode('ascii')}


def unpacked(data: dict[str, Any]) -> NDArray[np.float64]:
    """Return an array that :func:`packed` has written; ValueError or KeyError if it is anything else."""
    numbers = np.frombuffer(base64.b64decode(data['float64'], validate=True), dtype=_BYTES)
    return numbers.astype(np.float64).reshape(data['shape'])


def decode(text: str, kind: type[T]) -> T:
    """Restore a dataclass from the text written by :func:`encode`.

    Raises:
        InputError: The text is not JSON, holds another class, or a field is missing or has the wrong type.
    """
    try:
        data = json.loads(text)
        if data['type'] != kind.__name__:
            raise InputError(f'saved state is a {data["type"]}, not a {kind.__name__}')
        restored: T = _build(data['state'], kind, kind.__name__)
    # Integers too large for a float overflow; deeply nested lists exhaust the stack.
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f'saved {kind.__name__} cannot be read: {error}') from None
    return restored


def check_restored(valid: bool, kind: str, what: str) -> None:
    """Raise InputError unless the part ``what`` of a restored state is valid."""
    if not valid:
        raise InputError(f'saved {kind}: {what} is not finite, has the wrong size or is out of bounds')


def _build(data: Any, kind: Any, name: str) -> Any:
    if is_dataclass(kind):
        return _build_dataclass(data, kind, name)
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else _build(data, typing.get_args(kind)[0], name)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(data)
    if np.ndarray in (origin, kind):
        return _build_array(data, name)
    if tuple in (origin, kind):
        # Compiled classes do not keep the types of the items; those of a bare tuple are numbers.
        return _build_tuple(data, typing.get_args(kind) or (float, ...), name)
    if not isinstance(data, (int, float)) if kind is float else type(data) is not kind:
        raise InputError(f'{name} = {_shown(data)} is not a {kind.__name__}')
    if kind is int and abs(data) > _MAX_INT:
        raise InputError(f'{name} is an integer out of range')
    return float(data) if kind is float else data


def _build_array(data: Any, name: str) -> NDArray[np.float64]:
    try:
        return unpacked(data)
    except (ValueError, KeyError, TypeError):
        raise InputError(f'{name} = {_shown(data)} is not an array with its shape and its bytes') from None


def _build_dataclass(data: Any, kind: Any, name: str) -> Any:
    if not isinstance(data, dict):
        raise InputError(f'{name} = {_shown(data)} is not a {kind}')
    hints = typing.get_type_hints(kind)
    for item in fields(kind):
        if _ITEMS in item.metadata:
            hints[item.name] = types.GenericAlias(tuple, (item.metadata[_ITEMS], ...))
    if set(data) != {item.name for item in fields(kind)}:
        raise InputError(f'{name}: fields do not match this version: {sorted(data)}')
    return kind(**{key: _build(value, hints[key], f'{name}.{key}') for key, value in data.items()})


def _build_tuple(data: Any, kinds: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise InputError(f'{name} = {_shown(data)} is not a list')
    first, *rest = kinds
    if rest != [...] and len(data) != len(kinds):
        raise InputError(f'{name} has {len(data)} entries, not {len(kinds)}')
    return tuple(_build(item, first, name) for item in data)


def _shown(data: Any) -> str:
    text = repr(data)
    return text if len(text) <= _MAX_SHOWN else f'{text[:_MAX_SHOWN]}...'


MAX_NUMBER: Final = 1e40
"""Upper bound of all numbers in a state: no quantity of a train, nor the inverse of a variance, comes near it."""
# Rounding errors make a correlation exceed one by less than this.
_ROUNDING: Final = 1e-6
# Variances below the square of this count as zero.
_UNDERFLOW: Final = 1e-140


def check_numbers(state: DataclassInstance, *, may_be_nan: Collection[str] = ()) -> None:
    """Check all numbers of a state, including those in its arrays, tuples and nested dataclasses.

    Args:
        state: The state.
        may_be_nan: Names of fields that are NaN while unknown.

    Raises:
        InputError: A number is not finite or too large; the message names its field.
    """
    for name, values in _numbers(state, ''):
        unknown = np.isnan(values) if name.rpartition('.')[2] in may_be_nan else False
        if not bool(np.all((np.abs(values) < MAX_NUMBER) | unknown)):
            raise InputError(f'saved {type(state).__name__}: {name} is not finite or too large')


def _numbers(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if is_dataclass(value):
        for item in fields(value):
            yield from _numbers(getattr(value, item.name), f'{name}.{item.name}' if name else item.name)
    elif isinstance(value, tuple):
        for item in value:
            yield from _numbers(item, name)
    elif isinstance(value, np.ndarray | int | float):
        yield name, value


def check_not_negative(kind: str, **numbers: float) -> None:
    """Raise InputError, naming the first invalid number of a saved ``kind`` of state, unless all are >= 0."""
    for name, value in numbers.items():
        if not value >= 0.0:
            raise InputError(f'saved {kind}: {name} = {value:g} must be >= 0')


def is_covariance(upper: Sequence[float]) -> bool:
    """Return True if the upper triangle of a matrix, row by row, is that of a covariance: positive semidefinite.

    Args:
        upper: n (n + 1) / 2 finite numbers.
    """
    n = (math.isqrt(8 * len(upper) + 1) - 1) // 2
    P = np.zeros((n, n))
    P[np.triu_indices(n)] = upper
    return is_covariance_matrix(P + np.triu(P, 1).T)


def is_covariance_matrix(P: NDArray[np.float64]) -> bool:
    """Return True if a matrix of finite numbers, shape (n, n), is a covariance: symmetric, positive semidefinite."""
    variances = np.diag(P)
    # Zero variance implies zero covariance; but a decaying variance underflows before its covariances, which decay
    # half as fast.
    is_zero = variances < _UNDERFLOW**2
    if bool((variances < 0.0).any() or (np.abs(P[is_zero]) > _UNDERFLOW).any()):
        return False
    # Variances differ by decades, so the correlation matrix is checked.
    scale = 1.0 / np.sqrt(np.where(is_zero, 1.0, variances))
    correlations = scale[:, None] * P * scale
    symmetric = bool((np.abs(correlations - correlations.T) < _ROUNDING).all())
    return symmetric and float(np.linalg.eigvalsh(correlations)[0]) >= -_ROUNDING
