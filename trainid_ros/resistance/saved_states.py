# SPDX-License-Identifier: Apache-2.0
"""Saved states of the resistance estimators, and whether a restored one is possible.

This module is not compiled: the types of the items of tuples are read from its classes when a state is restored.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trainid_ros.resistance.davis_posterior import DrivenSpeeds
from trainid_ros.resistance.normal import Inflation, SlowNoise
from trainid_ros.resistance.speed_states import STATES, Tick, V
from trainid_ros.resistance.speed_window import WindowTick
from trainid_ros.state import check_not_negative, check_numbers, check_restored, is_covariance_matrix
from trainid_ros.stream.known_force import SpeedNoise

Array = NDArray[np.float64]

MAX_EVIDENCE: Final = 300.0
"""Limit of the log Bayes factor, far beyond any decision threshold."""
MAX_STRIDE: Final = 50
"""Maximum number of samples in a step of the traction interpolation."""
# Two steps ahead and one behind.
_MAX_TICKS: Final = 4 * MAX_STRIDE
# Forces within the valid range of the records lead to lower speeds; beyond, the filter steps would diverge [m/s].
_MAX_SPEED: Final = 1e5


@dataclass(slots=True)
class BankState:
    """Saved state of the bank, one row per hypothesis."""

    x: Array  # Means, shape (n, 9)
    P: Array  # Covariances, shape (n, 9, 9)
    log_weight: Array  # Logarithms of the weights, normalised to a maximum of 0, shape (n,)
    age: Array  # Driving time since it branched off [s], shape (n,)
    size: Array  # Index of the sizes of gusts and map errors, shape (n,)
    since_s: float = 0.0  # Driving time since the last branching [s]
    branchings: int = 0  # Number of branchings

    def is_valid(self, sizes: int) -> bool:
        """Return whether this is a possible state of a bank with this number of disturbance sizes."""
        n = self.log_weight.size
        sized = self.x.shape == (n, STATES) and self.P.shape == (n, STATES, STATES)
        if not (n and sized and self.log_weight.shape == self.age.shape == self.size.shape == (n,)):
            return False
        indexed = bool(np.isin(self.size, np.arange(sizes)).all())
        weighed = bool((self.log_weight <= 0.0).all() and self.log_weight.max() == 0.0 and (self.age >= 0.0).all())
        slow = bool((np.abs(self.x[:, V]) < _MAX_SPEED).all())
        counted = self.since_s >= 0.0 and self.branchings >= 0
        return indexed and weighed and slow and counted and all(map(is_covariance_matrix, self.P))


@dataclass(frozen=True, slots=True)
class FilterBankState:
    """Saved state of the filter bank."""

    bank: BankState
    tachometer: SpeedNoise
    inflation: Inflation
    ticks: tuple[Tick, ...]
    driven: DrivenSpeeds
    running: bool
    stopped: bool
    stride: int
    rejected_s: float
    braked_ns: int
    advanced_ns: int
    innovation: float
    innovation_variance: float
    test_ratio: float
    converged: bool

    def check(self, sizes: int) -> None:
        """Raise InputError unless this is a possible state with this number of disturbance sizes."""
        kind = 'FilterBankState'
        check_numbers(self, may_be_nan=('dt',))  # of the tachometer, after a gap
        check_restored(self.bank.is_valid(sizes), kind, 'bank')
        check_restored(self.tachometer.is_valid(), kind, 'tachometer')
        check_restored(self.inflation.is_valid(), kind, 'inflation')
        check_restored(self.driven.is_valid(), kind, 'driven')
        few = len(self.ticks) <= _MAX_TICKS and 0 < self.stride <= MAX_STRIDE
        check_restored(few and all(map(_is_valid, self.ticks)), kind, 'ticks')
        check_not_negative(
            kind,
            rejected_s=self.rejected_s,
            innovation_variance=self.innovation_variance,
            test_ratio=self.test_ratio,
        )


def _is_valid(tick: Tick) -> bool:
    return tick.dt > 0.0 and 0.0 <= tick.speed < _MAX_SPEED and tick.variance > 0.0 and tick.force_interval >= 0.0


@dataclass(frozen=True, slots=True)
class RunLengthState:
    """Saved state of a hypothesis: the n entries of theta and the n^2 entries of P, row by row."""

    theta: tuple[float, ...]
    P: tuple[float, ...]
    evidence: float
    age: int

    def is_valid(self, n: int) -> bool:
        """Return whether the numbers, which must be finite, fit n parameters and lie within their bounds."""
        sized = len(self.theta) == n and len(self.P) == n * n
        return (
            sized
            and is_covariance_matrix(np.array(self.P).reshape(n, n))
            and self.evidence <= MAX_EVIDENCE
            and self.age >= 0
        )


@dataclass(frozen=True, slots=True)
class ChangePointState:
    """Saved state of a tracker; ``memory`` and each of ``parts`` are information, n (n + 1) numbers row by row."""

    memory: tuple[float, ...]  # Information of the long memory
    parts: tuple[tuple[float, ...], ...]  # Information that each of the last p observations adds at a step
    hypotheses: tuple[RunLengthState, ...]  # Run-length hypotheses, oldest first
    rows: tuple[tuple[float, ...], ...]  # Latest observations: phi, y, R, slow
    mean_weight: float  # Recent mean weight of the observations [1]
    count: int  # Number of observations
    steps_found: int  # Number of detected steps

    def is_valid(self, n: int) -> bool:
        """Return whether all numbers, which must be finite, fit n parameters and lie within their bounds."""
        size = n * (n + 1)
        if not all(len(item) == size for item in (self.memory, *self.parts)):
            return False
        information = _information(self.memory, n)
        after = sum((_information(part, n) for part in self.parts), information)
        definite = is_definite(information) and is_definite(after)
        # (phi, y, R, slow)
        observed = all(len(row) == n + 3 and min(row[-2:]) > 0.0 for row in self.rows)
        counted = 0.0 <= self.mean_weight <= 1.0 and self.count >= 0
        return definite and observed and counted and all(item.is_valid(n) for item in self.hypotheses)


@dataclass(frozen=True, slots=True)
class LearnerState:
    """Saved state of a learner and its tracker."""

    tracker: ChangePointState
    tachometer: SpeedNoise
    slow: SlowNoise
    inflation: Inflation
    ticks: tuple[WindowTick, ...]
    fresh_s: float
    disturbance_variance: float
    innovation: float
    innovation_variance: float
    test_ratio: float
    driven: DrivenSpeeds

    def check(self, parameters: int) -> None:
        """Raise InputError unless the state is valid for this number of parameters; all numbers must be finite."""
        check_restored(self.tracker.is_valid(parameters), 'LearnerState', 'tracker')
        check_restored(self.tachometer.is_valid(), 'LearnerState', 'tachometer')
        check_restored(self.slow.is_valid(), 'LearnerState', 'slow')
        check_restored(self.inflation.is_valid(), 'LearnerState', 'inflation')
        check_restored(self.driven.is_valid(), 'LearnerState', 'driven')
        check_restored(all(tick.dt > 0.0 for tick in self.ticks), 'LearnerState', 'ticks')
        check_not_negative(
            'LearnerState',
            fresh_s=self.fresh_s,
            disturbance_variance=self.disturbance_variance,
            innovation_variance=self.innovation_variance,
            test_ratio=self.test_ratio,
        )


@dataclass(frozen=True, slots=True)
class VMilsState:
    """Saved state of V-MILS; tuples only, so that it can be saved as JSON."""

    learner: LearnerState
    stamp_ns: int
    drifted_ns: int
    judged_ns: int
    braked_ns: int
    standing: bool
    converged: bool

    def check(self, parameters: int) -> None:
        """Raise InputError unless this is a possible state with this number of parameters."""
        check_numbers(self, may_be_nan=('dt',))  # of the tachometer, after a gap
        self.learner.check(parameters)


def is_definite(information: Array) -> bool:
    """Return whether P^-1, the left part of an information of shape (n, n + 1), is the inverse of a covariance."""
    inverse, variances = information[:, :-1], information.diagonal()
    if not bool((variances > 0.0).all()):
        return False
    scale = 1.0 / np.sqrt(variances)
    correlations = scale[:, None] * inverse * scale
    symmetric = np.allclose(correlations, correlations.T, rtol=0.0, atol=1e-6)
    return bool(symmetric and np.linalg.eigvalsh(correlations)[0] > 0.0)


def _information(numbers: tuple[float, ...], n: int) -> Array:
    return np.array(numbers).reshape(n, n + 1)
