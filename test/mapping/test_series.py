# SPDX-License-Identifier: Apache-2.0
"""Numbers with stamps of their own, at common stamps."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.mapping.series import JoinedSeries

S = NS_PER_S


def test_a_single_series_passes_at_once() -> None:
    series = JoinedSeries(1)
    assert [series.add(0, k * S, float(k)) for k in (1, 2, 5)] == [[(S, [1.0])], [(2 * S, [2.0])], [(5 * S, [5.0])]]


def test_others_are_interpolated_to_the_stamps_of_the_first() -> None:
    series = JoinedSeries(2)
    assert series.add(1, 0, 10.0) == []
    assert series.add(0, S // 4, 1.0) == []
    assert series.add(1, S // 2, 20.0) == [(S // 4, [1.0, 15.0])]


def test_a_missing_number_is_unknown_after_a_second() -> None:
    series = JoinedSeries(2)
    assert series.add(0, 0, 1.0) == []
    assert series.add(0, S, 1.0) == []
    ((stamp_ns, (_, value)),) = series.add(0, 3 * S // 2, 1.0)
    assert stamp_ns == 0
    assert math.isnan(value)


def test_nothing_is_interpolated_over_a_long_gap() -> None:
    series = JoinedSeries(2)
    series.add(1, 0, 1.0)
    series.add(0, S // 2, 1.0)
    ((_, (_, value)),) = series.add(1, 3 * S, 1.0)
    assert math.isnan(value)


def test_numbers_go_on_after_stamps_that_begin_anew_or_a_wrong_one() -> None:
    series = JoinedSeries(2)
    found = []
    for stamp_ns in (100 * S, 101 * S, 900 * S, 102 * S, 103 * S, 5 * S, 6 * S):
        for index in (0, 1):
            found += series.add(index, stamp_ns, 1.0)
    assert [(stamp_ns // S, values) for stamp_ns, values in found] == [
        (k, [1.0, 1.0]) for k in (100, 101, 900, 102, 103, 5, 6)
    ]  # fmt: skip


@given(st.permutations([0, 1] * 10))
def test_which_series_arrives_first_within_a_second_does_not_matter(order: list[int]) -> None:
    series, found, numbers = JoinedSeries(2), [], [0, 1]
    for index in order:
        k = numbers[index]
        found += series.add(index, k * S // 25, float(k))
        numbers[index] += 2
    # Even numbers are of the first series; before the first odd one nothing is known.
    assert [stamp_ns for stamp_ns, _ in sorted(found)] == [k * S // 25 for k in range(0, 20, 2)]
    assert [sum(values) for _, values in sorted(found)][1:] == pytest.approx([2.0 * k for k in range(2, 20, 2)])
