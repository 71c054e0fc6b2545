# SPDX-License-Identifier: Apache-2.0
"""The time base that a step forward has left."""

from __future__ import annotations

import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.alignment import RETURN_NS, PreviousTimeBase

A, B, C = (k * 10**6 * NS_PER_S for k in (1, 2, 3))
S = NS_PER_S


def test_stamps_return_within_a_minute() -> None:
    left = PreviousTimeBase()
    assert not left.is_return(B, A, S)
    assert left.leave(A, B)
    assert left.is_return(B + S, A + S, S)
    assert left.is_return(B + RETURN_NS, A + RETURN_NS, S)
    assert not left.is_return(B + RETURN_NS + 1, A + S, S)
    assert not left.is_return(B + S, A + RETURN_NS + 1, S)
    assert not left.is_return(B + S, A - S - 1, S)


@pytest.mark.parametrize(('lasted_ns', 'home'), [(RETURN_NS, A), (RETURN_NS + 1, B)])
def test_a_second_step_leaves_the_same_time_base_within_a_minute(lasted_ns: int, home: int) -> None:
    left = PreviousTimeBase()
    left.leave(A, B)
    assert left.leave(B + lasted_ns, C) == (home == B)
    assert left.is_return(C, A + S, S) == (home == A)
    assert left.is_return(C, B + lasted_ns + S, S) == (home == B)
