# SPDX-License-Identifier: Apache-2.0
"""Saved states are restored to the bit, and any other text is rejected."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.state import decode, encode


@dataclass(frozen=True, slots=True)
class Inner:
    value: float
    count: int = 0


@dataclass(frozen=True, slots=True)
class Outer:
    inner: Inner
    many: tuple[Inner, ...]
    numbers: tuple[float, ...]
    maybe: Inner | None
    text: str
    flag: bool


@dataclass(frozen=True, slots=True)
class WithArray:
    array: NDArray[np.float64]


EXAMPLE = Outer(Inner(0.1, 3), (Inner(1.0), Inner(2.0)), (1.0, 2.5), None, 'x', flag=True)


def bits(value: float) -> str:
    return 'nan' if math.isnan(value) else value.hex()


@given(st.lists(st.floats(), max_size=20))
def test_floats_read_back_to_the_bit(values: list[float]) -> None:
    back = decode(encode(WithArray(np.array(values))), WithArray)
    assert [bits(value) for value in back.array.tolist()] == [bits(value) for value in values]


def test_nested_states_read_back_equal() -> None:
    assert decode(encode(EXAMPLE), Outer) == EXAMPLE


@given(st.integers(min_value=-(2**80), max_value=2**80))
def test_stamps_of_any_size_stay_exact(count: int) -> None:
    assert decode(encode(Inner(0.0, count)), Inner).count == count


def changed(**fields: Any) -> str:
    data = json.loads(encode(EXAMPLE))
    data['state'].update(fields)
    return json.dumps(data)


@pytest.mark.parametrize(
    'text',
    [
        '',
        'null',
        '[]',
        '7',
        '{}',
        '{"type": "Outer"}',
        '{"type": "Outer", "state": null}',
        encode(EXAMPLE)[:-5],
        encode(Inner(1.0)),
        changed(numbers=3.0),
        changed(numbers=['a']),
        changed(text=1),
        changed(flag='yes'),
        changed(inner={'value': 1.0}),
        changed(inner={'value': 1.0, 'count': 1.5}),
        changed(inner={'value': 'NaN', 'count': 1}),
        changed(inner=['value', 'count']),
        changed(surplus=1),
        pytest.param(changed(numbers=[10**400]), id='too large for a float'),
        pytest.param(changed(inner={'value': 1.0, 'count': 10**400}), id='too large for a count'),
        pytest.param('[' * 100_000, id='deep'),
        pytest.param('{"type": "Outer", "state": ' + '[' * 900 + ']' * 900 + '}', id='lists'),
    ],
)
def test_a_text_that_does_not_fit_raises_an_input_error_naming_the_class(text: str) -> None:
    with pytest.raises(InputError, match='Outer'):
        decode(text, Outer)


@dataclass(frozen=True, slots=True)
class Fixed:
    pair: tuple[float, float]


@pytest.mark.parametrize('pair', [[], [1.0], [1.0, 2.0, 3.0]])
def test_a_tuple_of_fixed_length_must_have_that_length(pair: list[float]) -> None:
    assert decode(encode(Fixed((1.0, 2.0))), Fixed) == Fixed((1.0, 2.0))
    with pytest.raises(InputError, match=r'Fixed\.pair has . entries, not 2'):
        decode(json.dumps({'type': 'Fixed', 'state': {'pair': pair}}), Fixed)
