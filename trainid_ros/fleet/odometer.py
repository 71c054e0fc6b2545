# SPDX-License-Identifier: Apache-2.0
"""Ratio of the distance by the speed to that by the position, from stop to stop: the error of the wheel diameter.

Where positions are corrected by balises or at platforms, they do not depend on the wheels. Where they are integrated
from the same wheels the ratio is one, and says nothing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.bag.reader import BagReader
from trainid_ros.records import INPUT_TOPICS, NS_PER_S, SPEED_TOPIC

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from trainid_ros.bag.record_table import RecordTable

_SPEED: Final = INPUT_TOPICS.index(SPEED_TOPIC)
_STANDING: Final = 0.05  # [m/s]
_SHORTEST: Final = 200.0  # Distance from stop to stop that counts [m].
_LONGEST_GAP_S: Final = 2.0
# Error of the distance between two stops: balises, overshoot, slip [m]; added to the scatter.
_STOP_ERROR: Final = 1.0
# Beyond this it is not the wheels: another unit, or positions of something else [1].
_MOST: Final = 0.2


class Odometer:
    """Compares distances from stop to stop; tables of records come in the order of the log."""

    def __init__(self) -> None:
        self._rest = self._position = math.nan  # positions at the last stop, and of the last speed [m]
        self._driven = self._speed = 0.0
        self._stamp_ns = 0
        self._ratios: list[tuple[float, float]] = []

    def add(self, table: RecordTable) -> None:
        """Take in records; others than speeds do not count."""
        chosen = np.flatnonzero(table.topic == _SPEED)
        if chosen.size:
            self._add(table.stamp_ns[chosen], np.abs(table.x[chosen]), table.y[chosen])

    def _add(self, stamp_ns: NDArray[np.int64], speed: NDArray[np.float64], position: NDArray[np.float64]) -> None:
        gap = np.diff(stamp_ns, prepend=self._stamp_ns or stamp_ns[0]) / NS_PER_S
        before = np.concatenate(([self._speed], speed[:-1]))
        # A leg with a gap has no known distance.
        steps = np.where((gap >= 0.0) & (gap < _LONGEST_GAP_S), 0.5 * (before + speed) * gap, math.nan)
        self._stamp_ns, self._speed = int(stamp_ns[-1]), float(speed[-1])
        standing = speed < _STANDING
        # Pieces that start where the train stops or departs.
        edges = np.flatnonzero(np.diff(standing)) + 1
        for first, end in zip([0, *edges.tolist()], [*edges.tolist(), speed.size], strict=True):
            if standing[first]:
                self._driven += float(steps[first])  # the last step before the stop
                self._arrive(float(position[end - 1]))
            else:
                self._driven += float(steps[first:end].sum())

    def _arrive(self, position: float) -> None:
        """Close a leg at a stop; positions are corrected while the train stands, so the last one counts."""
        leg = abs(position - self._rest)
        if self._driven > 0.0 and leg > _SHORTEST and abs(self._driven / leg - 1.0) < _MOST:
            self._ratios.append((self._driven / leg, leg))
        self._rest, self._driven = position, 0.0

    @property
    def ratio(self) -> tuple[float, float] | None:
        """Mean ratio and its standard deviation, None if there was no leg."""
        if not self._ratios:
            return None
        ratio, leg = np.array(self._ratios).T
        weight = leg * leg
        mean = float(np.average(ratio, weights=weight))
        stated = _STOP_ERROR / math.sqrt(float(weight.sum()))
        scatter = float(np.average((ratio - mean) ** 2, weights=weight)) / max(1, ratio.size - 1)
        return mean, math.hypot(stated, math.sqrt(scatter))


class OdometerReader(BagReader):
    """A bag whose records an odometer takes in as they are read."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Name the bag; arguments as of :class:`BagReader`."""
        super().__init__(*arguments, **options)
        self.odometer = Odometer()

    def tables(self, last_ns: float = math.inf) -> Iterator[RecordTable]:
        """Yield the tables of the reader."""
        for table in super().tables(last_ns):
            self.odometer.add(table)
            yield table
