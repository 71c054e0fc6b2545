# SPDX-License-Identifier: Apache-2.0
"""An estimate becomes fit at its limit and stays so a little beyond."""

from __future__ import annotations

import pytest

from trainid_ros.estimators.resistance.fitness import drift_rates, is_fit


@pytest.mark.parametrize(
    ('std', 'was_fit', 'expected'),
    [(0.09, False, True), (0.11, False, False), (0.11, True, True), (0.149, True, True), (0.151, True, False)],
)
def test_the_limit_is_half_as_wide_again_for_what_was_fit(std: float, was_fit: bool, expected: bool) -> None:
    assert is_fit(lambda _: std * std, (3.0, 20.0), 0.1, was_fit=was_fit) is expected


def test_both_ends_and_the_middle_of_the_speeds_count_alike() -> None:
    variances = {2.0: 0.01, 6.0: 0.02, 10.0: 0.03}
    assert is_fit(variances.__getitem__, (2.0, 10.0), 0.02**0.5 + 1e-9, was_fit=False)
    assert not is_fit(variances.__getitem__, (2.0, 10.0), 0.02**0.5 - 1e-9, was_fit=False)


def test_after_an_hour_the_drift_is_its_share_of_the_prior() -> None:
    rates = drift_rates(0.1, (4.0, 1.0, 0.25))
    assert [3600.0 * rate for rate in rates] == pytest.approx([0.04, 0.01, 0.0025])
