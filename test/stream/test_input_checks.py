# SPDX-License-Identifier: Apache-2.0
"""Checks of single inputs: what they find, and when they stop finding it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.stream.input_checks import DistanceCheck, LineCheck, MessageCheck, ShiftCheck


def test_a_stepped_command_does_not_alternate() -> None:
    check = MessageCheck()
    for k in range(50):
        check.add_command(-0.2 * (k % 5))
        for _ in range(5):
            check.add_force(0.0, 0.2)
    assert check.finding == ''


def test_an_alternating_command_is_named_until_it_is_quiet() -> None:
    check = MessageCheck()
    for k in range(30):
        check.add_command(-0.6 * (k % 2))
        check.add_force(0.0, 0.1)
    assert 'alternates' in check.finding
    for _ in range(100):
        check.add_force(0.0, 0.2)
    assert check.finding == ''


def test_a_missing_force_is_no_spike() -> None:
    check = MessageCheck()
    for k in range(100):
        check.add_force(math.nan if k % 10 == 0 else 40.0, 0.2)
    assert check.finding == ''
    assert math.isfinite(check.last)


@pytest.mark.parametrize(('ratio', 'text'), [(1.0, ''), (1.02, ''), (1.06, '+6 %'), (3.6, 'km/h')])
def test_distances_are_compared(ratio: float, text: str) -> None:
    check = DistanceCheck()
    for _ in range(400):
        check.add(4.0 * ratio, 4.0)
    assert text in check.finding
    assert bool(check.finding) == bool(text)


def test_an_unknown_or_corrected_position_is_left_out() -> None:
    check = DistanceCheck()
    for k in range(400):
        check.add(4.0, math.nan if k % 7 == 0 else 500.0 if k == 200 else 4.0)
    assert check.finding == ''


def test_a_gradient_off_the_line_is_named_with_its_size() -> None:
    check = LineCheck()
    for k in range(100):
        check.add(5.0 * math.sin(0.1 * k) + 3.0, 5.0 * math.sin(0.1 * k), 0.2)
    assert check.finding == 'ato/gradient is about +3.0 per mille off the line of the train file'


def test_a_gradient_that_goes_its_own_way_is_named() -> None:
    check = LineCheck()
    for k in range(300):
        check.add(5.0 * math.cos(0.1 * k), 5.0 * math.sin(0.1 * k), 0.2)
    assert check.finding == 'ato/gradient does not follow the line of the train file'


def test_a_gradient_that_is_suddenly_off_is_not_used() -> None:
    check = LineCheck()
    assert all(check.add(5.0, 5.0, 0.2) for _ in range(100))
    assert not all(check.add(30.0, 5.0, 0.2) for _ in range(5))
    assert check.finding == ''


@pytest.mark.parametrize('shift', [-3, -1, 0, 2])
def test_the_later_of_two_inputs_is_named_with_its_delay(shift: int) -> None:
    rng, check = np.random.default_rng(5), ShiftCheck()
    x = np.repeat(rng.uniform(0.0, 60.0, 40), 6)
    y = np.roll(x, shift) + rng.normal(0.0, 3.0, x.size)
    for now_y, now_x in zip(y.tolist(), x.tolist(), strict=True):
        check.add(now_y, now_x, 0.5)
    later = '' if not shift else 'ato/speed' if shift > 0 else 'ato/force'
    assert check.finding.startswith(f'{later} is about {0.5 * abs(shift):.1f} s late' if shift else '')
    assert bool(check.finding) == bool(shift)
