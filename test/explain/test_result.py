# SPDX-License-Identifier: Apache-2.0
"""Probabilities of causes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainid_ros.explain.result import NONE, OTHER, Hypothesis, dependence, noise, probabilities
from trainid_ros.train.effects import EFFECTS

NOTHING = Hypothesis((), 0.0)


def shares(*hypotheses: Hypothesis, certain: tuple[str, ...] = ()) -> dict[str, float]:
    return dict(probabilities([NOTHING, *hypotheses], certain).shares)


@given(
    st.lists(
        st.builds(
            Hypothesis,
            st.lists(st.sampled_from(sorted(EFFECTS)), max_size=3, unique=True).map(tuple),
            st.floats(-1e4, 1e4),
            st.sampled_from([-math.inf, -3.0]),
        ),
        max_size=20,
    )
)
def test_they_add_up_to_one_in_falling_order(hypotheses: list[Hypothesis]) -> None:
    found = [p for _, p in probabilities([NOTHING, *hypotheses]).shares]
    assert sum(found) == pytest.approx(1.0)
    assert found == sorted(found, reverse=True)
    assert all(0.0 <= p <= 1.0 for p in found)


def test_without_evidence_nothing_is_missing_and_with_much_of_it_the_effect_is() -> None:
    assert shares(Hypothesis(('headwind',), 0.0))[NONE] > 0.8
    found = shares(Hypothesis(('headwind',), 40.0), Hypothesis(('tunnel_drag',), 38.0))
    # Their odds are those of their evidence, tempered.
    assert found['headwind'] / found['tunnel_drag'] == pytest.approx(math.exp(1.0 / 1.2))
    assert found[NONE] < 1e-3
    even = shares(Hypothesis(('headwind',), 0.0))
    assert even[NONE] / even['headwind'] == pytest.approx(math.exp(-1.1) * len(EFFECTS))


def test_a_pair_shares_its_probability_and_both_are_present() -> None:
    found = probabilities([NOTHING, Hypothesis(('headwind', 'mass_error'), 400.0), Hypothesis(('headwind',), 100.0)])
    shared = dict(found.shares)
    assert shared['headwind'] == pytest.approx(shared['mass_error'], rel=1e-6)
    assert found.of('headwind') == pytest.approx(2.0 * shared['headwind'], rel=1e-6)
    assert found.of('brake_fade') == 0.0
    assert [found.at_least(count) for count in range(4)] == pytest.approx([1.0, 0.931, 0.931, 0.0], abs=1e-3)


def test_something_else_may_look_like_an_effect_however_strong() -> None:
    assert probabilities([NOTHING, Hypothesis(('headwind',), 1e5)]).other == pytest.approx(0.069, abs=0.001)


def test_a_cause_outside_the_library_may_be_an_illusion_however_strong() -> None:
    found = probabilities([NOTHING, dependence((), 1e5)])
    assert (found.other, dict(found.shares)[NONE]) == pytest.approx((0.8, 0.2), abs=0.003)


def test_number_of_effects_and_other_causes() -> None:
    found = probabilities([NOTHING, Hypothesis(('headwind',), 12.0), dependence(('headwind',), 30.0)])
    assert found.at_least(0) == pytest.approx(1.0)
    assert found.at_least(1) == pytest.approx(found.of('headwind'))
    assert dict(found.shares)[OTHER] < found.other  # it shares with the wind
    assert 0.0 < found.other < 1.0
    assert found.of('headwind') > found.other
    assert probabilities([NOTHING]).other == 0.0


def test_the_same_set_counts_once_by_its_best_fit() -> None:
    one, other = Hypothesis(('headwind', 'mass_error'), 12.0), Hypothesis(('mass_error', 'headwind'), 10.0)
    assert shares(one, other) == shares(one)


def test_a_dependence_without_a_name_or_much_noise_is_another_cause() -> None:
    assert shares(Hypothesis(('mass_error',), 15.0), dependence((), 60.0))[OTHER] > 0.79
    assert shares(Hypothesis(('mass_error',), 60.0), dependence(('mass_error',), 60.0))['mass_error'] > 0.85
    assert shares(noise((), 60.0))[OTHER] > 0.79
    assert shares(noise((), 2.0))[NONE] > 0.9


def test_what_the_records_show_belongs_to_every_set() -> None:
    found = shares(Hypothesis(('headwind',), 60.0), certain=('wheel_slip',))
    assert found['headwind'] < found['wheel_slip'] == pytest.approx(0.5, abs=1e-3)
    assert NONE not in found
