# SPDX-License-Identifier: Apache-2.0
"""Claims about Liu et al. 2018 on fresh seeds in every run; each limit fails by chance in less than 1e-4."""

from __future__ import annotations

import os

import numpy as np
import pytest

from research.papers import coasts as data
from research.papers.liu_errata import errata
from research.papers.liu_streams import PREPARATIONS, Prepared, nees, prepared, spoiled
from research.papers.liu_table1 import dilution, shape

pytestmark = pytest.mark.slow


def fresh(count: int) -> list[int]:
    """Return random seeds; pytest shows them when a test fails."""
    seeds = [int.from_bytes(os.urandom(4)) for _ in range(count)]
    print('seeds', seeds)
    return seeds


def ratio(items: list[Prepared], preparation: int) -> float:
    """Return the error of a preparation over the bound."""
    return data.pooled([item.errors[preparation] for item in items]) / data.pooled([item.bound for item in items])


def test_recursions_equal_their_batch_forms_and_the_printed_one_only_at_the_end() -> None:
    for seed in fresh(3):
        found = errata(seed)
        assert found.exact <= 1e-9
        assert found.weighted <= 1e-6
        assert found.used < 1e-5
        assert max(found.ends, found.middle_half, found.twice_double) < 1e-4
        assert found.middle > 0.01
        # P(0) affects the trace slightly if speeds happen to be similar: .003 on average, at times .02.
        assert np.array(found.trace) == pytest.approx([1.0, 1 / 2, 1 / 4, 1 / 6], rel=0.08)


def test_residuals_fall_with_the_innovation_length_by_dilution_alone() -> None:
    for seed in fresh(3):
        found = shape(seed)
        assert np.all(np.diff(found.penalised) < 0.0)
        assert np.all(np.diff(found.a) > 0.0)
        assert min(found.training) == found.training[0]
    assert dilution() == pytest.approx((1.638, 0.5), abs=0.002)


def test_windows_reach_the_bound_in_gusts_and_segments_are_biased() -> None:
    seeds = fresh(12)
    fixed, fig2 = (PREPARATIONS.index(name) for name in ('11 samples, 50 % overlap, LS', PREPARATIONS[0]))
    still, gusty = ([prepared(seed, data.CoastPlan(gust_std=std)) for seed in seeds] for std in (0.0, 0.3))

    assert ratio(gusty, fixed) < 1.9
    assert ratio(still, fixed) < 12.0
    assert ratio(still, fig2) > 30.0
    assert np.mean([item.bias[1] for item in still]) > 0.15


def test_stream_covariance_is_consistent_for_any_innovation_length() -> None:
    seeds = fresh(10)
    for name in ('RLS', 'MILS'):
        assert 0.15 < np.mean([nees(seed, name) for seed in seeds]) < 4.5


def test_vmils_with_true_flags_skips_bad_data_that_bias_ls() -> None:
    for seed in fresh(2):
        ls, flagged, single, _ = spoiled(seed, '30 % one sign')
        assert ls > 20.0
        assert max(flagged, single) < 6.0
