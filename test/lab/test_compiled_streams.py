# SPDX-License-Identifier: Apache-2.0
"""Recursions with their memory in arrays, compiled or not: to the bit those of V-MILS and AM-VFF-RLS."""

from __future__ import annotations

import math
import pickle
import tracemalloc
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from benchmarks.papers.brake_runs import metro_train
from trainid_lab.compiled_streams import SpeedModelStream, VMilsStream
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.estimators.compiled.jit import compiler_present
from trainid_ros.speed_model.am_vff_rls import AmVffRls, AmVffRlsConfig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel

PRIOR = (1.0, 0.0, 0.001, 1.0, 0.0, 0.0, 0.01, 0.0, 1e-5)
P, OUTLIERS = 10, 0.05


def resistance_rows(seed: int, n: int = 1500) -> NDArray[np.float64]:
    """Return v, v^2, y, R, slow with outliers among the y."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(1.0, 22.0, n)
    y = 0.8 + 0.02 * v + 0.0012 * v * v + rng.normal(0.0, 1.0, n)
    y[rng.random(n) < 0.05] += 30.0
    return np.column_stack([v, v * v, y, rng.uniform(0.9, 1.3, n), np.full(n, 1.5)])


def speed_rows(seed: int, n: int = 1500) -> NDArray[np.float64]:
    """Return y, u, scale, variance of a train whose resistance doubles in the middle, so that it must forget."""
    rng = np.random.default_rng(seed)
    v, rows = 10.0, []
    for k in range(n):
        u = 20.0 * math.cos(k / 60.0)
        factor = 1.0 if k < n // 2 else 3.0
        v = max(v + 0.2 * (u - factor * (1.5 + 0.03 * v + 0.004 * v * v)) / 110.0, 1.0)
        rows.append((v + 0.02 * rng.standard_normal(), u, 1.0, 4e-4))
    return np.array(rows)


def model() -> AuxiliaryModel:
    estimator: Any = AmVffRls(metro_train(), AmVffRlsConfig())
    method: AuxiliaryModel = estimator._method
    return method


def v_mils(rows: NDArray[np.float64]) -> tuple[tuple[float, ...], list[float]]:
    state, parts, weights = (*information_of(PRIOR), *NOTHING), [NOTHING] * P, []
    for k, (v, s, y, R, slow) in enumerate(rows.tolist()):
        state, parts[k % P], weight, _ = mils_step(state, parts[k % P], v, s, y, R, slow, OUTLIERS, P)
        weights.append(weight)
    return posterior_of(state[:9]), weights


def am_vff_rls(rows: NDArray[np.float64]) -> tuple[tuple[float, ...], list[float], float]:
    method, errors, least = model(), [], 1.0
    numbers = method.start(4e-4)
    for y, u, scale, variance in rows.tolist():
        learned = method.learn(numbers, y, u, scale, variance)
        numbers, least = learned.numbers, min(least, learned.forgetting)
        errors.append(learned.error)
    return numbers, errors, least


@pytest.mark.slow
def test_v_mils_row_by_row_and_at_once() -> None:
    rows = resistance_rows(61)
    belief, weights = v_mils(rows)
    single, batch = VMilsStream(PRIOR, P, OUTLIERS), VMilsStream(PRIOR, P, OUTLIERS)
    assert [single.step(*row) for row in rows.tolist()] == weights
    assert single.posterior == belief
    assert batch.run(rows[:700]).tolist() + batch.run(rows[700:]).tolist() == weights
    assert batch.posterior == belief
    assert min(weights) < 1e-6
    assert max(weights) > 0.9


@pytest.mark.slow
def test_am_vff_rls_row_by_row_and_at_once() -> None:
    rows = speed_rows(62)
    numbers, errors, least = am_vff_rls(rows)
    start, tuning = model().start(4e-4), model().tuning
    single, batch = SpeedModelStream(start, tuning), SpeedModelStream(start, tuning)
    assert [single.step(*row) for row in rows.tolist()] == errors
    assert single.numbers == numbers
    assert batch.run(rows).tolist() == errors
    assert batch.numbers == numbers
    assert least < 1.0, 'nothing was forgotten, so that part was not compared'


def test_without_a_compiler_the_numbers_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('trainid_lab.compiled_streams.compiled', lambda kernel: kernel)
    rows = resistance_rows(63, 200)
    stream = VMilsStream(PRIOR, P, OUTLIERS)
    stream.run(rows)
    assert stream.posterior == v_mils(rows)[0]


@pytest.mark.slow
def test_copies_go_on_to_the_bit_and_are_small() -> None:
    rows, motion = resistance_rows(65), speed_rows(66)
    resistance = VMilsStream(PRIOR, P, OUTLIERS)
    speed = SpeedModelStream(model().start(4e-4), model().tuning)
    resistance.run(rows[:700])
    speed.run(motion[:700])
    text = pickle.dumps(resistance), pickle.dumps(speed)
    assert max(map(len, text)) < 1600
    copies = pickle.loads(text[0]), pickle.loads(text[1])
    assert np.array_equal(copies[0].run(rows[700:]), resistance.run(rows[700:]))
    assert np.array_equal(copies[1].run(motion[700:]), speed.run(motion[700:]))


@pytest.mark.slow
@pytest.mark.skipif(not compiler_present(), reason='numba is not installed')
def test_memory_does_not_grow() -> None:
    stream, rows = VMilsStream(PRIOR, P, OUTLIERS), resistance_rows(64)
    stream.run(rows)
    stream.step(*rows[0].tolist())
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(20):
            stream.run(rows)
            for row in rows[:500].tolist():
                stream.step(*row)
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()
