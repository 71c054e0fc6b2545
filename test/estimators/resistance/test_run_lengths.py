# SPDX-License-Identifier: Apache-2.0
"""The tracker follows steps, ignores bursts, finds back when locked out and otherwise forgets nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.core.codec import decode, encode
from trainid_ros.estimators.resistance.robust import Belief, predict
from trainid_ros.estimators.resistance.robust_fit import robust_fit
from trainid_ros.estimators.resistance.run_lengths import RunLengths, Tracker, TrackerState

STD = 0.5
PRIOR: Belief = (1.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.01, 0.0, 1e-4)
PLAN = RunLengths(
    p=4,
    outliers=0.1,
    step_variances=(1.0, 1e-4, 1e-6),
    hazard=1e-3,
    spacing=8,
    watchers=5,
    patience=32,
    lockout=60,
)
Spoil = Callable[[int, np.random.Generator], float]


def w(v: float | NDArray[np.float64], a: float = 1.5) -> float | NDArray[np.float64]:
    return a + 0.03 * v + 0.004 * v * v


def track(seed: int, count: int, *, a: Callable[[int], float] = lambda _: 1.5, spoil: Spoil | None = None) -> Tracker:
    rng, tracker = np.random.default_rng(seed), Tracker(PRIOR, PLAN)
    for i, v in enumerate(rng.uniform(3.0, 20.0, count).tolist()):
        y = float(w(v, a(i))) + STD * float(rng.standard_normal())
        tracker.update(v, v * v, y + (spoil(i, rng) if spoil else 0.0), STD * STD)
    return tracker


def error(tracker: Tracker, a: float = 1.5) -> float:
    v = np.linspace(3.0, 20.0, 30)
    x, y, z = tracker.belief[:3]
    return float(np.sqrt(np.mean((x + y * v + z * v * v - w(v, a)) ** 2)))


@pytest.mark.parametrize('seed', range(3))
def test_while_nothing_changes_it_is_as_good_as_least_squares(seed: int) -> None:
    tracker = track(seed, 2000)
    std = np.mean([predict(tracker.belief, v, v * v)[1] for v in np.linspace(3.0, 20.0, 30)]) ** 0.5
    assert tracker.steps_found == 0
    # Three parameters from 2000 observations, and some doubt whether there was a step of late.
    assert 0.9 < std / (STD * (3.0 / 2000.0) ** 0.5) < 1.7
    assert error(tracker) < 3.0 * std


@pytest.mark.parametrize('step', [0.5, -0.8, 6.0, -9.0])
def test_a_step_is_followed(step: float) -> None:
    tracker = track(11, 1120, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    assert error(tracker, 1.5 + step) < 0.2
    tracker = track(11, 1400, a=lambda i: 1.5 + (step if i >= 1000 else 0.0))
    assert tracker.steps_found >= 1
    assert error(tracker, 1.5 + step) < 0.12


@pytest.mark.parametrize('seed', range(3))
def test_bursts_are_no_step(seed: int) -> None:
    """A tenth of the observations lies in bursts of ten that are all off by the same."""
    tracker = track(seed, 1500, spoil=lambda i, _: 5.0 if i % 100 >= 90 else 0.0)
    assert tracker.steps_found == 0
    assert error(tracker) < 0.12


def test_where_most_is_bad_for_a_while_it_holds_on() -> None:
    tracker = track(4, 1000, spoil=lambda _, rng: float(rng.uniform(4.0, 20.0)) if rng.random() < 0.3 else 0.0)
    assert error(tracker) < 0.15


def test_saved_and_restored_it_goes_on_to_the_bit() -> None:
    tracker = track(5, 333)
    state = tracker.state()
    assert state.is_sound()
    copy = Tracker(PRIOR, PLAN)
    copy.restore(decode(encode(state), TrackerState))
    for item in (tracker, copy):
        item.update(10.0, 101.0, 3.0, 0.2, 1.5)
    assert copy.belief == tracker.belief
    assert copy.state() == tracker.state()
    copy.reset()
    assert copy.belief == pytest.approx(PRIOR)


def test_a_state_of_the_wrong_size_shows() -> None:
    state = track(6, 40).state()
    assert not replace(state, memory=state.memory[:-1]).is_sound()
    assert not replace(state, memory=(float('nan'), *state.memory[1:])).is_sound()
    assert not replace(state, rows=((1.0, 2.0),)).is_sound()


def test_the_robust_fit_finds_what_most_rows_agree_on() -> None:
    rng = np.random.default_rng(8)
    v = rng.uniform(3.0, 20.0, 200)
    y = w(v) + STD * rng.standard_normal(200)
    y = np.where(rng.random(200) < 0.3, y + rng.uniform(4.0, 20.0, 200), y)
    rows = tuple((float(x), float(x * x), float(z), STD * STD, 1.0) for x, z in zip(v, y, strict=True))
    fit = robust_fit(rows, PRIOR)
    assert fit is not None
    at = np.linspace(3.0, 20.0, 30)
    wrong = np.array([predict(fit, x, x * x)[0] for x in at.tolist()]) - w(at)
    # Three parameters from 140 good rows: 0.07.
    assert float(np.sqrt(np.mean(wrong**2))) < 0.25


@pytest.mark.parametrize('index', range(6))
def test_information_of_no_covariance_shows(index: int) -> None:
    state = track(6, 40).state()
    for wrong in (0.0, -1.0, 1e30):
        memory = [*state.memory]
        if index not in {0, 3, 5}:
            memory[index] = 1e30
        elif wrong <= 0.0:
            memory[index] = wrong
        else:
            memory[9 + index] = -1e30
        assert not replace(state, memory=tuple(memory)).is_sound()


@pytest.mark.parametrize(('index', 'wrong'), [(3, -1.0), (6, -1.0), (8, -1e-12), (4, 1e3), (9, 1e4)])
def test_a_watcher_of_no_covariance_or_beyond_its_bounds_shows(index: int, wrong: float) -> None:
    state = track(6, 40).state()
    watcher = [*state.watchers[0]]
    watcher[index] = wrong
    assert not replace(state, watchers=(tuple(watcher),)).is_sound()


@pytest.mark.parametrize('changes', [{'mean_weight': float('nan')}, {'mean_weight': -0.1}, {'count': -1}])
def test_a_weight_or_count_beyond_its_bounds_shows(changes: dict[str, float]) -> None:
    assert not replace(track(6, 40).state(), **changes).is_sound()  # type: ignore[arg-type]
