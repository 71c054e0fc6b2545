# SPDX-License-Identifier: Apache-2.0
"""Sums of numbers with stamps of their own."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_ros.mapping.series import SumOfSeries
from trainid_ros.records import NS_PER_S

S = NS_PER_S


def test_a_single_series_passes_at_once() -> None:
    sums = SumOfSeries(1)
    assert [sums.add(0, k * S, float(k)) for k in (1, 2, 5)] == [[(S, 1.0)], [(2 * S, 2.0)], [(5 * S, 5.0)]]


def test_others_are_interpolated_to_the_stamps_of_the_first() -> None:
    sums = SumOfSeries(2)
    assert sums.add(1, 0, 10.0) == []
    assert sums.add(0, S // 4, 1.0) == []
    ((stamp_ns, value),) = sums.add(1, S // 2, 20.0)
    assert (stamp_ns, value) == (S // 4, 16.0)


def test_a_missing_part_makes_the_sum_unknown_after_a_second() -> None:
    sums = SumOfSeries(2)
    assert sums.add(0, 0, 1.0) == []
    assert sums.add(0, S, 1.0) == []
    ((stamp_ns, value),) = sums.add(0, 3 * S // 2, 1.0)
    assert stamp_ns == 0
    assert math.isnan(value)


def test_nothing_is_interpolated_over_a_long_gap() -> None:
    sums = SumOfSeries(2)
    sums.add(1, 0, 1.0)
    sums.add(0, S // 2, 1.0)
    ((_, value),) = sums.add(1, 3 * S, 1.0)
    assert math.isnan(value)


def test_sums_go_on_after_stamps_that_begin_anew_or_a_wrong_one() -> None:
    sums = SumOfSeries(2)
    found = []
    for stamp_ns in (100 * S, 101 * S, 900 * S, 102 * S, 103 * S, 5 * S, 6 * S):
        for index in (0, 1):
            found += sums.add(index, stamp_ns, 1.0)
    assert [(stamp_ns // S, value) for stamp_ns, value in found] == [
        (k, 2.0) for k in (100, 101, 900, 102, 103, 5, 6)
    ]  # fmt: skip


@given(st.permutations([0, 1] * 10))
def test_which_series_arrives_first_within_a_second_does_not_matter(order: list[int]) -> None:
    sums, found, numbers = SumOfSeries(2), [], [0, 1]
    for index in order:
        k = numbers[index]
        found += sums.add(index, k * S // 25, float(k))
        numbers[index] += 2
    # Even numbers are of the first series; before the first odd one nothing is known.
    assert [stamp_ns for stamp_ns, _ in sorted(found)] == [k * S // 25 for k in range(0, 20, 2)]
    assert [value for _, value in sorted(found)][1:] == pytest.approx([2.0 * k for k in range(2, 20, 2)])
