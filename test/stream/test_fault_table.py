# SPDX-License-Identifier: Apache-2.0
"""The rows of the table of faults: what they say, and who must wait."""

from __future__ import annotations

import pytest

from trainid_ros.stream.fault_table import TABLE, USUAL, Input, Row


def test_the_first_row_says_that_all_is_well() -> None:
    assert Row('', frozenset()) == TABLE[0]
    assert not (TABLE[0].holds_resistance or TABLE[0].holds_brake_rate)


@pytest.mark.parametrize('row', TABLE[1:], ids=lambda row: row.sentence)
def test_each_row_names_what_it_condemns_and_corrects_something(row: Row) -> None:
    text = row.sentence.format(gain=2.0, brake=0.5, offset=5.0, wheel=0.05)
    assert row.condemns
    assert any(item.value.split(' ')[0] in text or item.value in text for item in row.condemns)
    factors = {row.force, row.command, row.gradient, row.speed, row.position}
    assert (
        factors != {1.0}
        or row.signless
        or row.late
        or row.ignores
        or row.unusual
        or row.wheel_std != TABLE[0].wheel_std
    )


def test_what_an_effect_or_another_train_can_look_like_is_not_misread() -> None:
    misread = {row.sentence for row in TABLE if row.misread}
    assert all(row.misread for row in TABLE if ' is in ' in row.sentence or 'wrong sign' in row.sentence)
    assert {'ato/speed is stuck or follows nothing', 'ato/speed and its position are stuck'} <= misread
    for row in TABLE:
        if row.unusual or row.late is not None or row.wheel_std != TABLE[0].wheel_std:
            assert row.sentence not in misread
    assert not any('line.gradient' in text or 'is off' in text for text in misread)


def test_no_two_rows_are_the_same() -> None:
    assert len(set(TABLE)) == len(TABLE)


@pytest.mark.parametrize('item', list(Input))
def test_what_is_condemned_decides_who_waits(item: Input) -> None:
    row = Row('x', frozenset({item}))
    assert row.holds_resistance == (item in {Input.SPEED, Input.FORCE, Input.MASS, Input.GRADIENT})
    assert row.holds_brake_rate == (row.holds_resistance or item in {Input.COMMAND, Input.BRAKING, Input.BRAKE})


def test_what_is_unusual_is_one_of_the_quantities() -> None:
    assert all(0 < place <= len(USUAL) for row in TABLE for place, _, _ in row.unusual)
    assert all(usual.std > 0.0 and usual.time_s > 0.0 for usual in USUAL)


def test_rows_about_times_are_told_apart() -> None:
    assert {row.is_of_times for row in TABLE if row.late is None} == {False}
    assert {row.is_of_times for row in TABLE if row.late is not None} == {True}
