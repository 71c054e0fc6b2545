# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest

from trainid_ros.interface.results import ResistanceEstimate
from trainid_ros.setup.findings import force_findings


def estimate(scale: float, scale_std: float, delay: float = 0.0, delay_std: float = 0.02) -> ResistanceEstimate:
    davis = (1.5, 0.02, 0.003, (0.0,) * 9, 2.0, 0.1, 10.0, 0.0, 1.0, 0.0, 1.0, 20.0, 0.3)
    return ResistanceEstimate(*davis, scale, scale_std, delay, delay_std)


def test_a_force_scale_of_5_percent_error_is_reported() -> None:
    assert force_findings(estimate(0.953, 0.004)) == (
        'force scale 0.953 ± 0.004: mass or force of the train file is off',
    )


@pytest.mark.parametrize(('scale', 'std'), [(1.0, 0.004), (0.96, 0.02), (1.008, 0.001), (math.nan, math.nan)])
def test_a_small_uncertain_or_missing_error_is_not_reported(scale: float, std: float) -> None:
    assert force_findings(estimate(scale, std)) == ()


@pytest.mark.parametrize(('delay', 'sense'), [(0.25, 'later'), (-0.25, 'earlier')])
def test_a_force_delay_is_reported_with_its_sign(delay: float, sense: str) -> None:
    (found,) = force_findings(estimate(1.0, 0.004, delay))
    assert found == f'force delay 0.25 ± 0.02 s: ato/force is stamped {sense} than it acts'
