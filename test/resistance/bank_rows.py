# SPDX-License-Identifier: Apache-2.0
"""The hypotheses of a bank as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trainid_ros.resistance.hypotheses import STATES, Bank, SpeedFilter

Array = NDArray[np.float64]


def covariance(one: SpeedFilter) -> Array:
    """Return the covariance of a filter, shape (9, 9)."""
    P = np.zeros((STATES, STATES))
    P[np.triu_indices(STATES)] = list(one.P)
    return np.asarray(P + np.triu(P, 1).T)


@dataclass
class BankRows:
    """One row for each hypothesis: mean, covariance, log weight, age [s], and index of the disturbance sizes."""

    x: Array
    P: Array
    log_weight: Array
    age: Array
    size: Array
    since_s: float = 0.0
    branchings: int = 0

    @staticmethod
    def of(bank: Bank) -> BankRows:
        """Return those of a bank, as copies."""
        items = bank.hypotheses
        return BankRows(
            x=np.array([list(item.filter.x) for item in items]),
            P=np.array([covariance(item.filter) for item in items]),
            log_weight=np.array([item.log_weight for item in items]),
            age=np.array([item.age for item in items]),
            size=np.array([item.size for item in items]),
            since_s=bank.since_s,
            branchings=bank.branchings,
        )

    def put(self, bank: Bank) -> None:
        """Let a bank continue from these."""
        rows = zip(self.x, self.P, self.log_weight.tolist(), self.age.tolist(), self.size.tolist(), strict=True)
        bank.hypotheses = [bank._new(x, P, log_weight, age, int(size)) for x, P, log_weight, age, size in rows]
        bank.since_s, bank.branchings = self.since_s, self.branchings

    @staticmethod
    @contextmanager
    def changed(bank: Bank) -> Iterator[BankRows]:
        """Give the rows of a bank to change; the bank continues from them."""
        state = BankRows.of(bank)
        yield state
        state.put(bank)
