# SPDX-License-Identifier: Apache-2.0
"""Nouns are pluralised by their count, values have the digits that their std allows."""

from __future__ import annotations

import math

import pytest

from trainid_ros.interface.text import in_step, pluralise, plus_minus


@pytest.mark.parametrize(('count', 'text'), [(0, '0 runs'), (1, '1 run'), (2, '2 runs')])
def test_only_a_count_of_one_has_no_plural(count: int, text: str) -> None:
    assert pluralise(count, 'run') == text


@pytest.mark.parametrize(
    ('value', 'std', 'text'),
    [
        (1.8234, 0.0812, '1.823 ± 0.081'),
        (4519.437, 12.46, '4519 ± 12'),
        (0.010423, 0.000381, '0.01042 ± 0.00038'),
        (-2.0, 0.0, '-2'),
        (1.5, math.nan, '1.5'),
        (math.nan, 1.0, '–'),
        (1.0, 3e-9, '1 ± 3e-09'),
    ],
)
def test_values_are_rounded_by_their_std(value: float, std: float, text: str) -> None:
    assert plus_minus(value, std) == text


def test_a_value_is_not_more_precise_than_its_std() -> None:
    assert in_step(0.02372, 0.0213) == ('0.024', '0.021')
    assert in_step(1.5, math.nan) == ('1.5', '–')
