# SPDX-License-Identifier: Apache-2.0
"""Effects that are believed already and found once more."""

from __future__ import annotations

from dataclasses import replace

import pytest

from trainid_ros.explain.believed_effects import together, without_replaced
from trainid_ros.explain.model import EffectTerm
from trainid_ros.train.effect_text import parse_effects
from trainid_ros.train.train_file import TrainFile

DRAG = 'local_drag:start=0,end=9,permille=1'


def test_an_effect_found_once_more_is_believed_no_longer(believed: TrainFile) -> None:
    file = replace(believed, effects=parse_effects(['brake_delay:extra=0.5', DRAG, 'wheel_diameter:ratio=1.02']))
    rest = without_replaced((EffectTerm('brake_delay', {'extra': 0.4}),), file)
    assert rest is not None
    assert [effect.name for effect in rest.effects] == ['local_drag', 'wheel_diameter']


@pytest.mark.parametrize('name', ['headwind', 'local_drag', 'wheel_diameter'])
def test_what_is_new_or_may_be_there_twice_or_was_taken_out_changes_no_belief(believed: TrainFile, name: str) -> None:
    file = replace(believed, effects=parse_effects(['brake_delay:extra=0.5', DRAG, 'wheel_diameter:ratio=1.02']))
    assert without_replaced((EffectTerm(name, {}),), file) is None


def test_what_records_show_beside_what_was_taken_out_is_one_effect() -> None:
    before = parse_effects(['wheel_diameter:ratio=1.03', 'stamp_skew:delay=0.2', DRAG])
    further = 'local_drag:start=20,end=29,permille=2'
    added = parse_effects(['wheel_diameter:ratio=1.02', 'stamp_skew:delay=0.3', further])
    whole = together(before, added)
    assert [effect.name for effect in whole] == ['local_drag', 'wheel_diameter', 'stamp_skew', 'local_drag']
    assert dict(whole[1].parameters)['ratio'] == pytest.approx(1.03 * 1.02)
    assert dict(whole[2].parameters)['delay'] == pytest.approx(0.5)


def test_slip_that_was_found_is_all_of_it() -> None:
    before, added = (parse_effects([f'wheel_slip:share={share},speed=2']) for share in (0.05, 0.03))
    assert together(before, added) == added
