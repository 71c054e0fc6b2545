# SPDX-License-Identifier: Apache-2.0
"""The brake rate benchmark in five worlds: least-squares method, scores and tables."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.brake_runs import metro_run, metro_train
from benchmarks.brake_worlds import CONDITIONS, METHODS, ORACLE, SIMPLE, Data, LeastSquares, Score, _score, _table
from benchmarks.worlds import WORLDS


def test_least_squares_estimates_a_brake_rate_different_from_the_train_file() -> None:
    run = metro_run(11, stops=3)
    simple = LeastSquares(metro_train())
    rows = np.array([simple.step(sample) for sample in run.samples])
    braked = run.braked_s > 6.0
    assert np.abs(rows[braked, 0] - run.rate[braked]).mean() < 0.15
    assert np.isfinite(rows).all()


def test_scores_count_while_the_brake_acts_after_the_first_braking() -> None:
    run = metro_run(11, stops=1)
    braking = np.nan_to_num(run.braked_s) > 0.0
    data = Data(run.samples, run.rate, braking, run.speed > 0.0)
    trace = np.column_stack([run.rate + 0.02, np.full(len(run.rate), 0.02), np.ones(len(run.rate))])
    score = _score(trace, data)
    assert score.error == pytest.approx(0.02)
    assert (score.inside, score.usable, score.minutes) == (1.0, 1.0, 0.0)
    assert 0.0 < score.braked < 5.0
    trace[:, 1] = 0.005
    assert _score(trace, data).inside == 0.0


def test_table_has_a_row_for_each_world_and_method() -> None:
    names, score = (*METHODS, SIMPLE, ORACLE), Score(0.0123, 0.951, 0.98, 1.5, 1.6)
    scores = {(condition, world, name): score for condition in CONDITIONS for world in WORLDS for name in names}
    for condition in CONDITIONS:
        table = _table(condition, [scores, scores])
        assert len(table.rows) == len(WORLDS) * len(names)
        assert table.rows[0] == ('metro, GSMA', '0.0123 ± 0.0000', '95.1%', '98%', '1.5', '100%', '1.6')
    late = {key: replace(score, minutes=math.inf) for key in scores}
    assert _table('field', [scores, late]).rows[0][4:6] == ('inf', '50%')
