# SPDX-License-Identifier: Apache-2.0
"""Onset times, and the check that an effect at one place shows in all runs.

Scores of named effects and of generic dependences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from numpy.typing import NDArray

from test.explain.made_runs import DT, TRAIN, Maker, drag, local_drag
from trainid_ros.explain.dataset import Dataset, Run
from trainid_ros.explain.effects import EffectEvaluator, EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters, Noise
from trainid_ros.explain.model import Model
from trainid_ros.explain.nuisances import Bins, Spread
from trainid_ros.explain.result import Hypothesis, probabilities
from trainid_ros.explain.search import (
    SECTIONS,
    EffectScore,
    EffectScorer,
    Search,
    _section,
    _shapes,
    is_confirmed_by_other_runs,
    named_families,
    stretch_sums,
    with_onset,
)
from trainid_ros.train.effects import EFFECTS, EffectKind, Parameter


def test_families_are_columns_of_effects_that_act_in_the_data(dataset: Dataset) -> None:
    evaluator = EffectEvaluator(dataset, TRAIN)
    families = {family.kind.name: family for family in named_families(evaluator)}
    assert {'traction_scale', 'resistance_step', 'bearing_warmup'} <= families.keys()
    # There is no curve and no tunnel, sections are scanned separately, and slip is no resistance.
    assert not {'curve_resistance', 'tunnel_drag', 'wheel_slip', *SECTIONS} & families.keys()
    for family in families.values():
        assert family.resistance.shape == (dataset.dt.size, len(family.shapes))
        assert np.isfinite(family.resistance).all()
    stronger = evaluator.resistance('traction_scale', {'ratio': 1.3})
    assert families['traction_scale'].resistance.shape[1] == 1
    np.testing.assert_allclose(0.3 * families['traction_scale'].resistance[:, 0], stronger, atol=1e-9)
    # A non-linear effect is tried at several amplitudes: opposite shifts of the map lead to different gradients.
    shifts = families['map_shift'].resistance
    assert shifts.shape[1] == len(families['map_shift'].shapes) > 1
    usual = EFFECTS['map_shift'].typical_size
    np.testing.assert_allclose(-usual * shifts[:, 1], evaluator.resistance('map_shift', {'distance': -usual}))
    # Onset times leave enough driving before and after.
    times = np.array([shape['time'] for shape in families['resistance_step'].shapes])
    driven = np.cumsum(dataset.dt)
    assert driven[np.searchsorted(dataset.time, times.min())] > 60.0
    assert driven[-1] - driven[np.searchsorted(dataset.time, times.max())] > 59.0


def user_kind(**parameters: Parameter) -> EffectKind:
    parameters = {'size': Parameter('N/kN'), **parameters}
    return EffectKind('ballast', 'new ballast', 'w = size', parameters, 'size', 1.0, lambda *_: 1.0)


def test_grids_cover_the_positions_and_times_driven(dataset: Dataset) -> None:
    place, time = Parameter('m'), Parameter('s')
    position = dataset.joined('position')
    starts = np.array([shape['start'] for shape in _shapes(user_kind(start=place), dataset)])
    assert starts.size == 40
    assert position.min() < starts.min() < starts.max() < position.max()
    np.testing.assert_allclose(np.diff(starts), np.ptp(position) / 41.0)
    times = [shape['since'] for shape in _shapes(user_kind(since=time), dataset)]
    assert dataset.time[0] < min(times) < max(times) < dataset.time[-1]
    pairs = _shapes(user_kind(start=place, end=place), dataset)
    assert 50 < len(pairs) < 200
    assert all(shape['start'] < shape['end'] for shape in pairs)
    assert all(s['start'] <= 500.0 for s in _shapes(user_kind(start=Parameter('m', high=500.0)), dataset))
    lost = replace(dataset, runs=tuple(replace(run, positioned=False) for run in dataset.runs))
    assert _shapes(user_kind(start=place), lost) == []


def test_sign_of_amplitudes() -> None:
    assert [EFFECTS[name].sign for name in ('local_drag', 'gradient_error', 'brake_fade')] == [1, 0, 1]


Found = tuple[Hyperparameters, NDArray[np.float64]]


def test_block_sums_equal_products_of_explicit_columns() -> None:
    rng = np.random.default_rng(4)
    X, y = rng.standard_normal((30, 7)), rng.standard_normal(30)
    first, end = np.triu_indices(8, 1)
    A, b = stretch_sums(X.T @ X, X.T @ y, first, end)
    stretches = np.stack([X[:, i:j].sum(axis=1) for i, j in zip(first, end, strict=True)], axis=1)
    np.testing.assert_allclose(A, np.square(stretches).sum(axis=0))
    np.testing.assert_allclose(b, stretches.T @ y)


def test_true_effect_has_the_greatest_evidence(dragged_model: Model, dragged_sizes: Found) -> None:
    model, (hyper, _) = dragged_model, dragged_sizes
    named, groups = EffectScorer(model).scores(model, hyper)
    assert named[0].name == 'local_drag'
    assert named[0].evidence > 20.0
    assert named[0].parameters['permille'] == pytest.approx(2.5, abs=1.0)
    assert named[0].parameters['start'] == pytest.approx(100.0, abs=120.0)
    assert groups[0].name == 'place'
    for scores in (named, groups):
        evidence = [score.evidence for score in scores]
        assert evidence == sorted(evidence, reverse=True)


def test_user_effect_is_found_at_its_place(user_effect: Callable[[str, str, str], None]) -> None:
    parameters = "{'start': Parameter('m'), 'value': Parameter('N/kN')}"
    user_effect('new_ballast', parameters, "p['value'] if at.position >= p['start'] else 0.0")
    runs = Maker().runs(6, 77, lambda position, _v, _way: 2.0 if position >= 480.0 else 0.0)
    # Positions far above any time of the drive, so that the two cannot be confused.
    runs = [replace(run, position=run.position + 5000.0) for run in runs]
    model = Model.of(runs, TRAIN)
    hyper, _ = model.evidence().maximise()
    named, _ = EffectScorer(model).scores(model, hyper)
    assert named[0].name == 'new_ballast'
    assert named[0].parameters['start'] == pytest.approx(5480.0, abs=60.0)
    assert named[0].parameters['value'] == pytest.approx(2.0, abs=0.7)


def test_fixed_effects_leave_more_information(dragged_model: Model, dragged_sizes: Found) -> None:
    """An effect with free parameters absorbs what a similar column would explain."""
    model, (hyper, _) = dragged_model, dragged_sizes
    fitted = model.with_terms((local_drag(110.0, 340.0, 1.8),)).fit(hyper)
    unit = fitted.evaluator.resistance('local_drag', {**fitted.terms[0].parameters, 'permille': 1.0})
    column = fitted.dataset.column(unit[:, None])
    (free,) = fitted.informations(hyper, [column])
    (fixed,) = fitted.informations(hyper, [column], terms=False)
    assert float(free.A[0, 0]) < 0.2 * float(fixed.A[0, 0])


HYPER = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.01), Spread(0.005, 0.01, 0.2), 0.0)


def stepped(size: float) -> tuple[Model, float]:
    """Return the model of runs whose resistance rises by a size [N/kN] after 1000 stages, and that time [s]."""
    stage = count()
    runs = Maker().runs(6, 61, lambda *_: size * (next(stage) >= 1000))
    return Model.of(runs, TRAIN), float(np.concatenate([run.time[1:] for run in runs])[1000])


def test_onset_of_a_step_is_within_its_uncertainty() -> None:
    model, true = stepped(0.8)
    step = EffectTerm('resistance_step', {'time': true + 40.0, 'a': 0.6})
    fitted = model.with_terms((step,)).fit(HYPER).terms[0]
    found = with_onset(fitted, model, HYPER)
    assert abs(found.parameters['time'] - true) < 3.0 * found.std['time']
    assert found.std['time'] >= fitted.std['time']
    assert found.std['time'] < 60.0
    assert found.parameters['a'] == fitted.parameters['a']


def test_onset_has_at_least_the_variance_of_its_grid() -> None:
    """A step so large that only one time of the grid is possible."""
    model, true = stepped(40.0)
    found = with_onset(EffectTerm('resistance_step', {'time': true, 'a': 40.0}, 1e-12 * np.eye(2)), model, HYPER)
    cell = model.dataset.time.size * DT / 121.0
    assert found.std['time'] == pytest.approx(cell / np.sqrt(12.0), rel=0.05)


def test_duration_of_a_drag_is_found_from_afar() -> None:
    since, true = 0.0, 11.0

    def clinging(_: float, speed: float, __: int) -> float:
        nonlocal since
        since = DT if speed == 0.4 else since + DT  # a run begins with that speed
        return 2.0 * (since <= true)

    runs = [replace(run, since_release=run.time - run.time[0]) for run in Maker().runs(6, 62, clinging)]
    model = Model.of(runs, TRAIN)
    term = model.with_terms((EffectTerm('dragging_brake', {'time': 60.0, 'permille': 1.0}),)).fit(HYPER).terms[0]
    assert abs(term.parameters['time'] - true) > 10.0
    found = with_onset(term, model, HYPER)
    assert abs(found.parameters['time'] - true) < 3.0 * found.std['time'] < 6.0


def test_a_large_effect_is_no_dependence_without_a_name() -> None:
    """With the gusts that stand for both at first, the dependence seems the better one."""
    model = Model.of(Maker().runs(6, 63, lambda _, speed, __: 0.002 * speed**3), TRAIN)
    found = Search(model).run(slipping=False)
    assert found.final.names == ('higher_order_drag',)
    assert probabilities(found.hypotheses).other < 0.15  # that of lookalikes


def test_a_fit_replaces_the_score_of_an_effect_not_linear_in_its_amplitude(dragged_model: Model) -> None:
    search, scores = Search(dragged_model), [EffectScore(name, 9.0, {}) for name in ('brake_delay', 'brake_slope')]
    assert [one.names for one in search._scored((), 1.0, scores)] == [('brake_delay',), ('brake_slope',)]
    search._fitted += [Hypothesis(('brake_delay',), 2.0), Hypothesis(('brake_slope',), 2.0)]
    assert [*search._scored((), 1.0, scores)] == [Hypothesis(('brake_slope',), 10.0)]


def test_search_finds_an_onset_beyond_a_stop() -> None:
    model, true = stepped(0.8)
    search, far = Search(model), {'time': true + 150.0, 'a': 0.6}
    (term,) = search._extend(model, (EffectScore('resistance_step', 0.0, far),), search.base).model.terms
    assert abs(term.parameters['time'] - true) < 20.0


def test_effect_without_onset_or_fit_is_unchanged(dragged_model: Model) -> None:
    without, unfitted = ('mass_error', {'ratio': 1.02}, np.eye(1)), ('resistance_step', {'time': 100.0, 'a': 0.5})
    for term in (EffectTerm(*without), EffectTerm(*unfitted)):
        assert with_onset(term, dragged_model, HYPER) is term


def test_effect_in_one_run_of_many_is_not_confirmed(dragged: list[Run]) -> None:
    """That in all runs is, and a place that only one run passes needs no confirmation."""
    one_of_many = [*Maker().runs(6, 71), *Maker().runs(7, 72, drag(4.0))[6:]]
    for runs, expected in ((dragged, True), (one_of_many, False), (Maker().runs(1, 73, drag(4.0)), True)):
        model = Model.of(runs, TRAIN).with_terms((local_drag(100.0, 350.0, 2.0),)).fit(HYPER)
        assert is_confirmed_by_other_runs(model, 0, HYPER) is expected


@pytest.mark.slow
def test_no_set_with_an_effect_that_the_final_fit_does_not_show_is_selected(
    dragged_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Search, '_is_supported', lambda *_: True)
    assert Search(dragged_model).run(slipping=False).final.names == ('local_drag',)
    monkeypatch.setattr(EffectTerm, 'significance', property(lambda _: 1.6))
    assert Search(dragged_model).run(slipping=False).final.names == ()


def test_a_section_may_be_as_long_as_the_line() -> None:
    bins = Bins(0.0, 100.0, 80)
    true = np.zeros(bins.count)
    true[5:68] = 2.0  # per mille
    A = 4.0 * np.eye(bins.count)
    found = _section('local_drag', bins, A, A @ true)
    assert (found.parameters['start'], found.parameters['end']) == (500.0, 6800.0)
    assert found.parameters['permille'] == pytest.approx(2.0, abs=0.05)
