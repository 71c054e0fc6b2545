# SPDX-License-Identifier: Apache-2.0
"""Changes of the speed that the balance of forces, as it was until now, does not explain."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.stream.balance_checks import ChangeCheck

INERTIA = 108.0
SPEED_STD = 0.02
BLOCK_S = 0.6


def drive(
    check: ChangeCheck, blocks: int, offset: float = 0.0, gain: float = 1.0, jump: float = 0.0, seed: int = 1
) -> ChangeCheck:
    """Drive with alternating traction, an offset and gain of the force, and a noisy speed that jumps once [m/s]."""
    rng = np.random.default_rng(seed)
    last = 0.0
    for k in range(blocks):
        x = 60.0 if k % 40 < 20 else 5.0
        noise = SPEED_STD * float(rng.standard_normal())
        y = offset + gain * x + INERTIA * (noise - last + (jump if k == 5 else 0.0)) / BLOCK_S
        check.add(y, x, INERTIA, SPEED_STD, BLOCK_S, off=False)
        last = noise
        if check.is_suspected:
            break
    return check


def test_a_train_whose_mass_and_resistance_are_off_is_not_suspected() -> None:
    check = drive(ChangeCheck(), 2000, offset=-2.0, gain=0.9)
    assert not check.is_suspected
    assert check.offset == pytest.approx(-2.0, abs=0.5)
    assert check.gain == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize(
    ('change', 'within_s'), [({'gain': 0.8}, 3.0), ({'offset': 3.0}, 6.0), ({'jump': 0.4}, 6.0), ({'jump': -0.4}, 6.0)]
)
def test_a_change_on_the_way_is_suspected_soon(change: dict[str, float], within_s: float) -> None:
    check = drive(ChangeCheck(), 400)
    assert not check.is_suspected
    assert drive(check, round(within_s / BLOCK_S), seed=2, **change).is_suspected


def test_a_force_that_suddenly_counts_less_is_named_with_its_ratio_and_an_offset_is_not() -> None:
    check = drive(ChangeCheck(), 400)
    for _ in range(20):
        check.add(48.0, 60.0, INERTIA, SPEED_STD, BLOCK_S, off=False)
    assert check.finding == 'the speed suddenly follows ato/force 0.8 times as much as before'
    check = drive(ChangeCheck(), 400)
    for k in range(40):
        x = 60.0 if k % 20 < 10 else 5.0
        check.add(x - 4.0, x, INERTIA, SPEED_STD, BLOCK_S, off=False)
    assert check.is_suspected
    assert check.finding == ''


def test_where_the_load_is_not_weighed_another_mass_after_a_stop_is_not_suspected() -> None:
    check = drive(ChangeCheck(), 400)
    check.stand(weighed=False)
    assert not drive(check, 400, gain=0.9, seed=2).is_suspected


def test_a_suspicion_ends_when_the_balance_is_as_before() -> None:
    check = drive(ChangeCheck(), 400)
    drive(check, 20, jump=0.4, seed=2)
    count = 0
    while check.is_suspected:
        check.add(5.0, 5.0, INERTIA, SPEED_STD, BLOCK_S, off=False)
        count += 1
    assert 5 < count < 40
    assert check.was_false_alarm


def test_a_change_that_stays_is_the_train_as_it_is_now() -> None:
    check = drive(ChangeCheck(), 400)
    suspected = 0
    for _ in range(400):
        check.add(35.0, 40.0, INERTIA, SPEED_STD, BLOCK_S, off=False)
        suspected += check.is_suspected
    assert 60.0 <= suspected * BLOCK_S < 70.0
    assert not check.was_false_alarm
    assert check.offset + 40.0 * check.gain == pytest.approx(35.0, abs=0.5)
