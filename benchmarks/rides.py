# SPDX-License-Identifier: Apache-2.0
"""Rides of all trains in one form: days of the metro of the package's simulator, and drives of the five worlds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from benchmarks.days import assumed_train, simulated_day
from benchmarks.worlds import drive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from trainid_ros.interface.records import Record
    from trainid_ros.train.train_file import TrainFile

    Array = NDArray[np.float64]

DAY: Final = 'Yizhuang days'


class Ride(NamedTuple):
    """A ride.

    Attributes:
        train_file: What the engineer states.
        records: Records in the order of their arrival.
        truths: Returns a, b, c [N/kN, s/m ...], shape (n, 3), and brake rates, shape (n,), at stamps [ns].

    """

    train_file: TrainFile
    records: Iterable[Record]
    truths: Callable[[NDArray[np.int64]], tuple[Array, Array]]


def ride(kind: str, seed: int) -> Ride:
    """Return a day, or a drive of a world with all its unknowns."""
    return _day(seed) if kind == DAY else _drive(kind, seed)


def _day(seed: int) -> Ride:
    day = simulated_day(seed)

    def truths(stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        points = [day.truth.truth_at_ns(int(stamp)) for stamp in stamps_ns]
        davis = np.array([(p.resistance.a, p.resistance.b, p.resistance.c) for p in points])
        return davis, np.array([np.nan if p.brake_rate is None else p.brake_rate for p in points])

    return Ride(assumed_train(), day.records, truths)


def _drive(world: str, seed: int) -> Ride:
    found = drive(world, seed)
    truth = found.truth

    def truths(stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        at = np.maximum(np.searchsorted(truth.time_ns, stamps_ns, side='right') - 1, 0)
        return np.stack((truth.a[at], truth.b[at], truth.c[at]), axis=1), truth.brake_rate[at]

    return Ride(found.train_file, found.records, truths)
