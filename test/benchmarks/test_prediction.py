# SPDX-License-Identifier: Apache-2.0
"""Predictions are better than persistence."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.prediction import HORIZONS, Forecast, forecasts, summary


@pytest.mark.long
def test_predictions_beat_persistence() -> None:
    found = forecasts('tram', 'clean', 1, runs=2)
    for horizon in HORIZONS:
        some = [one for one in found if one.horizon == horizon]
        assert len(some) >= 3 or horizon > 5.0
        for one in some:
            assert abs(one.error) < 0.2 + 0.1 * min(abs(one.speed), abs(one.acceleration)) + 3.0 * one.std
    soon = [one for one in found if one.horizon == HORIZONS[0]]
    client, persistent = (
        np.sqrt(np.mean(np.square(x))) for x in zip(*((o.error, o.acceleration) for o in soon), strict=True)
    )
    assert client < 0.5 * persistent


def test_a_summary_has_a_cell_for_each_column() -> None:
    rows = [
        Forecast(5.0, True, 0.1, 0.05, 1.0, -1.0, np.nan, np.nan),
        Forecast(5.0, True, 0.0, 0.05, 1.0, 1.0, 0.3, 0.4),
    ]
    assert summary(rows) == ('2', '0.071', '0.050', '50.0%', '1.000', '1.000', '0.400', '0.300')
