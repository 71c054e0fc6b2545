# SPDX-License-Identifier: Apache-2.0
"""The example of predictive control reaches its speed, and stays below the limit."""

from __future__ import annotations

import over_hills
from trainid_ros.sim.worlds import find_world, world_train


def test_it_reaches_its_speed_and_stays_below_the_limit() -> None:
    file = world_train(find_world('metro'))
    speeds, chosen = over_hills.drive(file, file, 32.0, uses_map=True)
    assert abs(float(speeds[-1]) - 18.0) < 1.0
    assert speeds.max() < 19.5
    assert len(chosen) >= 15
