# SPDX-License-Identifier: Apache-2.0
"""Columns of named effects and of generic dependences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.explain.dataset import Dataset
from trainid_ros.explain.effect_evaluation import EffectEvaluator
from trainid_ros.explain.families import SECTIONS, _shapes, named_families, sign
from trainid_ros.explain.generic import generic_groups
from trainid_ros.train.effects import EFFECTS, EffectKind, Parameter
from trainid_ros.train.train_file import TrainFile


def test_families_are_columns_of_effects_that_act_in_the_data(dataset: Dataset, train_file: TrainFile) -> None:
    evaluator = EffectEvaluator(dataset, train_file)
    families = {family.name: family for family in named_families(evaluator)}
    assert {'traction_scale', 'resistance_step', 'bearing_warmup'} <= families.keys()
    # There is no curve and no tunnel, sections are scanned separately, and slip is no resistance.
    assert not {'curve_resistance', 'tunnel_drag', 'wheel_slip', *SECTIONS} & families.keys()
    for family in families.values():
        assert family.resistance.shape == (dataset.dt.size, len(family.shapes))
        assert np.isfinite(family.resistance).all()
        assert family.std > 0.0
    stronger = evaluator.resistance('traction_scale', {'ratio': 1.3})
    np.testing.assert_allclose(0.3 * families['traction_scale'].resistance[:, 0], stronger, atol=1e-9)


def test_non_linear_effect_is_tried_at_several_amplitudes(dataset: Dataset, train_file: TrainFile) -> None:
    evaluator = EffectEvaluator(dataset, train_file)
    families = {family.name: family for family in named_families(evaluator)}
    assert families['traction_scale'].resistance.shape[1] == 1
    # Shifts of the map in opposite directions lead to different gradients.
    shifts = families['map_shift'].resistance
    assert shifts.shape[1] == len(families['map_shift'].shapes) > 1
    usual = EFFECTS['map_shift'].usual
    np.testing.assert_allclose(-usual * shifts[:, 1], evaluator.resistance('map_shift', {'distance': -usual}))


def test_onset_times_leave_enough_driving_before_and_after(dataset: Dataset, train_file: TrainFile) -> None:
    families = {family.name: family for family in named_families(EffectEvaluator(dataset, train_file))}
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


@pytest.mark.parametrize(('name', 'side'), [('local_drag', 1), ('gradient_error', 0), ('brake_fade', 1)])
def test_sign_of_amplitudes(name: str, side: int) -> None:
    assert sign(EFFECTS[name]) == side


def test_groups_are_finite_with_unique_names(dataset: Dataset) -> None:
    groups = generic_groups(dataset, 100.0)
    assert len({group.name for group in groups}) == len({group.text for group in groups}) == len(groups)
    for group in groups:
        assert group.resistance.shape[0] == dataset.dt.size
        assert np.isfinite(group.resistance).all()
    columns = {group.name: group.resistance for group in groups}
    for name in ('run', 'place', 'time', 'speed'):
        np.testing.assert_allclose(columns[name].sum(axis=1), 1.0)
