# SPDX-License-Identifier: Apache-2.0
"""The published covariance grows where predictions are worse than stated, and never shrinks below the model's."""

from __future__ import annotations

import numpy as np
import pytest

from trainid_ros.resistance.inflation import Inflation


def inflation(std: float, rho: float = 0.0, seed: int = 1) -> list[float]:
    """Return the factors under innovations of unit stated variance."""
    rng, item, x, found = np.random.default_rng(seed), Inflation(), 0.0, []
    for _ in range(20_000):
        x = rho * x + (1.0 - rho * rho) ** 0.5 * float(rng.standard_normal())
        item.add(std * x, 1.0, 1.2)
        found.append(item.factor)
    return found


def test_true_variances_leave_the_covariance_nearly_alone() -> None:
    found = inflation(1.0)
    assert min(found) == 1.0
    # A mean of about 15 squares scatters by a third.
    assert np.mean(found) < 1.25


def test_it_counts_errors_that_are_too_large_and_such_that_are_correlated() -> None:
    assert np.mean(inflation(2.0)) == pytest.approx(3.6, rel=0.2)  # 4 less what one batch may say at most
    assert np.mean(inflation(1.0, rho=0.5)) == pytest.approx(3.0, rel=0.2)  # (1 + rho) / (1 - rho)


def test_one_batch_says_no_more_than_its_share() -> None:
    item = Inflation()
    for _ in range(40):
        item.add(1e6, 1.0, 1.2)
    assert item.factor == pytest.approx(2.0)
    assert item.is_valid()


@pytest.mark.parametrize('wrong', [Inflation(ratio=0.0), Inflation(variance=-1.0), Inflation(length=48.0)])
def test_an_unsound_state_shows(wrong: Inflation) -> None:
    assert not wrong.is_valid()
