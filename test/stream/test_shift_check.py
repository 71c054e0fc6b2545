# SPDX-License-Identifier: Apache-2.0
"""Steps of the acceleration that come later or sooner than those of the traction."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.stream.balance_checks import ShiftCheck


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


def test_a_delay_found_before_is_suspected_until_steps_contradict_it() -> None:
    rng, check = np.random.default_rng(5), ShiftCheck(delay=1.0)
    x = np.repeat(rng.uniform(0.0, 60.0, 40), 6)
    assert check.is_suspected
    for now_x in x.tolist():
        check.add(now_x + float(rng.normal(0.0, 3.0)), now_x, 0.5)
    assert not check.is_suspected
    assert check.finding == ''
