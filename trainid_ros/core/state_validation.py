# SPDX-License-Identifier: Apache-2.0
"""Validate the numbers of a saved state: a file that can be read may still hold invalid values."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from _typeshed import DataclassInstance
    from numpy.typing import NDArray

MAX_NUMBER: Final = 1e40
"""Upper bound of all numbers in a state: no quantity of a train, nor the inverse of a variance, comes near it."""
# Rounding errors make a correlation exceed one by less than this.
_ROUNDING: Final = 1e-6
# Variances below the square of this count as zero.
_UNDERFLOW: Final = 1e-140


def check_numbers(state: DataclassInstance, *, may_be_nan: Collection[str] = ()) -> None:
    """Check all numbers of a state, including those in its arrays, tuples and nested dataclasses.

    Args:
        state: The state.
        may_be_nan: Names of fields that are NaN while unknown.

    Raises:
        InputError: A number is not finite or too large; the message names its field.

    """
    for name, values in _numbers(state, ''):
        unknown = np.isnan(values) if name.rpartition('.')[2] in may_be_nan else False
        if not bool(np.all((np.abs(values) < MAX_NUMBER) | unknown)):
            msg = f'saved {type(state).__name__}: {name} is not finite or too large'
            raise InputError(msg)


def _numbers(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if is_dataclass(value):
        for item in fields(value):
            yield from _numbers(getattr(value, item.name), f'{name}.{item.name}' if name else item.name)
    elif isinstance(value, tuple):
        for item in value:
            yield from _numbers(item, name)
    elif isinstance(value, np.ndarray | int | float):
        yield name, value


def check_not_negative(kind: str, **numbers: float) -> None:
    """Raise InputError, naming the first invalid number of a saved ``kind`` of state, unless all are >= 0."""
    for name, value in numbers.items():
        if not value >= 0.0:
            msg = f'saved {kind}: {name} = {value:g} must be >= 0'
            raise InputError(msg)


def is_covariance(upper: Sequence[float]) -> bool:
    """Return True if the upper triangle of a matrix, row by row, is that of a covariance: positive semidefinite.

    Args:
        upper: n (n + 1) / 2 finite numbers.

    """
    n = (math.isqrt(8 * len(upper) + 1) - 1) // 2
    P = np.zeros((n, n))
    P[np.triu_indices(n)] = upper
    return is_covariance_matrix(P + np.triu(P, 1).T)


def is_covariance_matrix(P: NDArray[np.float64]) -> bool:
    """Return True if a matrix of finite numbers, shape (n, n), is a covariance: symmetric, positive semidefinite."""
    variances = np.diag(P)
    # Zero variance implies zero covariance; but a decaying variance underflows before its covariances, which decay
    # half as fast.
    is_zero = variances < _UNDERFLOW**2
    if bool((variances < 0.0).any() or (np.abs(P[is_zero]) > _UNDERFLOW).any()):
        return False
    # Variances differ by decades, so the correlation matrix is checked.
    scale = 1.0 / np.sqrt(np.where(is_zero, 1.0, variances))
    correlations = scale[:, None] * P * scale
    symmetric = bool((np.abs(correlations - correlations.T) < _ROUNDING).all())
    return symmetric and float(np.linalg.eigvalsh(correlations)[0]) >= -_ROUNDING
