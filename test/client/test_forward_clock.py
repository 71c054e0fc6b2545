# SPDX-License-Identifier: Apache-2.0
"""Time goes on when a clock goes back."""

from __future__ import annotations

from typing import Any

import pytest

from trainid_ros.client.train_model import ForwardClock
from trainid_ros.interface.errors import InputError


def test_time_goes_on_from_where_the_clock_went_back() -> None:
    readings = iter([79.0, 80.0, 81.0, 5.0, 5.5, 4.0, 6.0, 90.0])
    clock = ForwardClock(lambda: next(readings))
    assert [clock.now() for _ in range(7)] == [80.0, 81.0, 81.0, 81.5, 81.5, 83.5, 167.5]


@pytest.mark.parametrize('clock', [None, 5.0, 'clock'])
def test_a_clock_that_cannot_be_called_is_named(clock: Any) -> None:
    with pytest.raises(InputError, match=r'^clock = .* must be a function'):
        ForwardClock(clock)


@pytest.mark.parametrize('reading', [None, 'now', float('nan')])
def test_a_clock_that_returns_no_number_is_named(reading: Any) -> None:
    with pytest.raises(InputError, match=r'^clock\(\) = '):
        ForwardClock(lambda: reading)
