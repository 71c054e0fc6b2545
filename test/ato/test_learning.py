# SPDX-License-Identifier: Apache-2.0
"""Learning where to aim."""

from __future__ import annotations

import pytest

from trainid_ros.ato.learning import StopBias


def test_a_constant_error_is_learned() -> None:
    bias = StopBias()
    for _ in range(20):
        bias.learn(0.5 + bias.aim)
    assert bias.aim == pytest.approx(-0.5, abs=0.01)


def test_it_aims_at_most_two_metres_away() -> None:
    bias = StopBias()
    for _ in range(20):
        bias.learn(-5.0)
    assert bias.aim == 2.0
