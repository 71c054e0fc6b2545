# SPDX-License-Identifier: Apache-2.0
"""Quantities of the table in which trains are compared."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.fleet.columns import Row

    Array = NDArray[np.float64]
    Numbers = NDArray[np.intp]

_USABLE: Final = frozenset({'CONVERGING', 'VALID', 'HOLDING', 'STALE'})


class Channel(NamedTuple):
    """A quantity that is compared.

    Attributes:
        name: Column of the value; that of its standard deviation ends with ``_std``.
        title: What it is.
        unit: Its unit, '' for ratios.
        change: Standard deviation of a change that matters, as a share of the mean of the fleet [1].

    """

    name: str
    title: str
    unit: str
    change: float


CHANNELS: Final = (
    Channel('w15', 'resistance at 15 m/s', 'N/kN', 0.2),
    Channel('brake_rate', 'brake rate', '', 0.08),
    Channel('force_scale', 'force scale', '', 0.06),
    Channel('wheel_ratio', 'wheel ratio', '', 0.02),
)


@dataclass(frozen=True, slots=True)
class Labels:
    """Names of trains, days and common causes; the tables of all channels count by them."""

    trains: tuple[str, ...]
    days: tuple[str, ...]
    lines: tuple[str, ...]
    weathers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Cells:
    """Values of one channel, runs of a train on one day, line and weather taken together; shapes (n,).

    Attributes:
        value: Mean, weighted by the inverse variances.
        std: Standard deviation stated by the estimator, of the mean.
        train: Index in the labels; likewise day, line and weather.
        day: Day.
        line: Line.
        weather: Weather.

    """

    value: Array
    std: Array
    train: Numbers
    day: Numbers
    line: Numbers
    weather: Numbers


def labels_of(rows: Sequence[Row]) -> Labels:
    """Return all labels in use, in order; rows without train or day do not count."""
    known = [row for row in rows if is_known(row)]

    def names(column: str) -> tuple[str, ...]:
        return tuple(sorted({row[column] or '' for row in known}))

    return Labels(names('train'), names('day'), names('line'), names('weather'))


def is_known(row: Row) -> bool:
    """Return whether a row has an estimate of a known train and day, from inputs that do not contradict each other."""
    return has_estimate(row) and not row['contradiction']


def has_estimate(row: Row) -> bool:
    """Return whether a row has an estimate of a known train and day, whatever its inputs."""
    return bool(row['train'] and row['day'] and row['status'] in _USABLE)


def cells_of(rows: Sequence[Row], channel: Channel, labels: Labels) -> Cells:
    """Return the cells of a channel; rows without a finite value are left out."""
    index = [{name: k for k, name in enumerate(names)} for names in
             (labels.trains, labels.days, labels.lines, labels.weathers)]  # fmt: skip
    runs: dict[tuple[int, ...], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        value, std = row[channel.name], row[f'{channel.name}_std']
        if not is_known(row) or value is None or std is None or not std > 0.0 or not math.isfinite(value + std):
            continue
        key = tuple(
            numbers[row[column] or '']
            for numbers, column in zip(index, ('train', 'day', 'line', 'weather'), strict=True)
        )
        runs[key].append((value, std))
    keys = np.array(sorted(runs), dtype=np.intp).reshape(-1, 4)
    means = [_mean(runs[key]) for key in sorted(runs)]
    value, std = np.array(means).reshape(-1, 2).T
    return Cells(value, std, *keys.T)


def _mean(runs: Sequence[tuple[float, float]]) -> tuple[float, float]:
    weights = [1.0 / (std * std) for _, std in runs]
    total = sum(weights)
    return sum(w * value for w, (value, _) in zip(weights, runs, strict=True)) / total, total**-0.5
