# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest

from trainid_ros.bag.opening_progress import in_two


@pytest.mark.parametrize('scanned', [0.0, 0.9, 1.0])
def test_opening_counts_as_far_as_a_bag_is_scanned(scanned: float) -> None:
    shares = list[float]()
    opening, reading = in_two(shares.append, 0.3)
    opening(scanned)
    reading(0.5)
    assert shares == pytest.approx([0.3 * scanned, 0.5 * (1.0 - 0.3 * scanned)])
    reading(0.5)
    assert math.fsum(shares) == pytest.approx(1.0)
