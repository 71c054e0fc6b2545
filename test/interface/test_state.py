# SPDX-License-Identifier: Apache-2.0
"""The codec of states: what a class declares is restored to the bit, and nothing that does not fit changes anything."""

from __future__ import annotations

import json
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.state import (
    State,
    declare,
    decode,
    definite,
    encode,
    is_covariance,
    packed,
    restore,
    several,
    stored,
    unknown,
)
from trainid_ros.interface.vectors import vec


class Colour(IntEnum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True, slots=True)
class Inner:
    value: float
    count: int = 0
    known_later: float = math.nan


@dataclass(frozen=True, slots=True)
class Outer:
    inner: Inner
    numbers: tuple[float, ...]
    array: NDArray[np.float64]
    text: str
    flag: bool
    many: tuple[Inner, ...] = stored((), kind=Inner)
    maybe: Inner | None = stored(None, kind=Inner)  # noqa: RUF009 - makes a field


class Item:
    """Restored in place, in a list."""

    STATE: ClassVar[State] = declare('x', 'at')

    def __init__(self, x: float, at: int) -> None:
        self.x, self.at = x, at


class Text:
    """Saves itself."""

    def __init__(self) -> None:
        self.text = 'new'

    def save(self) -> str:
        return self.text

    def restore(self, text: str) -> None:
        if text == 'unfit':
            message = 'unfit'
            raise InputError(message)
        self.text = text


class Whole:
    """Everything that a state may hold."""

    STATE: ClassVar[State] = declare(
        'number', 'count', 'flag', 'name', 'colour', unknown('later'), 'vector', 'array', definite('P'),
        definite('upper'), 'stamps', 'queue', 'kept', 'inner', 'item', several('items', lambda: Item(0.0, 0)),
        several('maybe', lambda: Item(0.0, 0)), several('changes', Inner), several('parts', vec[float]),
        several('counted', Colour), 'rng', 'text',
    )  # fmt: skip

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.config = 'not saved'
        self.number, self.count, self.flag = float(rng.standard_normal()), int(rng.integers(2**62)), seed > 0
        self.name, self.colour, self.later = f'name {seed}', Colour(1 + seed % 2), math.nan if seed else 1.0
        self.vector, self.array = vec[float](rng.standard_normal(5).tolist()), rng.standard_normal((2, 3))
        root = rng.standard_normal((3, 3))
        P = root @ root.T
        self.P, self.upper = vec[float](P.ravel().tolist()), vec[float](P[np.triu_indices(3)].tolist())
        self.stamps = [int(x) for x in rng.integers(2**60, size=seed)]
        self.queue: deque[tuple[float, ...]] = deque([(float(k), 0.5) for k in range(seed)], maxlen=3)
        self.kept, self.inner, self.item = set(range(seed)), Inner(0.1 * seed, seed), Item(float(seed), seed)
        self.items = [Item(0.25 * k, k) for k in range(seed)]
        self.maybe = Item(7.0, 7) if seed else None
        self.changes = [Inner(float(k)) for k in range(seed)]
        self.parts = [vec[float]([float(k), 2.0]) for k in range(seed)]
        self.counted: Counter[Colour] = Counter({Colour.BLUE: seed} if seed else {})
        self.rng, self.text = np.random.default_rng(seed), Text()


@pytest.mark.parametrize(('before', 'after'), [(0, 3), (3, 0), (4, 5)])
def test_a_restored_object_is_equal_whatever_it_was_before(before: int, after: int) -> None:
    saved, other = Whole(after), Whole(before)
    saved.rng.random(7)
    saved.text.text, item, rng = 'old', other.item, other.rng
    restore(other, encode(saved))
    assert encode(other) == encode(saved)
    assert (other.item, other.rng, other.config) == (item, rng, 'not saved')  # in place
    assert other.rng.random() == saved.rng.random()
    assert (other.queue, other.kept, other.counted) == (saved.queue, saved.kept, saved.counted)
    assert other.queue.maxlen == 3
    assert all(type(x) is type(y) for x, y in zip(vars(other).values(), vars(saved).values(), strict=True))


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=20), st.integers(-(2**62), 2**62))
def test_numbers_read_back_to_the_bit(values: list[float], count: int) -> None:
    state = Outer(Inner(values[0] if values else 0.0, count), tuple(values), np.array(values), 'x', flag=True)
    back = decode(encode(state), Outer)
    assert [x.hex() for x in back.numbers] == [x.hex() for x in back.array.tolist()] == [x.hex() for x in values]
    assert back.inner.count == count


def test_a_dataclass_reads_back_equal() -> None:
    many = (Inner(1.0, known_later=2.0), Inner(2.0, known_later=math.inf))
    state = Outer(Inner(0.1, 3, -0.0), (1.0, 2.5), np.zeros(2), 'x', many=many, maybe=many[0], flag=False)
    assert repr(decode(encode(state), Outer)) == repr(state)


Change = Callable[[dict[str, Any]], object]


def put(name: str, value: object) -> Change:
    return lambda state: state.update({name: value})


WRONG: dict[str, tuple[Change, str]] = {
    'NaN': (put('number', math.nan), r'Whole\.number = nan is not finite'),
    'text for a number': (put('number', 'fast'), r"Whole\.number = 'fast' must be of type float"),
    'fraction for a count': (put('count', 0.5), r'Whole\.count = 0\.5 must be of type int'),
    'huge count': (put('count', 10**40), r'Whole\.count is an integer out of range'),
    'count for a flag': (put('flag', 1), r'Whole\.flag = 1 must be of type bool'),
    'unknown colour': (put('colour', 77), r'Whole\.colour = 77 is no Colour'),
    'short vector': (put('vector', packed(np.ones(4))), r'Whole\.vector has the shape \(4,\), not \(5,\)'),
    'infinite vector': (put('vector', packed(np.full(5, math.inf))), r'Whole\.vector is not finite'),
    'matrix for a vector': (put('vector', packed(np.ones((5, 1)))), r'Whole\.vector has the shape'),
    'turned array': (put('array', packed(np.ones((3, 2)))), r'Whole\.array has the shape \(3, 2\), not \(2, 3\)'),
    'array without bytes': (put('array', {'shape': [2, 3]}), r'Whole\.array = .* is not an array'),
    'negative variance': (put('P', packed(-np.eye(3).ravel())), r'Whole\.P is not a covariance'),
    'asymmetric': (put('P', packed(np.array([1.0, 0.5, 0, 0, 1, 0, 0, 0, 1]))), r'Whole\.P is not a covariance'),
    'correlation above one': (put('upper', packed(np.array([1.0, 2, 0, 1, 0, 1]))), r'Whole\.upper is not a cov'),
    'NaN in a list': (put('stamps', [1, math.nan]), r'Whole\.stamps = nan is not finite'),
    'object in a list': (put('stamps', [{}]), r'Whole\.stamps holds objects that are not declared'),
    'number for a list': (put('queue', 3), r'Whole\.queue = 3 must be of type list'),
    'field of a dataclass': (lambda s: s['inner'].update(value='x'), r"Whole\.inner\.value = 'x'"),
    'lost field': (lambda s: s['inner'].pop('count'), r'Whole\.inner has other fields than in this version'),
    'field in place': (lambda s: s['item'].update(at=0.5), r'Whole\.item\.at = 0\.5'),
    'item': (lambda s: s['items'][1].update(x=None), r'Whole\.items\[1\]\.x = None must be of type float'),
    'item of dataclasses': (put('changes', [3]), r'Whole\.changes\[0\] = 3 must be of type dict'),
    'optional': (put('maybe', 4), r'Whole\.maybe = 4 must be of type dict'),
    'counter': (put('counted', {'2': -0.5}), r'Whole\.counted = -0\.5 must be of type int'),
    'generator': (put('rng', {'bit_generator': 'PCG64'}), r'Whole\.rng is not a state of a random generator'),
    'large generator': (lambda s: s['rng'].update(has_uint32=10**40), r'Whole\.rng is not a state of a random gen'),
    'own text': (put('text', 'unfit'), 'unfit'),
    'no text': (put('text', 7), r'Whole\.text = 7 must be of type str'),
    'new field': (put('more', 1), r'Whole has other fields'),
}


@pytest.mark.parametrize('name', WRONG)
def test_a_field_that_does_not_fit_is_named_and_nothing_changes(name: str) -> None:
    (change, message), state = WRONG[name], Whole(3)
    data = json.loads(encode(Whole(4)))
    change(data['state'])
    before = encode(state)
    with pytest.raises(InputError, match=message):
        restore(state, json.dumps(data))
    assert encode(state) == before


@pytest.mark.parametrize(
    'text',
    [
        '',
        'null',
        '[]',
        '{}',
        '{"type": "Inner"}',
        '{"type": "Outer", "state": {}}',
        '{"type": "Inner", "state": 3}',
        '[',
    ],
)
def test_a_text_of_anything_else_names_the_class(text: str) -> None:
    with pytest.raises(InputError, match='saved Inner'):
        decode(text, Inner)


@given(st.text(max_size=40) | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps))
def test_no_text_raises_anything_but_an_input_error(text: str) -> None:
    for wrapped in (text, json.dumps({'type': 'Inner', 'state': text})):
        with pytest.raises(InputError):
            decode(wrapped, Inner)


def test_covariances_are_distinguished_from_other_matrices_at_any_scale() -> None:
    rng = np.random.default_rng(51)
    scale = np.array([1.0, 1e-3, 1e-7, 1e-9])
    root = scale[:, None] * rng.standard_normal((4, 4))
    upper = (root @ root.T)[np.triu_indices(4)]
    assert is_covariance(upper.tolist())
    assert is_covariance((root @ root.T).ravel())
    assert is_covariance([0.0] * 10)
    for k in range(10):
        wrong = upper.copy()
        wrong[k] = -wrong[k] if k in {0, 4, 7, 9} else 1.01 * math.copysign(1.0, wrong[k])
        assert not is_covariance(wrong.tolist()), k


def test_zero_variance_implies_zero_covariance_and_a_covariance_is_symmetric() -> None:
    assert is_covariance([1.0, 0.0, 0.0])
    assert not is_covariance([1.0, 1e-9, 0.0])
    # Variance and covariance have decayed, the covariance half as fast.
    assert is_covariance([1.0, 1e-170, 0.0])
    assert is_covariance([1.0, 1e-155, 1e-310])
    assert is_covariance(np.array([[1.0, 0.5], [0.5, 1.0]]))
    assert not is_covariance(np.array([[1.0, 0.5], [-0.5, 1.0]]))
