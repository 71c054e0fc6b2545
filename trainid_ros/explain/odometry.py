# SPDX-License-Identifier: Apache-2.0
"""What distances between stops tell of the wheel: the integral of measured speed over the distance that is known.

It is evidence for a wrong wheel diameter alone, apart from all dynamics.
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
"""How far from its stopping point a train may stand, both ends of a run together."""
_COMMON: Final = 0.0015
"""Relative error of distances that all runs share: a map is no measuring tape."""
_MOST: Final = 0.1
"""A ratio further from one is no wheel's."""
_NEAR_M: Final = 60.0
"""How far from a stopping point a train counts as standing at it."""
_MEDIAN_VARIANCE: Final = 1.6
"""Variance of the median of normal values over that of their mean (pi / 2, and a little for few values)."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Measured over true distance, less one, from all runs together.

    Attributes:
        excess: The ratio less one, 0 if nothing is known.
        precision: One over its variance, 0 if nothing is known.

    """

    excess: float
    precision: float

    @classmethod
    def of(cls, dataset: Dataset, stops: Sequence[float]) -> Odometry:
        """Return what the runs between two standstills tell."""
        ratios, weights = [], []
        for run, travelled in zip(dataset.runs, _travelled(dataset), strict=True):
            distance = _distance(run, travelled, stops)
            if distance is not None and abs(travelled / distance - 1.0) < _MOST:
                ratios.append(travelled / distance - 1.0)
                weights.append(distance)
        if len(ratios) < 2:
            return cls(0.0, 0.0)
        excess = float(np.median(ratios))
        spread = MAD_TO_STD * float(np.median(np.abs(np.array(ratios) - excess)))
        single = max(spread, _STOPPING_M / float(np.median(weights)))
        return cls(excess, 1.0 / (single**2 * _MEDIAN_VARIANCE / len(ratios) + _COMMON**2))


def _travelled(dataset: Dataset) -> list[float]:
    """Return the integrals of speed without outliers, from standstill to standstill [m]."""
    out = []
    edges = pairwise(np.append(dataset.starts, dataset.dt.size).tolist())
    for run, (start, end) in zip(dataset.runs, edges, strict=True):
        middle = 0.5 * (run.speed[1:] + run.speed[:-1])
        out.append(run.travelled + float(np.sum(run.dt[1:] * (dataset.speed[start + 1 : end] - middle))))
    return out


def _distance(run: Run, travelled: float, stops: Sequence[float]) -> float | None:
    """Return the distance between the stops of a run [m]: by the line if both are on it, otherwise as measured."""
    begin, end = run.stops
    if not (math.isfinite(begin) and math.isfinite(end)) or not run.positioned:
        return None
    if stops:
        line = np.array(stops)
        first, last = line[np.argmin(np.abs(line - begin))], line[np.argmin(np.abs(line - end))]
        near = _NEAR_M + _MOST * travelled
        if first != last and abs(first - begin) < near and abs(last - end) < near:
            return float(abs(last - first))
    return abs(end - begin) or None
