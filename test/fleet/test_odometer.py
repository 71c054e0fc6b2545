# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.bag.record_table import table_of
from trainid_ros.fleet.run_fleet import Odometer
from trainid_ros.interface.records import NS_PER_S, SpeedRecord

RATIO = 1.02


def ride(legs: int, ratio: float, lost: float = 0.0) -> Odometer:
    """Return an odometer after legs of 1 km, there and back, at 10 m/s measured as ``ratio`` times that."""
    speed = np.concatenate([np.r_[np.zeros(5), np.full(100, 10.0)] for _ in range(legs)] + [np.zeros(5)])
    position = np.cumsum(speed) * 1.0
    folded = 1000.0 - np.abs(position % 2000.0 - 1000.0)
    rows = [
        SpeedRecord((k + 1) * NS_PER_S + round(lost * NS_PER_S * (k > 50)), ratio * v, s)
        for k, (v, s) in enumerate(zip(speed.tolist(), folded.tolist(), strict=True))
    ]
    odometer, table = Odometer(), table_of([(record.stamp_ns, record.row()) for record in rows])
    for first in range(0, len(table), 37):
        odometer.add(table[first : first + 37])
    return odometer


def test_the_ratio_is_that_of_the_distances() -> None:
    found = ride(6, RATIO).ratio
    assert found is not None
    assert found[0] == pytest.approx(RATIO, abs=1e-9)
    assert 0.0 < found[1] < 1e-3


def test_legs_with_a_gap_do_not_count() -> None:
    assert ride(1, RATIO, lost=10.0).ratio is None
    found = ride(2, RATIO, lost=10.0).ratio
    assert found is not None
    assert found[0] == pytest.approx(RATIO, abs=1e-9)


def test_another_unit_is_not_the_wheels() -> None:
    assert ride(4, 3.6).ratio is None
