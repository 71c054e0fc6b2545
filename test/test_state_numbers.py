# SPDX-License-Identifier: Apache-2.0
"""Valid states pass, invalid fields are named."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.state import check_not_negative, check_numbers, is_covariance, is_covariance_matrix


@dataclass(frozen=True, slots=True)
class Inner:
    value: float
    dt: float = math.nan


@dataclass(frozen=True, slots=True)
class State:
    many: tuple[Inner, ...] = (Inner(1.0), Inner(2.0))
    array: NDArray[np.float64] | None = None
    count: int = 3
    text: str = 'nan'


def test_numbers_in_all_nested_parts_are_checked() -> None:
    check_numbers(State(array=np.ones((2, 3))), may_be_nan=('dt',))
    with pytest.raises(InputError, match=r'saved State: many\.dt is not finite'):
        check_numbers(State())


@pytest.mark.parametrize('wrong', [math.nan, math.inf, -math.inf, 1e308, -1e41])
def test_a_number_that_is_not_finite_or_too_large_is_named(wrong: float) -> None:
    for state, name in (
        (State((Inner(1.0), Inner(wrong))), r'many\.value'),
        (State(array=np.array([0.0, wrong])), 'array'),
    ):
        with pytest.raises(InputError, match=rf'saved State: {name} is not finite or too large'):
            check_numbers(state, may_be_nan=('dt',))


def test_only_nan_counts_as_unknown() -> None:
    with pytest.raises(InputError, match='dt'):
        check_numbers(Inner(1.0, math.inf), may_be_nan=('dt',))


@pytest.mark.parametrize('wrong', [-1e-300, math.nan, -math.inf])
def test_a_negative_number_is_named_with_its_value(wrong: float) -> None:
    check_not_negative('State', variance=0.0, share=1.0)
    with pytest.raises(InputError, match=r'saved State: share = -?(1e-300|nan|inf) must be >= 0'):
        check_not_negative('State', variance=0.0, share=wrong)


def test_covariances_are_distinguished_from_other_matrices_at_any_scale() -> None:
    rng = np.random.default_rng(51)
    scale = np.array([1.0, 1e-3, 1e-7, 1e-9])
    root = scale[:, None] * rng.standard_normal((4, 4))
    upper = (root @ root.T)[np.triu_indices(4)]
    assert is_covariance(upper.tolist())
    assert is_covariance([0.0] * 10)
    for k in range(10):
        wrong = upper.copy()
        wrong[k] = -wrong[k] if k in {0, 4, 7, 9} else 1.01 * math.copysign(1.0, wrong[k])
        assert not is_covariance(wrong.tolist()), k


def test_zero_variance_implies_zero_covariance_and_a_covariance_is_symmetric() -> None:
    assert is_covariance([1.0, 0.0, 0.0])
    assert not is_covariance([1.0, 1e-9, 0.0])
    # Variance and covariance have decayed, the covariance half as fast.
    assert is_covariance([1.0, 1e-170, 0.0])
    assert is_covariance([1.0, 1e-155, 1e-310])
    assert is_covariance_matrix(np.array([[1.0, 0.5], [0.5, 1.0]]))
    assert not is_covariance_matrix(np.array([[1.0, 0.5], [-0.5, 1.0]]))
