# SPDX-License-Identifier: Apache-2.0
"""Test that suggested drives give what they promise, in the simulator."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.drives import kept_share, summary, try_braking, try_drive


@pytest.mark.long
@pytest.mark.parametrize(('algorithm', 'world'), [('filter-bank', 'metro'), ('V-MILS', 'emu')])
def test_the_median_drive_keeps_its_promise_within_20_percent(algorithm: str, world: str) -> None:
    found = [try_drive(world, realism, algorithm, seed) for realism in ('clean', 'field') for seed in range(2)]
    trials = [trial for trial in found if trial is not None]
    assert len(trials) >= 3
    for name in 'abc':
        assert np.median([trial.ratios[name] for trial in trials]) == pytest.approx(1.0, abs=0.2)
    assert all(trial.drive.least_known.now > trial.drive.least_known.then for trial in trials)
    assert summary(trials)[0] == str(len(trials))
    assert all(len(trial.predicted) == (4 if algorithm == 'filter-bank' else 0) for trial in trials)


@pytest.mark.parametrize('world', ['emu', 'high_speed'])
def test_the_median_braking_keeps_its_promise_within_20_percent(world: str) -> None:
    found = [try_braking(world, realism, seed) for realism in ('clean', 'field') for seed in range(2)]
    trials = [trial for trial in found if trial is not None]
    assert len(trials) >= 3
    assert np.median([trial.ratios['brake rate'] for trial in trials]) == pytest.approx(1.0, abs=0.2)
    for trial in trials:
        promise = trial.drive.least_known
        assert promise.then < promise.wanted.limit < promise.now


def test_share_kept() -> None:
    assert kept_share([0.81, 1.0, 1.19, 1.3]) == 0.75
