# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from trainid_ros.fleet.changes import causes_of

STD = {'w15': 0.02, 'brake_rate': 0.006, 'force_scale': 0.004, 'wheel_ratio': 0.0003}


@pytest.mark.parametrize(
    ('steps', 'effect'),
    [
        ({'w15': 0.25}, 'dragging_brake'),
        ({'w15': -0.25}, 'resistance_step'),
        ({'brake_rate': -0.1}, 'brake_scale'),
        ({'wheel_ratio': 0.02, 'force_scale': 0.021, 'brake_rate': 0.017, 'w15': 0.03}, 'wheel_diameter'),
        ({'force_scale': -0.07, 'brake_rate': -0.068}, 'mass_error'),
        ({'force_scale': -0.07}, 'traction_scale'),
        ({'w15': 0.3, 'wheel_ratio': 0.05, 'brake_rate': -0.2}, 'other'),
    ],
)
def test_causes_are_known_by_their_channels(steps: dict[str, float], effect: str) -> None:
    best = causes_of({name: (steps.get(name, 0.0), std) for name, std in STD.items()})[0]
    assert best.effect == effect
    assert best.probability > 0.8


def test_without_the_wheel_ratio_weighing_and_wheels_look_alike() -> None:
    steps = {'w15': (0.0, 0.02), 'brake_rate': (0.02, 0.006), 'force_scale': (0.02, 0.004), 'wheel_ratio': None}
    assert {cause.effect for cause in causes_of(steps)} >= {'wheel_diameter', 'mass_error'}
