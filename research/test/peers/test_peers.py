# SPDX-License-Identifier: Apache-2.0
"""The ride for the comparison has its documented statistics on a fresh seed, and separates the estimators."""

from __future__ import annotations

import math
import mmap
import os
import pickle
from dataclasses import replace

import numpy as np
import pytest

from research.peers import peer_brake, peer_fits
from research.peers.contest import copied, growth, time_in_turns
from research.peers.hand_filters import GATE, HandRls, NumpyRls, RowPeer
from research.peers.metro_stream import (
    AFTER,
    BEFORE,
    NOISE_SD,
    SCENARIOS,
    MetroStream,
    Scenario,
    curve_error,
    metro_stream,
)
from research.peers.our_filters import MilsPlain
from research.peers.peer_brake import CONTESTANTS

SEED = 10_000 + int.from_bytes(os.urandom(4))
LAGS = (1, 2, 3, 5, 7)
AUTOCORRELATION = (0.73, 0.47, 0.23, -0.17, -0.39)


def noise(stream: MetroStream) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    davis = np.array((stream.before.a, stream.before.b, stream.before.c))
    return np.asarray(stream.rows.y - stream.rows.phi @ davis)


def final_error(estimator: RowPeer, stream: MetroStream) -> float:
    for item in estimator.items(stream):
        estimator.step(*item)
    return curve_error(estimator.theta, stream.after)


def test_the_same_seed_gives_the_same_ride() -> None:
    one, other = metro_stream(7, 'slip', 500), metro_stream(7, 'slip', 500)
    assert np.array_equal(one.raw.speed, other.raw.speed)
    assert np.array_equal(one.rows.y, other.rows.y)
    assert not np.array_equal(one.rows.y, metro_stream(8, 'slip', 500).rows.y)


@pytest.mark.parametrize('scenario', SCENARIOS)
def test_rows_have_the_requested_number_and_lie_in_motion(scenario: Scenario) -> None:
    stream = metro_stream(9, scenario, 1000)
    assert stream.rows.y.shape == (1000,)
    assert stream.rows.tick[-1] == stream.raw.speed.size - 1
    window = stream.rows.tick[:, None] - np.arange(11)
    assert stream.raw.moving[window].all()
    assert (stream.raw.speed >= 0.0).all()
    assert np.abs(stream.raw.gradient).max() <= 25.0


def test_curve_error_is_the_rms_over_the_curve() -> None:
    assert curve_error((BEFORE.a + 0.3, BEFORE.b, BEFORE.c), BEFORE) == pytest.approx(0.3)
    v = np.linspace(5.0, 22.0, 69)
    expected = np.sqrt(np.mean((0.4 + 0.00024 * v * v) ** 2))
    assert curve_error((AFTER.a, AFTER.b, AFTER.c), BEFORE) == pytest.approx(expected)


@pytest.mark.slow
def test_noise_of_clean_rows() -> None:
    e = noise(metro_stream(SEED))
    e = e - e.mean()
    assert e.std() == pytest.approx(NOISE_SD, abs=0.08), SEED
    found = [float((e[lag:] * e[:-lag]).mean() / e.var()) for lag in LAGS]
    assert found == pytest.approx(AUTOCORRELATION, abs=0.08), SEED


@pytest.mark.slow
def test_statistics_of_outliers_and_slip() -> None:
    out, slip, clean = (metro_stream(SEED, scenario) for scenario in ('out5', 'slip', 'clean'))
    errors = out.rows.y - clean.rows.y
    bad = np.abs(errors) > 0.0
    assert np.array_equal(bad, out.rows.spoiled)
    assert bad.mean() == pytest.approx(0.05, abs=0.01), SEED
    assert (errors[bad] > 0.0).mean() == pytest.approx(0.7, abs=0.08), SEED
    assert 10.0 <= np.abs(errors[bad]).min() <= np.abs(errors[bad]).max() <= 60.0
    assert slip.raw.spoiled[slip.raw.moving].mean() == pytest.approx(0.05, abs=0.005), SEED
    assert np.array_equal(slip.rows.y[~slip.rows.spoiled], clean.rows.y[~slip.rows.spoiled])


@pytest.mark.slow
def test_ride_separates_robust_from_plain_estimators() -> None:
    """Limits far from the values over 30 seeds: clean .002 to .036, gross errors .59 to .93, slip .12 to .35."""
    rides = {scenario: metro_stream(SEED, scenario) for scenario in SCENARIOS}
    plain = {scenario: final_error(HandRls(), ride) for scenario, ride in rides.items()}
    gated = {scenario: final_error(HandRls(GATE), ride) for scenario, ride in rides.items()}
    soft = {scenario: final_error(MilsPlain(), ride) for scenario, ride in rides.items()}
    assert plain['clean'] < 0.09, SEED
    assert plain['out5'] > 0.3, SEED
    assert plain['slip'] > 0.03, SEED
    for scenario in ('clean', 'out5', 'slip'):
        assert gated[scenario] < 0.1, (SEED, scenario)
        assert soft[scenario] < 0.1, (SEED, scenario)
    assert 0.15 < plain['step'] < 0.36, SEED
    assert final_error(HandRls(GATE, 0.9995), rides['step']) < 0.14, SEED


def test_hand_and_numpy_rls_agree() -> None:
    stream = metro_stream(10, 'clean', 800)
    one, other = HandRls(), NumpyRls()
    final_error(one, stream)
    final_error(other, stream)
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-9)
    np.testing.assert_allclose(one.moments[1], other.moments[1], rtol=1e-7)


def touched_pages(size: int) -> mmap.mmap:
    pages = mmap.mmap(-1, size)
    pages[:: mmap.PAGESIZE] = b'x' * math.ceil(size / mmap.PAGESIZE)
    return pages


def test_contest_measures_time_memory_and_copies() -> None:
    quick, slow = time_in_turns([(lambda n: n, [(1,)] * 400), (lambda n: sum(range(n)), [(3000,)] * 400)])
    assert quick.p50 < slow.p50
    assert slow.p50 <= slow.p99
    kept: list[mmap.mmap] = []
    # Pages from the system: malloc would first use memory that the tests before have freed.
    assert growth(lambda: kept.append(touched_pages(40_000_000)), [()], 1, 4) > 30_000_000.0
    saved = copied(HandRls())
    assert saved is not None
    assert saved[0] == len(pickle.dumps(HandRls()))
    assert copied(lambda: None) is None


def test_all_filters_run_over_all_seeds_or_the_note_lists_them(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = [item for item in peer_brake.CONTESTANTS if item.kind == 'KF']
    slow = replace(quick[0], name='slow', drives=2, stops=1)
    monkeypatch.setattr(peer_brake, 'CONTESTANTS', (*quick, slow, replace(quick[0], name=peer_brake.RATIO)))
    monkeypatch.setattr(peer_brake, 'over_seeds', lambda run, seeds: [run(seed) for seed in seeds])
    (table,) = peer_brake.measure(3)
    assert {row[0]: row[-1] for row in table.rows} == {
        **{q.name: '3' for q in quick},
        'slow': '2',
        peer_brake.RATIO: '3',
    }
    assert 'slow, over 2 drives of 3' in table.note
    assert {item.name for item in CONTESTANTS if item.drives < 60} == {'filterpy KalmanFilter per particle, 500'}


def test_fits_run_over_all_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def fits(number: int) -> list[peer_fits.Result]:
        asked.append(number)
        return [peer_fits.Result('fit', ride, 0.1, 1.0) for ride in ('clean', 'slip', 'out5')]

    monkeypatch.setattr(peer_fits, 'fits', fits)
    monkeypatch.setattr(peer_fits, 'over_seeds', lambda run, seeds: [run(seed) for seed in seeds])
    (table,) = peer_fits.measure(60)
    assert asked == list(range(60))
    assert 'over 60 seeds' in table.note
