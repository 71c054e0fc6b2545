# SPDX-License-Identifier: Apache-2.0
"""Effects in the model: their inputs along a run, evaluation, and merging with those that the train file lists."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from test.explain.made_runs import TRAIN, Maker, local_drag
from trainid_ros.explain.dataset import Dataset, assemble
from trainid_ros.explain.effects import EffectEvaluator, EffectTerm, merged, prior_cost, track_points, without_replaced
from trainid_ros.interface.errors import InputError
from trainid_ros.train.effects import EFFECTS, TrackPoint, parse_effects
from trainid_ros.train.forces import specific_inertia

DRAG = 'local_drag:start=0,end=200,permille=1'


@pytest.fixture(scope='module')
def evaluator() -> EffectEvaluator:
    return EffectEvaluator(assemble(Maker(noise=0.0).runs(2, 5), TRAIN), TRAIN)


def test_shifted_map_acts_where_the_gradient_changes(evaluator: EffectEvaluator) -> None:
    """The hill of 5 per mille is from 300 to 600 m; a shift of 40 m gives -5 at its start and +5 beyond its end."""
    dataset = evaluator.dataset
    w = evaluator.resistance('map_shift', {'distance': 40.0})
    position, up = dataset.joined('position'), dataset.direction > 0
    position = position - 0.5 * dataset.direction * dataset.dt * dataset.speed
    inner = up & (position > 306.0) & (position < 334.0)
    assert inner.sum() > 4
    np.testing.assert_allclose(w[inner], -5.0)
    np.testing.assert_allclose(w[up & (position > 606.0) & (position < 634.0)], 5.0)
    # Downhill in the other direction.
    back = ~up & (position < 594.0) & (position > 566.0)
    np.testing.assert_allclose(w[back], 5.0)
    assert not w[(position < 250.0) & (position > 0.0) & up].any()


def test_late_stamps_act_where_the_force_changes(evaluator: EffectEvaluator) -> None:
    dataset = evaluator.dataset
    traction = dataset.joined('traction')
    w = evaluator.resistance('stamp_skew', {'delay': 0.4})
    off = int(np.flatnonzero(np.diff(traction) < -20.0)[0]) + 1
    assert w[off - 1] > 20.0  # the traction acting here has a stamp after it is off
    assert abs(w[off + 3]) < 1e-9
    assert (np.abs(w) > 10.0).sum() <= 8


def test_effects_that_depend_on_distance_or_brake_release(evaluator: EffectEvaluator) -> None:
    dataset = evaluator.dataset
    w = evaluator.resistance('bearing_warmup', {'value': 2.0, 'distance': 500.0})
    assert w[0] == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose(w, 2.0 * np.exp(-dataset.joined('distance_run') / 500.0), atol=1e-6)
    drag = evaluator.resistance('dragging_brake', {'permille': 3.0, 'time': 5.0})
    since = dataset.joined('since_release')
    assert not drag[~np.isfinite(since)].any()
    released = (since > 0.0) & (since < 4.0)
    np.testing.assert_allclose(drag[released], 3.0)


def test_effects_on_records_are_not_added(evaluator: EffectEvaluator) -> None:
    total = evaluator.total(parse_effects([DRAG, 'stamp_skew:delay=0.3', 'wheel_diameter:ratio=1.02']))
    np.testing.assert_array_equal(total, evaluator.resistance('local_drag', local_drag(0.0, 200.0, 1.0).parameters))


def test_amplitudes_of_a_linear_effect_share_one_evaluation(evaluator: EffectEvaluator) -> None:
    slow, fast = (evaluator.resistance('brake_scale', {'ratio': ratio}) for ratio in (0.9, 1.2))
    np.testing.assert_allclose(slow, 0.1 * evaluator.dataset.joined('brake'), atol=1e-12)
    np.testing.assert_allclose(fast, -2.0 * slow, atol=1e-12)


def test_headwind_acts_through_the_davis_c(evaluator: EffectEvaluator) -> None:
    davis = evaluator.davis
    by_c = evaluator.by_davis('headwind', {'speed': 5.0}, davis)
    assert by_c is not None
    np.testing.assert_allclose(davis.c * by_c[:, 2], evaluator.resistance('headwind', {'speed': 5.0}), atol=1e-9)
    assert not by_c[:, :2].any()
    assert evaluator.by_davis('local_drag', {'start': 0.0, 'end': 99.0, 'permille': 2.0}, davis) is None


@pytest.mark.parametrize(('value', 'what'), [('math.nan', 'not finite'), ('math.sqrt(-1.0)', 'math domain error')])
def test_error_names_the_failing_user_effect(
    evaluator: EffectEvaluator, user_effect: Callable[[str, str, str], None], value: str, what: str
) -> None:
    user_effect('wrong', "{'value': Parameter('N/kN', 0.0, 20.0)}", value)
    with pytest.raises(InputError, match=f'effect wrong: .*value=1.*{what}|effect wrong: .*{what}.*value=1'):
        evaluator.resistance('wrong', {'value': 1.0})


def test_the_prior_is_normal_in_the_amplitude_and_uniform_in_the_place(dataset: Dataset) -> None:
    kind = EFFECTS['mass_error']
    term = EffectTerm('mass_error', {'ratio': kind.neutral + 9.0 * kind.typical_size})  # three of its prior std
    assert prior_cost(term, dataset) == pytest.approx(9.0 + 2.0 * math.log(3.0))  # narrower ones have no part in it
    typical = EffectTerm('mass_error', {'ratio': kind.neutral + kind.typical_size})
    mixed = np.mean([3.0 / std * math.exp(-0.5 / std**2) for std in (0.3, 1.0, 3.0)])
    assert prior_cost(typical, dataset) == pytest.approx(-2.0 * math.log(mixed))
    assert term.std == {}  # before a fit
    share = np.ptp(dataset.joined('position')) / (math.sqrt(2.0 * math.pi) * 80.0)
    assert share > 2.0
    drag = EffectTerm('local_drag', local_drag(0.0, 200.0, 0.0).parameters)
    nothing = -2.0 * math.log(2.0 * (10.0 + 3.0 + 1.0) / 3.0)  # a drag has one sign
    assert prior_cost(drag, dataset) == pytest.approx(2.0 * 2.0 * math.log(share) + nothing)


def test_a_parameter_beyond_its_range_is_less_probable(dataset: Dataset) -> None:
    inside, beyond = (EffectTerm('brake_fade', {'energy': energy, 'loss': 0.1}) for energy in (30.0, 10.0))
    assert prior_cost(beyond, dataset) > prior_cost(inside, dataset) + 3.0


def test_effect_found_again_is_removed_from_the_train_file() -> None:
    """But not one that is new, repeatable or corrected on the records."""
    file = replace(TRAIN, effects=parse_effects(['brake_delay:extra=0.5', DRAG, 'wheel_diameter:ratio=1.02']))
    rest = without_replaced((EffectTerm('brake_delay', {'extra': 0.4}),), file)
    assert rest is not None
    assert [effect.name for effect in rest.effects] == ['local_drag', 'wheel_diameter']
    for name in ('headwind', 'local_drag', 'wheel_diameter'):
        assert without_replaced((EffectTerm(name, {}),), file) is None


def test_effect_on_records_is_combined_with_its_correction() -> None:
    before = parse_effects(['wheel_diameter:ratio=1.03', 'stamp_skew:delay=0.2', DRAG])
    added = parse_effects(
        ['wheel_diameter:ratio=1.02', 'stamp_skew:delay=0.3', 'local_drag:start=20,end=29,permille=2']
    )
    effects = merged(before, added)
    assert [effect.name for effect in effects] == ['local_drag', 'wheel_diameter', 'stamp_skew', 'local_drag']
    assert dict(effects[1].parameters)['ratio'] == pytest.approx(1.03 * 1.02)
    assert dict(effects[2].parameters)['delay'] == pytest.approx(0.5)
    # Records are never corrected for slip.
    before, added = (parse_effects([f'wheel_slip:share={share},speed=2']) for share in (0.05, 0.03))
    assert merged(before, added) == added


Points = tuple[Any, list[TrackPoint]]


@pytest.fixture(scope='module', params=[0, 1], ids=['rising', 'falling'])
def run_and_points(request: pytest.FixtureRequest) -> Points:
    run = Maker(noise=0.0).runs(2, 5)[request.param]
    inertia = specific_inertia(1.0, TRAIN.train.rotary_mass)
    speed = np.concatenate([run.speed[:1], 0.5 * (run.speed[1:] + run.speed[:-1])])
    return run, track_points(run, speed, TRAIN.train.length, inertia, TRAIN.resistance)


def test_points_lie_at_mid_stage(run_and_points: Points) -> None:
    run, points = run_and_points
    middle = 0.5 * (run.time[1:] + run.time[:-1])
    np.testing.assert_allclose([p.time_s for p in points[1:]], middle)
    place = np.interp(middle, run.time, run.position)
    np.testing.assert_allclose([p.position for p in points[1:]], place, atol=0.05)
    assert {p.direction for p in points} == {run.direction}
    moved = np.diff(run.speed) / run.dt[1:]
    np.testing.assert_allclose([p.acceleration for p in points[1:-1]], moved[:-1], atol=1e-3)


def test_forces_before_and_gradients_ahead_are_interpolated(run_and_points: Points) -> None:
    run, points = run_and_points
    times = np.array([p.time_s for p in points])
    for seconds in (0.0, 0.33, -0.5):
        np.testing.assert_allclose(
            [(p.brake_before(seconds), p.traction_before(seconds)) for p in points],
            np.stack([np.interp(times - seconds, times, force) for force in (run.brake, run.traction)], axis=1),
        )
    way = run.direction * np.array([p.position for p in points])
    ahead = np.interp(way + 40.0, way, run.gradient)
    np.testing.assert_allclose([p.gradient_ahead(40.0) for p in points], ahead, atol=0.01)
