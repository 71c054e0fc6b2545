# SPDX-License-Identifier: Apache-2.0
"""Effects that the train file lists already and that are found again."""

from __future__ import annotations

from dataclasses import replace

import pytest

from trainid_ros.explain.known_effects import merged, without_replaced
from trainid_ros.explain.model import EffectTerm
from trainid_ros.train.effect_text import parse_effects
from trainid_ros.train.train_file import TrainFile

DRAG = 'local_drag:start=0,end=9,permille=1'


def test_effect_found_again_is_removed_from_the_train_file(train_file: TrainFile) -> None:
    file = replace(train_file, effects=parse_effects(['brake_delay:extra=0.5', DRAG, 'wheel_diameter:ratio=1.02']))
    rest = without_replaced((EffectTerm('brake_delay', {'extra': 0.4}),), file)
    assert rest is not None
    assert [effect.name for effect in rest.effects] == ['local_drag', 'wheel_diameter']


@pytest.mark.parametrize('name', ['headwind', 'local_drag', 'wheel_diameter'])
def test_new_repeatable_or_corrected_effect_removes_none(train_file: TrainFile, name: str) -> None:
    file = replace(train_file, effects=parse_effects(['brake_delay:extra=0.5', DRAG, 'wheel_diameter:ratio=1.02']))
    assert without_replaced((EffectTerm(name, {}),), file) is None


def test_effect_on_records_is_combined_with_its_correction() -> None:
    before = parse_effects(['wheel_diameter:ratio=1.03', 'stamp_skew:delay=0.2', DRAG])
    further = 'local_drag:start=20,end=29,permille=2'
    added = parse_effects(['wheel_diameter:ratio=1.02', 'stamp_skew:delay=0.3', further])
    effects = merged(before, added)
    assert [effect.name for effect in effects] == ['local_drag', 'wheel_diameter', 'stamp_skew', 'local_drag']
    assert dict(effects[1].parameters)['ratio'] == pytest.approx(1.03 * 1.02)
    assert dict(effects[2].parameters)['delay'] == pytest.approx(0.5)


def test_slip_found_replaces_slip_of_the_train_file() -> None:
    before, added = (parse_effects([f'wheel_slip:share={share},speed=2']) for share in (0.05, 0.03))
    assert merged(before, added) == added
