# SPDX-License-Identifier: Apache-2.0
"""The prior scales with the train and leaves no parameter without uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.estimators.prior import davis_prior


def test_variances_by_hand() -> None:
    P = davis_prior((2.0, -0.04, 0.01), 0.5, (0.6, 0.02, 0.0006))
    expected = [1.0**2 + 0.6**2, 0.02**2 + 0.02**2, 0.005**2 + 0.0006**2]
    assert np.diag(P) == pytest.approx(expected, rel=1e-12)
    assert np.count_nonzero(P) == 3


def test_a_parameter_of_zero_in_the_train_file_stays_free() -> None:
    assert np.diag(davis_prior((1.4, 0.0, 0.01), 0.5, (0.6, 0.02, 0.0006)))[1] == pytest.approx(0.02**2)
