# SPDX-License-Identifier: Apache-2.0
"""A short record made by (7) itself: 300 stages of 100 m, speeds from 17 to 80 m/s."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.resistance.trajectory.stages import Stages, reach

TRUTH = np.array([0.79, 0.0229, 0.001493])
COUNT = 300


@dataclass(frozen=True)
class Ride:
    stages: Stages
    speed: NDArray[np.float64]
    theta: NDArray[np.float64]


@pytest.fixture(scope='session')
def ride() -> Ride:
    lam = reach(np.full(COUNT, 100.0), 0.06)
    v, drive = 17.0, []
    for i in range(COUNT):
        target = 80.0 if i % 150 < 100 else 45.0
        w = float(TRUTH @ [1.0, v, v * v])
        drive.append(w + min(max(3.0 * (target - v), -30.0), 40.0, 1500.0 / v))
        v = float(np.sqrt(v * v + 2.0 * lam[i] * (drive[-1] - w)))
    stages = Stages(lam, np.array(drive))
    return Ride(stages, stages.speeds(TRUTH, 17.0), TRUTH)
