# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.explain import CRASHED, Named, Outcome, Spec, open_case, runs_of, truth_names
from benchmarks.explain_rivals import (
    CAUSES,
    EXPLAIN,
    Problem,
    Trial,
    classified,
    comparison,
    features,
    forward,
    honest,
    lasso,
    sindy,
    trained,
    try_rivals,
)
from benchmarks.hidden_case import Answer, HiddenEffect
from benchmarks.tables import as_text
from trainid_ros.explain.result import NONE
from trainid_ros.explain.search import SECTIONS
from trainid_ros.train.train_file import parse_train_file

SPEC = Spec('A', 'traction_scale', 77700005)
NAMES = ('headwind', 'tunnel_drag', 'mass_error', 'mass_error')


def problem_of(*coefficients: float, seed: int = 3) -> Problem:
    """Return a problem of eight runs with given coefficients of four independent columns."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((800, len(NAMES)))
    X /= np.sqrt(np.mean(np.square(X), axis=0))
    y = X @ np.array(coefficients) + rng.standard_normal(len(X))
    y /= math.sqrt(float(np.mean(np.square(y))))
    return Problem(y, X, NAMES, (rng.standard_normal((800, 2)),), np.arange(800) // 100, 0.0)


def outcome_of(*hidden: str) -> Outcome:
    effects = tuple(HiddenEffect(name, (), (), 80.0) for name in hidden)
    answer = Answer('single' if hidden else 'none', effects, 80.0 * len(hidden), 0.05, False, (), ())
    return Outcome(Spec('A', 'x', 1), answer, 'no_gap', (), (), None, '', 8, 0.5)


@pytest.mark.parametrize('rival', [forward, lasso, sindy])
def test_rivals_find_what_is_there_and_no_more(rival: Callable[[Problem], set[str]]) -> None:
    if rival is not forward:
        pytest.importorskip('sklearn' if rival is lasso else 'pysindy')
    assert rival(problem_of(0.8, 0.0, 0.0, 0.0)) == {'headwind'}
    assert rival(problem_of(0.8, 0.0, 0.0, -0.7)) == {'headwind', 'mass_error'}
    assert 'headwind' not in rival(problem_of(0.0, 0.9, 0.0, 0.0))


def test_a_classifier_learns_which_cause_stands_out() -> None:
    pytest.importorskip('sklearn')

    def trial(k: int) -> Trial:
        coefficients = [0.8 * (k % 4 == j) for j in range(3)]
        truth = outcome_of(*(NAMES[j] for j in range(3) if coefficients[j]))
        return Trial({}, truth, features(problem_of(*coefficients, 0.0, seed=k)))

    model = trained([trial(k) for k in range(80)])
    answers = [classified(trial(k), model) for k in range(100, 112)]
    assert sum({one.name for one in answer.found} == {*truth_names(answer)} for answer in answers) >= 10
    for answer in answers:
        assert sum(p for _, p in answer.probabilities) == pytest.approx(1.0)
    assert dict(answers[3].probabilities)[NONE] > 0.3


def test_rows_of_a_hidden_case_are_white_and_show_the_effect() -> None:
    case = open_case(SPEC)
    train_file = parse_train_file(case.train_yaml, 'assumed train file')
    problem = Problem.of(runs_of(case.bags, train_file), train_file)
    assert problem.X.shape == (problem.y.size, len(problem.names))
    assert {'traction_scale', 'headwind', 'local_drag'} <= {*problem.names}
    assert np.mean(np.square(problem.X), axis=0) == pytest.approx(1.0)
    X = problem.X[:, [name not in SECTIONS for name in problem.names]]
    left = problem.y - X @ np.linalg.lstsq(X, problem.y, rcond=None)[0]
    same = np.diff(problem.run) == 0
    assert abs(float(np.mean((left[1:] * left[:-1])[same]))) < 0.2 * float(np.mean(np.square(left)))


def test_a_trial_has_the_answers_of_all_methods_and_what_a_classifier_gets() -> None:
    trial = try_rivals(SPEC, ['forward selection'], explained=True)
    assert trial.features.shape == (len(CAUSES), 13)
    assert np.isfinite(trial.features[CAUSES.index('traction_scale')]).all()
    assert all('traction_scale' in {one.name for one in outcome.found} for outcome in trial.outcomes.values())
    _, *rows = as_text(comparison({name: [one] for name, one in trial.outcomes.items()}, '')).splitlines()[1:-1]
    assert [row.split('  ')[0] for row in rows] == ['forward selection', EXPLAIN]


def test_only_names_without_a_mechanism_are_honest_outside_the_library() -> None:
    def found(*names: str) -> Outcome:
        return replace(outcome_of('wavy_drag'), found=tuple(Named(name, (), (), 0.0, ()) for name in names))

    assert honest(found())
    assert honest(found('local_drag'))
    assert not honest(found('local_drag', 'headwind'))
    assert not honest(replace(found(), verdict=CRASHED))
