# SPDX-License-Identifier: Apache-2.0
"""Implausible fits are distinguished from fits of a train."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.errors import NoAnswerError
from trainid_ros.resistance.trajectory.davis_fit import DavisFit, DavisFitConfig
from trainid_ros.resistance.trajectory.plausible import check_plausible

CONFIG = DavisFitConfig()
GOOD = DavisFit(
    theta=np.array([1.5, 0.02, 0.004]),
    covariance=np.diag([0.1, 0.01, 0.0005]) ** 2,
    force_delay=0.01,
    force_gain=0.002,
    iterations=9,
    converged=True,
    mse=1e-3,
    speed_std=0.02,
    disturbance=0.2,
    inflation=1.0,
    outliers=0.01,
    speed_range=(3.0, 21.0),
    pieces=6,
    nodes=3000,
)


def test_a_fit_of_a_train_is_plausible() -> None:
    check_plausible(GOOD, CONFIG)


def test_resistance_below_zero_within_its_uncertainty_is_plausible() -> None:
    theta = np.array([-0.5, 0.0, 0.004])
    check_plausible(replace(GOOD, theta=theta, covariance=np.diag([0.3, 0.01, 0.0005]) ** 2), CONFIG)


@pytest.mark.parametrize(
    ('odd', 'message'),
    [
        ({'theta': np.array([-1.5, 0.02, 0.004])}, r'-1.4 N/kN .* at 3.0 m/s would drive the train'),
        ({'theta': np.array([9.0, 0.02, -0.03])}, r'at 21.0 m/s would drive the train'),
        ({'outliers': 0.31}, '31% of the speeds are outliers'),
        ({'force_gain': -0.997}, r'a force error of -100%'),
        ({'speed_std': 60.0}, 'speed noise is 60 m/s'),
        ({'disturbance': 1e4}, '22 N/kN of the motion unexplained'),
    ],
)
def test_an_implausible_value_is_reported_in_one_line(odd: dict[str, Any], message: str) -> None:
    with pytest.raises(NoAnswerError, match=message) as caught:
        check_plausible(replace(GOOD, **odd), CONFIG)
    assert 'units' in str(caught.value)
    assert '\n' not in str(caught.value)
