# SPDX-License-Identifier: Apache-2.0
"""Held-out runs: subtraction equals a fit without them, and the gap shrinks when the missing effect is added.

Where the gap is, and its parts as text.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Maker, drag, local_drag
from trainid_ros.explain.effects import SHOWN, EffectTerm
from trainid_ros.explain.likelihood import Hyperparameters, Noise, eliminate, posterior
from trainid_ros.explain.model import Model
from trainid_ros.explain.nuisances import DAVIS, Spread
from trainid_ros.explain.proof import Outcome, gap_of, hold_out, locate, read_gap, weakest, where
from trainid_ros.explain.result import Verdict, place_text


def test_missing_resistance_is_located_at_the_effect(
    dragged_model: Model, dragged_sizes: tuple[Hyperparameters, object]
) -> None:
    model, (hyper, _) = dragged_model, dragged_sizes
    after = model.with_terms((local_drag(100.0, 350.0, 2.5),))
    locations = {one.axis: one for one in locate(model, after, hyper)}
    axes = {'position, rising', 'position, falling', 'speed', 'mode', 'direction', 'run'}
    assert locations.keys() - {'heat of the brake'} == axes
    rising = locations['position, rising'].places
    strongest = max(rising, key=lambda place: place.before / place.std)
    assert strongest.high > 100.0
    assert strongest.low < 450.0
    assert strongest.before > 3.0 * strongest.std
    assert abs(strongest.after) < 0.5 * strongest.before
    for location in locations.values():
        # Parts are deviations from the mean of all parts.
        total = sum(place.share for place in location.places)
        assert sum(place.share * place.before for place in location.places) / total == pytest.approx(0.0, abs=1e-6)
    assert [place.label for place in locations['mode'].places] == ['traction', 'coasting', 'braking']


def test_an_effect_is_where_it_acts(dragged_model: Model) -> None:
    dataset = dragged_model.dataset
    front, force = (dataset.joined(name) for name in ('position', 'traction'))
    text = where(np.where((front > 100.0) & (front < 450.0), 2.5, 0.0), dataset)
    low, high = (float(edge) for edge in re.findall(r'^at (\d+) to (\d+) m ', text)[0])
    assert (low, high) == pytest.approx((100.0, 450.0), abs=40.0)
    assert where(0.05 * force, dataset).startswith('under traction (+')
    assert where(np.ones(front.size), dataset) == 'no distinct location'


def test_every_located_part_has_a_phrase() -> None:
    assert place_text('tunnel', 'tunnel') == 'in tunnels'
    assert place_text('mode', 'just released') == 'just after the brake is released'
    assert place_text('direction', 'rising') == 'towards rising positions'
    assert place_text('position, falling', '300 to 400 m') == 'at 300 to 400 m towards falling positions'
    assert place_text('speed', '10 to 12 m/s') == 'at speeds of 10 to 12 m/s'
    assert place_text('run', '3') == 'run 3'
    runs = []
    for run in Maker().runs(2, 3):
        inside = ((run.position > 300.0) & (run.position < 600.0)).astype(float)
        runs.append(replace(run, tunnel=inside, radius=300.0 * inside, heat=np.cumsum(-run.brake)))
    model = Model.of(runs, TRAIN)
    hyper, _ = model.evidence().maximise()
    locations = locate(model, model, hyper)
    axes = {'position, rising', 'speed', 'mode', 'direction', 'tunnel', 'curve', 'heat of the brake'}
    assert axes <= {location.axis for location in locations}
    for axis, places in ((location.axis, location.places) for location in locations if location.axis != 'run'):
        assert not [place for place in places if place_text(axis, place.label) == f'{axis} {place.label}']


HYPER = Hyperparameters(Noise(0.02, 0.05, 8.0, 0.02), Spread(0.005, 0.01, 0.2), 0.0)


def test_subtraction_equals_a_fit_without_the_run(dragged_model: Model) -> None:
    model = dragged_model
    held = hold_out(model, HYPER)
    assert held is not None
    others = model.dataset.point_run != 1
    columns = model.white_columns(HYPER)[others]
    total = columns.T @ columns
    model.add_odometry(total)
    mean, _ = posterior(total, model.prior_factor(HYPER.spread))
    columns = model.nuisance_columns[~others]
    fitted = model.residual[~others] - columns @ mean
    known = model.dataset.point_count[~others] > 0.0
    np.testing.assert_allclose(held.fitted[~others], fitted - fitted[known].mean(), atol=1e-9)
    # A train file states a, b, c, but none of the other nuisances; the simulation starts at the measured speed.
    written = model.residual[~others] - columns[:, DAVIS] @ mean[DAVIS]
    np.testing.assert_allclose(held.gap[~others], written - written[0], atol=1e-9)


def test_likelihood_of_held_out_runs_is_that_of_the_kalman_filter(dragged_model: Model) -> None:
    models = dragged_model, dragged_model.with_terms((local_drag(100.0, 350.0, 2.5),))
    held = [hold_out(model, HYPER) for model in models]
    without, added = (one.likelihood for one in held if one is not None)
    # The determinants of the noise alone are equal for both models.
    assert added - without == pytest.approx(filtered(models[1]) - filtered(models[0]), rel=0.01)


def test_an_effect_that_held_out_runs_do_not_show_is_the_weakest(dragged_model: Model) -> None:
    true, absent = local_drag(100.0, 350.0, 2.5), local_drag(600.0, 900.0, 0.1)  # as far as the std says, certain

    def outcome(*terms: EffectTerm) -> Outcome:
        final = dragged_model.with_terms(terms)
        gap = read_gap(dragged_model)
        return Outcome(Verdict.EXPLAINED, '', HYPER, dragged_model, final, terms, TRAIN.resistance, gap, None, None)

    assert weakest(outcome(true, absent)) == 1
    assert weakest(outcome(absent, true)) == 0
    assert weakest(outcome(true)) is None
    assert weakest(replace(outcome(true, absent), verdict=Verdict.UNEXPLAINED)) is None


def filtered(model: Model) -> float:
    """Return 2 ln of the likelihood of all runs held out, up to a constant, from whitened columns."""
    neutral, stated = np.eye(model.columns.shape[1]), ~model.without_terms
    stated[DAVIS] = True
    for term, here in model.places():
        neutral[1 + here.start + term.index('permille'), 0] = term.amount
    products = model.products_by_run(model.columns @ neutral, HYPER)
    prior = model.prior_factor(HYPER.spread)
    total = 0.0
    for own in products:
        mean, covariance = posterior(products.sum(axis=0) - own, prior)
        known = np.eye(len(own))
        known[1:, 0] = -np.where(stated, mean, 0.0)
        root = np.where(np.outer(~stated, ~stated), prior, 0.0)
        root[np.ix_(stated, stated)] = np.linalg.cholesky(covariance[np.ix_(stated, stated)])
        found = eliminate(known.T @ own @ known, root)
        total -= found.yy + found.log_det
    return total


def test_gap_of_the_file_counts_what_a_fit_absorbs() -> None:
    """A mass that is 5 % wrong hides in the payload of each run when nuisances are fitted, not in the file."""
    truth = replace(TRAIN, train=replace(TRAIN.train, mass=TRAIN.train.mass))
    runs = [replace(run, traction=1.05 * run.traction, brake=1.05 * run.brake) for run in Maker().runs(6, 5)]
    model = Model.of(runs, truth)
    held = hold_out(model, replace(HYPER, spread=replace(HYPER.spread, payload=0.05)))
    gap = gap_of(read_gap(model), held, held, model)
    assert gap is not None
    assert gap.fitted_before < 0.3 * gap.before


def test_bursts_of_slip_count_in_the_file_read_alone(dragged_model: Model) -> None:
    held = hold_out(dragged_model, HYPER)
    without, gap = (gap_of(read_gap(dragged_model), held, held, dragged_model, bursts) for bursts in (0.0, 4.0))
    assert gap is not None
    assert without is not None
    assert gap.before == pytest.approx(np.hypot(without.before, 2.0))
    assert replace(gap, before=without.before) == without


def test_the_gap_expected_of_strong_gusts_is_proportional_to_them(dragged_model: Model) -> None:
    weak, strong = (
        hold_out(dragged_model, replace(HYPER, noise=replace(HYPER.noise, gust=gust))) for gust in (5.0, 10.0)
    )
    assert weak is not None
    assert strong is not None
    assert np.sqrt(np.mean(strong.std**2) / np.mean(weak.std**2)) == pytest.approx(2.0, rel=0.05)


def test_the_gap_shrinks_to_the_noise(dragged_model: Model) -> None:
    model = dragged_model
    added = model.with_terms((local_drag(120.0, 330.0, 1.5),)).fit(HYPER)
    gap = gap_of(read_gap(model), hold_out(model, HYPER), hold_out(added, HYPER), added)
    assert gap is not None
    assert gap.after < 0.6 * gap.before
    assert gap.fitted_after < 0.6 * gap.fitted_before
    assert gap.after < 1.1 * gap.noise_floor
    assert gap.evidence > SHOWN
    assert gap.runs_held_out == 6
    found, std = added.terms[0].parameters, added.terms[0].std
    assert abs(found['permille'] - 2.5) < 4.0 * std['permille']
    assert abs(found['start'] - 100.0) < 4.0 * std['start']


def test_one_run_cannot_be_held_out() -> None:
    alone = Model.of(Maker().runs(1, 3), TRAIN)
    assert hold_out(alone, HYPER) is None
    assert gap_of(read_gap(alone), None, None, alone) is None


def test_effect_in_the_held_out_run_only_does_not_reduce_its_gap() -> None:
    runs = [*Maker().runs(4, 31), *Maker().runs(5, 32, drag(4.0))[4:]]
    model = Model.of(runs, TRAIN)
    seen = [replace(run, position=run.position + 1e4 * (k < 4)) for k, run in enumerate(runs)]
    apart = Model.of(seen, TRAIN)
    last = apart.dataset.point_run == 4
    for one, same_place in ((model, True), (apart, False)):
        added = one.with_terms((local_drag(100.0, 350.0, 4.0),)).fit(HYPER)
        held, without = hold_out(added, HYPER), hold_out(one, HYPER)
        assert held is not None
        assert without is not None
        # If the other runs pass the place, they show no effect there; otherwise they give no information.
        before, after = np.std(without.gap[last]), np.std(held.gap[last])
        assert after > 0.8 * before, same_place


def test_noise_floor_of_a_true_model_is_its_gap_whatever_the_priors() -> None:
    model, noise = Model.of(Maker().runs(8, 5), TRAIN), Noise(0.02, 0.002, 8.0, 0.001)  # no gusts, as made
    for payload in (0.005, 0.05):  # of trains weighed, and ten times that
        held = hold_out(model, Hyperparameters(noise, Spread(payload, 2.0 * payload, 0.2), 0.0))
        gap = gap_of(read_gap(model), held, held, model)
        assert gap is not None
        assert gap.after == pytest.approx(gap.noise_floor, rel=0.15), payload


def test_noise_floor_does_not_count_what_neither_loads_nor_maps_cause() -> None:
    model = Model.of(Maker().runs(6, 31, drag(4.0)), TRAIN)
    held = hold_out(model, HYPER)
    gap = gap_of(read_gap(model), held, held, model)
    assert gap is not None
    assert gap.noise_floor < 0.8 * gap.after


def test_noise_floor_excludes_the_uncertainty_of_effects(dragged_model: Model) -> None:
    terms = local_drag(100.0, 350.0, 2.5), local_drag(1e4, 1.1e4, 2.5)
    added, unseen = (dragged_model.with_terms((term,)).fit(HYPER) for term in terms)
    floors = [hold_out(one, HYPER) for one in (dragged_model, added, unseen)]
    floor_means = [float(np.mean(floor.std)) for floor in floors if floor is not None]
    assert floor_means[2] == pytest.approx(floor_means[0], rel=0.15)
    # Without the drag, errors of the map that are as large as it belong to the floor.
    assert floor_means[1] < 0.8 * floor_means[0]
