# SPDX-License-Identifier: Apache-2.0
"""Wheel ratio from distances between stops: the integral of measured speed over the known distance.

It is evidence for a wrong wheel diameter that is independent of the dynamics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.dataset import MAD_TO_STD

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.dataset import Dataset
    from trainid_ros.explain.run_data import Run

_STOPPING_M: Final = 1.5
"""Std of the stopping position, both ends of a run together [m]."""
_COMMON: Final = 0.0015
"""Relative error of the map's distances, common to all runs [1]."""
_MAX_EXCESS: Final = 0.1
"""Deviation of the ratio from one beyond which it is not due to the wheel [1]."""
_NEAR_M: Final = 60.0
"""Distance from a stopping point within which a train counts as stopped there [m]."""
_MEDIAN_VARIANCE: Final = 1.6
"""Ratio of the variances of median and mean of normal values (pi / 2, slightly more for few values)."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Ratio of measured to true distance, from all runs.

    Attributes:
        excess: The ratio less one [1], 0 if unknown.
        precision: Inverse of its variance [1], 0 if unknown.

    """

    excess: float
    precision: float

    @classmethod
    def of(cls, dataset: Dataset, stops: Sequence[float]) -> Odometry:
        """Return the ratio from all runs between two standstills.

        Args:
            dataset: The dataset.
            stops: Stopping positions of the line [m].

        """
        ratios, weights = [], []
        for run, travelled in zip(dataset.runs, _travelled(dataset), strict=True):
            distance = _distance(run, travelled, stops)
            if distance is not None and abs(travelled / distance - 1.0) < _MAX_EXCESS:
                ratios.append(travelled / distance - 1.0)
                weights.append(distance)
        if len(ratios) < 2:
            return cls(0.0, 0.0)
        excess = float(np.median(ratios))
        spread = MAD_TO_STD * float(np.median(np.abs(np.array(ratios) - excess)))
        single = max(spread, _STOPPING_M / float(np.median(weights)))
        return cls(excess, 1.0 / (single**2 * _MEDIAN_VARIANCE / len(ratios) + _COMMON**2))


def _travelled(dataset: Dataset) -> list[float]:
    """Return the integrals of speed from standstill to standstill, with outliers interpolated [m]."""
    out = []
    edges = pairwise(np.append(dataset.starts, dataset.dt.size).tolist())
    for run, (start, end) in zip(dataset.runs, edges, strict=True):
        middle = 0.5 * (run.speed[1:] + run.speed[:-1])
        out.append(run.travelled + float(np.sum(run.dt[1:] * (dataset.speed[start + 1 : end] - middle))))
    return out


def _distance(run: Run, travelled: float, stops: Sequence[float]) -> float | None:
    """Return the distance between the stops of a run [m]: from the line if both are on it, otherwise as measured."""
    begin, end = run.stops
    if not (math.isfinite(begin) and math.isfinite(end)) or not run.positioned:
        return None
    if stops:
        line = np.array(stops)
        first, last = line[np.argmin(np.abs(line - begin))], line[np.argmin(np.abs(line - end))]
        near = _NEAR_M + _MAX_EXCESS * travelled
        if first != last and abs(first - begin) < near and abs(last - end) < near:
            return float(abs(last - first))
    return abs(end - begin) or None
