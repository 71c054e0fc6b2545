# SPDX-License-Identifier: Apache-2.0
"""Two windows: stops, steps, slip, and the row algebra behind them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from trainid_lab.resistance.trajectory.two_window import TwoWindow, TwoWindowConfig
from trainid_lab.resistance.trajectory.window import (
    Row,
    RowNoise,
    WindowPosterior,
    WindowPrior,
    fit_rows,
    newest_regime,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Davis, TrainFile

CONFIG = TwoWindowConfig(stride=5, short=10, long=60)
LOOSE = WindowPrior((0.0, 0.0, 0.0), (10.0, 1.0, 0.1, 1e-9, 1e-9))


def rows(count: int, theta: np.ndarray, piece: int = 1, begin: int = 0) -> list[Row]:
    """Rows of 1 s at speeds that rise and fall, of exact sums."""
    sums = np.zeros(3)
    out = []
    for i in range(count):
        v = 12.0 + 8.0 * math.sin(0.2 * (begin + i))
        sums = sums + np.array([1.0, v, v * v]) / 110.0
        out.append(Row(piece, 5.0 - float(theta @ sums), (*(-sums).tolist(), 0.0, 0.0), v, v))
    return out


def test_exact_rows_of_two_pieces_give_exact_parameters() -> None:
    theta = np.array([1.2, 0.03, 0.004])
    given = [*rows(20, theta), *rows(20, theta, piece=2, begin=20)]
    for walk in (1e-6, 0.01):
        posterior = fit_rows(given, RowNoise(1e-4, walk * 1e-4), LOOSE)
        assert posterior.theta == pytest.approx(theta, abs=1e-3)


def test_the_posterior_is_that_of_ordinary_least_squares() -> None:
    theta, rng = np.array([1.2, 0.03, 0.004]), np.random.default_rng(0)
    given = [replace(row, rest=row.rest + 0.01 * rng.standard_normal()) for row in rows(40, theta)]
    posterior = fit_rows(given, RowNoise(0.01, 1e-9), LOOSE)
    A = np.array([[1.0, *row.sums[:3]] for row in given])
    C = 0.01**2 * np.linalg.inv(A.T @ A + 0.01**2 * np.diag([0.0, 1e-2, 1.0, 1e2]))
    assert np.array(posterior.P).reshape(3, 3) == pytest.approx(C[1:, 1:], rel=1e-3)


def test_without_rows_the_posterior_is_the_prior() -> None:
    prior = WindowPrior((1.0, 0.02, 0.003), (0.5, 0.01, 0.001, 0.1, 0.01))
    posterior = fit_rows([], RowNoise(0.01, 0.001), prior)
    assert posterior.theta == pytest.approx(prior.theta)
    assert posterior.resistance(10.0)[1] == pytest.approx(0.25 + 0.01 + 0.01)


def test_a_change_is_located_where_it_happened() -> None:
    before, after = np.array([1.2, 0.03, 0.004]), np.array([3.2, 0.03, 0.004])
    calm = rows(30, before)
    shift = calm[-9].rest - float(after @ np.array(calm[-9].sums[:3]))
    changed = calm[:-8] + [replace(r, rest=shift + float(after @ np.array(r.sums[:3]))) for r in calm[-8:]]
    known = WindowPosterior(tuple(before.tolist()), (0.0,) * 9)
    count, posterior = newest_regime(changed[-20:], RowNoise(0.002, 1e-6), LOOSE, known)
    assert 7 <= count <= 9
    assert posterior.resistance(12.0)[0] == pytest.approx(float(after @ [1.0, 12.0, 144.0]), abs=0.3)


@pytest.fixture(scope='module')
def stepped(journey: Callable[..., list[Sample]]) -> list[Sample]:
    """Six minutes on and off traction with a stop; the resistance steps up by 2 N/kN at 200 s."""
    dry, wet = Davis(1.8, 0.02, 0.005), Davis(3.8, 0.02, 0.005)
    return journey(
        360.0,
        traction=lambda t: 22.0 if t % 40.0 < 20.0 else 0.0,
        resistance=lambda t: dry if t < 200.0 else wet,
        brake=lambda t: -0.5 if 120.0 < t < 130.0 else 0.0,
        seed=5,
    )


def test_a_step_is_detected_and_followed(train_file: TrainFile, stepped: list[Sample]) -> None:
    estimator = TwoWindow(train_file, CONFIG)
    errors: dict[int, list[float]] = {}
    for i, sample in enumerate(stepped):
        estimator.step(sample)
        t, v = 0.2 * i, sample.speed
        truth = (1.8 if t < 200.0 else 3.8) + v * (0.02 + 0.005 * v)
        errors.setdefault(int(t // 20), []).append(estimator.estimate(v).resistance - truth)
    assert estimator.converged
    assert estimator.state.switches >= 1
    assert np.abs(errors[9]).max() < 0.25
    assert np.abs(errors[12]).max() < 0.4
    assert np.abs(errors[17]).max() < 0.25


def test_braking_ends_a_piece(train_file: TrainFile, stepped: list[Sample]) -> None:
    estimator = TwoWindow(train_file, CONFIG)
    reasons = [r.reason for r in map(estimator.step, stepped[: 5 * 160]) if isinstance(r, Rejection)]
    assert Reason.BRAKING in reasons
    assert len({row.piece for row in estimator.state.rows}) == 2


def test_slip_is_rejected_without_changing_the_estimate(train_file: TrainFile, stepped: list[Sample]) -> None:
    estimator = TwoWindow(train_file, CONFIG)
    for sample in stepped[: 5 * 100]:
        estimator.step(sample)
    before = estimator.estimate(15.0)
    slipping = [replace(sample, speed=sample.speed + 1.5) for sample in stepped[500:508]]
    answers = [step_and_estimate(estimator, sample) for sample in slipping]
    assert all(isinstance(r, Rejection) and r.reason is Reason.OUTLIER for r in answers)
    assert not isinstance(estimator.step(stepped[508]), Rejection)
    assert estimator.estimate(15.0).resistance == before.resistance
    # A lasting speed offset starts a new piece.
    far = [replace(sample, speed=sample.speed + 1.5) for sample in stepped[509:560]]
    assert not isinstance([step_and_estimate(estimator, sample) for sample in far][-1], Rejection)


def test_equal_windows_and_invalid_states_are_rejected(train_file: TrainFile) -> None:
    with pytest.raises(InputError, match='short = 60'):
        TwoWindow(train_file, replace(CONFIG, short=60))
    estimator = TwoWindow(train_file, CONFIG)
    text = estimator.save()
    with pytest.raises(InputError, match='posterior'):
        estimator.restore(text.replace('"theta": [1.5,', '"theta": [NaN,'))
