# SPDX-License-Identifier: Apache-2.0
"""The state of an object is what its class declares: one codec saves it as JSON text and restores it, to the bit.

A class declares its state in a class attribute::

    STATE: ClassVar[State] = declare('count', definite('P'), several('ticks', AdmittedSample))

Such an object is restored in place, so that what refers to it still does; its present values state the type, and the
size of vectors and arrays. The state of another dataclass is all its fields; it is made anew. A part with ``save`` and
``restore`` of its own is saved as its text. Vectors and arrays are written as their bytes, which takes a tenth of the
time. Every number must be finite unless its field says otherwise. A state that does not fit changes nothing.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import typing
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from enum import Enum
from functools import cache, partial
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from trainid_ros.compiled import uses_sources
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.vectors import vec

T = TypeVar('T')
# Far above any stamp [ns] or count; compiled modules keep some of them in 64 bits.
_MAX_INT: Final = 2**62
# Numbers of arrays as bytes: eight of each, little-endian, on every machine.
_BYTES: Final = '<f8'
_DECLARED: Final = 'STATE'
# Vectors are lists where the modules are not compiled.
_VECTOR: Final[Any] = list if uses_sources() else vec[float]
_COLLECTIONS: Final = (list, tuple, set, deque)


@dataclass(frozen=True, slots=True)
class Field:
    """A part of a state."""

    name: str = ''  # Name of the attribute
    # Kind of the items of a collection, the keys of a counter, or an optional part: a dataclass, an
    # enumeration, or a function that makes an item to be restored in place
    kind: Callable[..., Any] | None = None
    may_be_nan: bool = False  # Whether its numbers are not finite while unknown
    is_covariance: bool = False  # Whether it is a covariance: a matrix row by row, or its upper triangle


State: TypeAlias = tuple[Field, ...]


def declare(*names: str | Field) -> State:
    """Return the state of a class, by the names of its attributes where nothing else is to be said of them."""
    return tuple(Field(name) if isinstance(name, str) else name for name in names)


several: Final = Field
"""Declares a collection or an optional part, by name and kind."""
unknown: Final = partial(Field, may_be_nan=True)
"""Declares numbers that are not finite while unknown."""
definite: Final = partial(Field, is_covariance=True)
"""Declares a covariance."""


def stored(default: Any = MISSING, *, kind: Callable[..., Any] | None = None, may_be_nan: bool = False) -> Any:
    """Declare a dataclass field with its kind and range: compiled classes keep no type of items."""
    return field(default=default, metadata={_DECLARED: Field(kind=kind, may_be_nan=may_be_nan)})


@cache
def _state_of(kind: Any) -> State | None:
    """Return what a class declares, None if nothing."""
    found: State | None = getattr(kind, _DECLARED, None)
    if found is None and is_dataclass(kind):
        return tuple(_field_of(item) for item in fields(kind))
    return found


def _declared(value: object) -> State | None:
    kind: Any = type(value)
    return _state_of(kind)


def _field_of(item: dataclasses.Field[Any]) -> Field:
    """Return the declaration of a dataclass field; one that begins as NaN or infinite may stay so."""
    stated: Field = item.metadata.get(_DECLARED, Field())
    begins_unknown = isinstance(item.default, float) and not math.isfinite(item.default)
    return replace(stated, name=item.name, may_be_nan=stated.may_be_nan or begins_unknown)


# Save


def encode(state: object) -> str:
    """Return the state of an object as JSON text with the name of its class."""
    return json.dumps({'type': type(state).__name__, 'state': _parts(state)}, default=_as_json)


def _parts(value: Any) -> dict[str, Any]:
    return {item.name: _shortened(getattr(value, item.name)) for item in _declared(value) or ()}


def _as_json(value: Any) -> Any:
    if hasattr(value, 'save'):
        return value.save()
    if _declared(value) is not None:
        return _parts(value)
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, set):
        return sorted(value)
    if isinstance(value, deque):
        return list(value)
    return packed(value) if isinstance(value, np.ndarray) or len(value) else []


def _shortened(value: Any) -> Any:
    """Return lists of floats as vectors are written, which they are where the modules are not compiled."""
    if type(value) is not list or not value:
        return value
    if type(value[0]) is list:
        return [_shortened(item) for item in value]
    return packed(value) if all(type(x) is float for x in value) else value


def packed(numbers: Any) -> dict[str, Any]:
    """Return an array or a vector as it is written: its shape, and its numbers row by row as bytes in base64."""
    array = np.asarray(numbers, dtype=_BYTES)
    return {'shape': list(array.shape), 'float64': base64.b64encode(array.tobytes()).decode('ascii')}


def unpacked(data: Any) -> NDArray[np.float64]:
    """Return an array that :func:`packed` has written; ValueError, KeyError or TypeError if it is anything else."""
    numbers = np.frombuffer(base64.b64decode(data['float64'], validate=True), dtype=_BYTES)
    return numbers.astype(np.float64).reshape(data['shape'])


# Restore


def restore(state: object, text: str) -> None:
    """Restore an object whose class declares its state, from the text that :func:`encode` has made of another.

    InputError, naming the field, if the text does not fit; the object is then unchanged.
    """
    restoring = _Restoring()
    restoring.read(text, type(state).__name__, partial(restoring.fill, state))


def decode(text: str, kind: type[T]) -> T:
    """Return the dataclass in a text of :func:`encode`; InputError, naming the field, if it does not fit."""
    restoring = _Restoring()
    restored: T = restoring.read(text, kind.__name__, partial(restoring.make, kind))
    return restored


class _Restoring:
    """Reads a state. What it changes in objects that are restored in place is changed when all of it has been read."""

    def __init__(self) -> None:
        self._texts: list[Callable[[], object]] = []  # these may fail, and come before the other changes
        self._changes: list[Callable[[], object]] = []

    def read(self, text: str, kind: str, build: Callable[[Any, str], Any]) -> Any:
        try:
            data = json.loads(text)
            if data['type'] != kind:
                raise _unfit(kind, f'is a {data["type"]}')
            built = build(data['state'], kind)
        # Integers too large for a float overflow; deeply nested lists exhaust the stack.
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise _unfit(kind, f'cannot be read: {error}') from None
        for change in (*self._texts, *self._changes):
            change()
        return built

    def fill(self, owner: Any, data: Any, name: str) -> None:
        """Read the state of an object that is restored in place."""
        for item in _checked(type(owner), data, name):
            like = getattr(owner, item.name)
            value = self._value(item, type(like), like, data[item.name], f'{name}.{item.name}')
            if value is not like:
                self._changes.append(partial(setattr, owner, item.name, value))

    def make(self, kind: Any, data: Any, name: str) -> Any:
        """Return a new dataclass, whose fields have the types of their annotations."""
        values = {}
        for item in _checked(kind, data, name):
            hint = _hints(kind)[item.name]
            of = typing.get_origin(hint) or hint
            like = () if of is tuple else None
            values[item.name] = self._value(item, of, like, data[item.name], f'{name}.{item.name}')
        return kind(**values)

    def _value(self, item: Field, kind: Any, like: Any, data: Any, name: str) -> Any:
        """Return what takes the place of a value: a new one of a type, or the same if it is restored in place."""
        if item.kind is not None:
            return self._several(item, like, data, name)
        if self._is_restored_in_place(like, data, name):
            return like
        if kind is np.ndarray:
            return _array(item, None if like is None else like.shape, data, name)
        if isinstance(like, _VECTOR):
            return _vector(item, like, data, name)
        if isinstance(like, _COLLECTIONS):
            return _collected(like, _plain_items(item, data, name))
        return self.make(kind, data, name) if is_dataclass(kind) else _scalar(item, kind, data, name)

    def _is_restored_in_place(self, like: Any, data: Any, name: str) -> bool:
        if hasattr(like, 'restore'):
            _check_is(data, str, name)
            self._texts.append(partial(like.restore, data))
        elif hasattr(like, _DECLARED):
            self.fill(like, data, name)
        elif isinstance(like, np.random.Generator):
            _check_generator_state(like, data, name)
            self._changes.append(partial(setattr, like.bit_generator, 'state', data))
        else:
            return False
        return True

    def _several(self, item: Field, like: Any, data: Any, name: str) -> Any:
        if isinstance(like, _COLLECTIONS):
            _check_is(data, list, name)
            return _collected(like, [self._one(item, part, f'{name}[{k}]') for k, part in enumerate(data)])
        if isinstance(like, Counter):
            _check_is(data, dict, name)
            count = Field()
            return Counter({self._one(item, int(key), name): _scalar(count, int, data[key], name) for key in data})
        return None if data is None else self._one(item, data, name)

    def _one(self, item: Field, data: Any, name: str) -> Any:
        kind: Any = item.kind
        is_enum = isinstance(kind, type) and issubclass(kind, Enum)
        is_new = is_enum or (is_dataclass(kind) and not hasattr(kind, _DECLARED))
        like = None if is_new else kind()
        return self._value(replace(item, kind=None), kind if is_new else type(like), like, data, name)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _collected(like: Any, items: Any) -> Any:
    return deque(items, like.maxlen) if isinstance(like, deque) else type(like)(items)


def _plain_items(item: Field, data: Any, name: str) -> Any:
    """Return a list of plain values; inner lists become tuples."""
    if isinstance(data, dict):
        return _array(item, None, data, name).tolist()
    _check_is(data, list, name)
    if any(isinstance(part, dict) for part in data):
        raise _unfit(name, 'holds objects that are not declared')
    return tuple(
        _plain_items(item, part, name) if isinstance(part, list) else _scalar(item, type(part), part, name)
        for part in data
    )


def _vector(item: Field, like: Any, data: Any, name: str) -> Any:
    """Return a vector, or a list in its place; one that is not empty keeps its size."""
    if isinstance(data, list):  # an empty one, or a list of something else where modules are not compiled
        items = _plain_items(item, data, name)
        if not (isinstance(like, list) or all(isinstance(x, int | float) for x in items)):
            raise _unfit(name, 'holds something else than numbers')
        return list(items) if isinstance(like, list) else vec[float](items)
    numbers = _array(item, None, data, name)
    is_sized = bool(like) and type(like[0]) is float
    if numbers.ndim != 1 or (is_sized and numbers.size != len(like)):
        raise _unfit(name, f'has the shape {numbers.shape}, not ({len(like)},)')
    return vec[float](numbers.tolist())


def _array(item: Field, shape: tuple[int, ...] | None, data: Any, name: str) -> NDArray[np.float64]:
    try:
        numbers = unpacked(data)
    except (ValueError, KeyError, TypeError):
        raise _unfit(name, f'= {_shown(data)} is not an array with its shape and its bytes') from None
    if shape is not None and numbers.shape != shape:
        raise _unfit(name, f'has the shape {numbers.shape}, not {shape}')
    if not (item.may_be_nan or bool(np.isfinite(numbers).all())):
        raise _unfit(name, 'is not finite')
    if item.is_covariance and not is_covariance(numbers):
        raise _unfit(name, 'is not a covariance')
    return numbers


def _scalar(item: Field, kind: Any, data: Any, name: str) -> Any:
    """Return a number, a text, None or the member of an enumeration."""
    if isinstance(kind, type) and issubclass(kind, Enum):
        try:
            return kind(data)
        except ValueError:
            raise _unfit(name, f'= {_shown(data)} is no {kind.__name__}') from None
    _check_is(data, kind, name)
    if isinstance(data, int) and abs(data) > _MAX_INT:
        raise _unfit(name, 'is an integer out of range')
    value = float(data) if kind is float else data
    if isinstance(value, float) and not (item.may_be_nan or math.isfinite(value)):
        raise _unfit(name, f'= {value} is not finite')
    return value


def _check_generator_state(like: np.random.Generator, data: Any, name: str) -> None:
    """Try the state of a random generator on another one."""
    try:
        type(like.bit_generator)().state = data
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _unfit(name, f'is not a state of a random generator: {error}') from None


def _checked(kind: Any, data: Any, name: str) -> State:
    """Return what a class declares, if these are data of all of it."""
    state = _state_of(kind) or ()
    _check_is(data, dict, name)
    if set(data) != {item.name for item in state}:
        raise _unfit(name, f'has other fields than in this version: {sorted(data)}')
    return state


def _check_is(data: Any, kind: Any, name: str) -> None:
    if not isinstance(data, int | float) if kind is float else type(data) is not kind:
        raise _unfit(name, f'= {_shown(data)} must be of type {kind.__name__}')


def _shown(data: Any) -> str:
    text = repr(data)
    return text if len(text) <= 60 else f'{text[:60]}...'


def _unfit(name: str, reason: str) -> InputError:
    return InputError(f'saved {name} {reason}')


# Rounding errors make a correlation exceed one by less than this.
_ROUNDING: Final = 1e-6
# Variances below the square of this count as zero.
_UNDERFLOW: Final = 1e-140


def is_covariance(numbers: Any) -> bool:
    """Return True if finite numbers are a covariance: symmetric, positive semidefinite.

    They are a matrix of shape (n, n), its n^2 numbers row by row, or the n (n + 1) / 2 of its upper triangle.
    """
    P = np.asarray(numbers)
    if P.ndim == 1 and math.isqrt(P.size) ** 2 == P.size:
        P = P.reshape(math.isqrt(P.size), -1)
    elif P.ndim == 1:
        n = (math.isqrt(8 * P.size + 1) - 1) // 2
        upper, P = P, np.zeros((n, n))
        P[np.triu_indices(n)] = upper
        P += np.triu(P, 1).T
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
