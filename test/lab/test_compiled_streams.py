# SPDX-License-Identifier: Apache-2.0
"""A recursion with its memory in an array, compiled or not: to the bit that of V-MILS."""

from __future__ import annotations

import pickle
import tracemalloc
from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_lab.compiled_streams import VMilsStream
from trainid_lab.resistance.multi_innovation import NOTHING, information_of, mils_step, posterior_of
from trainid_ros.estimators.compiled.jit import compiler_present

if TYPE_CHECKING:
    from numpy.typing import NDArray

PRIOR = (1.0, 0.0, 0.001, 1.0, 0.0, 0.0, 0.01, 0.0, 1e-5)
P, OUTLIERS = 10, 0.05


def resistance_rows(seed: int, n: int = 1500) -> NDArray[np.float64]:
    """Return v, v^2, y, R, slow with outliers among the y."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(1.0, 22.0, n)
    y = 0.8 + 0.02 * v + 0.0012 * v * v + rng.normal(0.0, 1.0, n)
    y[rng.random(n) < 0.05] += 30.0
    return np.column_stack([v, v * v, y, rng.uniform(0.9, 1.3, n), np.full(n, 1.5)])


def v_mils(rows: NDArray[np.float64]) -> tuple[tuple[float, ...], list[float]]:
    state, parts, weights = (*information_of(PRIOR), *NOTHING), [NOTHING] * P, []
    for k, (v, s, y, R, slow) in enumerate(rows.tolist()):
        state, parts[k % P], weight, _ = mils_step(state, parts[k % P], v, s, y, R, slow, OUTLIERS, P)
        weights.append(weight)
    return posterior_of(state[:9]), weights


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


def test_without_a_compiler_the_numbers_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('trainid_lab.compiled_streams.compiled', lambda kernel: kernel)
    rows = resistance_rows(63, 200)
    stream = VMilsStream(PRIOR, P, OUTLIERS)
    stream.run(rows)
    assert stream.posterior == v_mils(rows)[0]


@pytest.mark.slow
def test_copies_go_on_to_the_bit_and_are_small() -> None:
    rows, resistance = resistance_rows(65), VMilsStream(PRIOR, P, OUTLIERS)
    resistance.run(rows[:700])
    text = pickle.dumps(resistance)
    assert len(text) < 1600
    assert np.array_equal(pickle.loads(text).run(rows[700:]), resistance.run(rows[700:]))


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
