# SPDX-License-Identifier: Apache-2.0
"""Effects of some runs are hidden as stated, and a large one is found."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.explain_of_runs import Trial, answer, hidden
from trainid_ros.train.effects import EFFECTS


def test_what_is_hidden() -> None:
    (one,) = hidden(Trial(('mass_error',), 2.0, False, 1), np.random.default_rng(1))
    (amplitude,) = dict(one.parameters).values()
    assert abs(amplitude - 1.0) == pytest.approx(2.0 * EFFECTS['mass_error'].typical_size)
    assert 2 <= len(set(one.runs)) <= 5
    drag, wind = hidden(Trial(('run_drag', 'headwind'), 2.0, False, 1), np.random.default_rng(1))
    assert (drag.name, wind.name) == ('run_drag', 'headwind')
    assert not set(drag.runs) & set(wind.runs)
    scattered = hidden(Trial(('run_drag',), 0.5, True, 1), np.random.default_rng(1))
    assert [effect.runs for effect in scattered] == [(k,) for k in range(1, 13)]


@pytest.mark.long
@pytest.mark.parametrize('kinds', [('mass_error',), ('brake_scale', 'mass_error')])
def test_large_effects_are_found(kinds: tuple[str, ...]) -> None:
    """Wrong mass on some runs acts on their brake too, so it may be taken for traction and brake."""
    assert answer(Trial(kinds, 3.0, False, 5)) == 'right'
