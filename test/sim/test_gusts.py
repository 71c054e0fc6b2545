# SPDX-License-Identifier: Apache-2.0
"""Gusts and map errors have the given standard deviation and correlation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainid_ros.errors import InputError
from trainid_ros.sim.gusts import Gust, GustModel, ar1_path


def test_gust_has_its_std_and_its_correlation_time() -> None:
    gust = Gust(GustModel(std=0.1, time_constant=5.0), 0.2, np.random.default_rng(3))
    path = np.array([gust.step() for _ in range(100_000)])
    # 20 000 s hold about 2000 independent values of 10 s: the std is known to 1.6 %, so 6 % is 4 sigma.
    assert path.std() == pytest.approx(0.1, rel=0.06)
    correlation = float(np.corrcoef(path[:-25], path[25:])[0, 1])
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.08)


def test_map_error_path_has_its_std_and_correlation() -> None:
    path = ar1_path(100_000, 0.5, 0.95, np.random.default_rng(4))
    # Correlation 0.95 leaves about 2600 independent values: 1.4 % on the std, so 6 % is 4 sigma.
    assert path.std() == pytest.approx(0.5, rel=0.06)
    assert float(np.corrcoef(path[:-1], path[1:])[0, 1]) == pytest.approx(0.95, abs=0.005)


def test_a_setting_out_of_range_is_rejected() -> None:
    with pytest.raises(InputError, match='time_constant = 0 s'):
        Gust(GustModel(time_constant=0.0), 0.2, np.random.default_rng(0))
