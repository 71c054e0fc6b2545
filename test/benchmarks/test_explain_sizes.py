# SPDX-License-Identifier: Apache-2.0
"""Sizes of noise and nuisances where nothing is hidden."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.explain_sizes import NAMES, logs_of, rows


@pytest.mark.slow
def test_sizes_of_a_case_are_those_of_its_data() -> None:
    logs = logs_of('A', 529165, 1)
    assert logs.shape == (1, len(NAMES))
    assert np.exp(logs[0, 0]) < 0.2  # m/s
    assert [row.split()[0] for row in rows(logs)] == [name.split()[0] for name in NAMES]
