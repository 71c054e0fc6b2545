# SPDX-License-Identifier: Apache-2.0
"""Windows are cut by time: 25 samples every 6 at 5 Hz, the minimum for a line at 1 Hz."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.records import NS_PER_S
from trainid_ros.resistance.sliding_window import Cut, SlidingWindow
from trainid_ros.resistance.speed_window import Tick


def cuts(dts: list[float]) -> list[tuple[int, Cut]]:
    window, found, stamp = SlidingWindow(4.8, 1.2), [], 1_700_000_000 * NS_PER_S
    for i, dt in enumerate(dts):
        stamp += round(dt * NS_PER_S)
        cut = window.push(Tick(stamp, dt, 10.0, 0.0, 0.0))
        if cut is not None:
            found.append((i, cut))
    return found


@pytest.mark.parametrize(
    ('period', 'samples', 'hop'),
    [(0.1, 49, 12), (0.2, 25, 6), (0.25, 20, 5), (0.5, 11, 2), (1.0, 8, 2), (2.0, 8, 2)],
)
def test_windows_at_all_rates(period: float, samples: int, hop: int) -> None:
    found = cuts([period] * 200)
    assert found[0][0] == samples - 1
    assert {len(cut.ticks) for _, cut in found} == {samples}
    assert set(np.diff([i for i, _ in found]).tolist()) == {hop}
    assert found[-1][1].samples == hop


def test_jitter_changes_no_window() -> None:
    rng = np.random.default_rng(2)
    stamps = 0.2 * np.arange(500) + rng.uniform(-0.02, 0.02, 500)
    found = cuts([0.2, *np.diff(stamps).tolist()])
    assert {len(cut.ticks) for _, cut in found} == {25}
    assert np.diff([i for i, _ in found]).mean() == pytest.approx(6.0, abs=0.05)


def test_missing_samples_do_not_change_the_duration() -> None:
    found = cuts([0.2, 0.2, 0.4] * 60)
    for _, cut in found:
        duration = (cut.ticks[-1].stamp_ns - cut.ticks[0].stamp_ns) / NS_PER_S
        assert duration == pytest.approx(4.8, abs=0.25)


def test_after_clearing_a_new_window_begins() -> None:
    window = SlidingWindow(4.8, 1.2)
    for i in range(24):
        assert window.push(Tick(i * NS_PER_S // 5, 0.2, 10.0, 0.0, 0.0)) is None
    window.clear()
    assert window.push(Tick(24 * NS_PER_S // 5, 0.2, 10.0, 0.0, 0.0)) is None
    assert (len(window.ticks), window.fresh_s) == (1, 0.2)
