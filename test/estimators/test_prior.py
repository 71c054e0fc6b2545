# SPDX-License-Identifier: Apache-2.0
"""The prior scales with the train and leaves no parameter without uncertainty."""

from __future__ import annotations

import pytest

from trainid_ros.estimators.settings import PriorSettings, prior_variances

SETTINGS = PriorSettings(prior_share=0.5, prior_std_a=0.6, prior_std_b=0.02, prior_std_c=0.0006)


def test_variances_by_hand() -> None:
    expected = [1.0**2 + 0.6**2, 0.02**2 + 0.02**2, 0.005**2 + 0.0006**2]
    assert prior_variances((2.0, -0.04, 0.01), SETTINGS) == pytest.approx(expected, rel=1e-12)


def test_a_parameter_of_zero_in_the_train_file_stays_free() -> None:
    assert prior_variances((1.4, 0.0, 0.01), SETTINGS)[1] == pytest.approx(0.02**2)
