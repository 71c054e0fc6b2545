# SPDX-License-Identifier: Apache-2.0
"""Errors of the measurements themselves: wheel ratio, slip, and the point of the train that gradients are given for.

The wheel ratio is the integral of measured speed over the known distance between stops: evidence for a wrong wheel
diameter that is independent of the dynamics.

Slip and slide are bursts in which the wheel is faster than the train under traction and slower while braking. They are
not modelled as a resistance. They differ from single outliers in their duration and in having the sign of the force.

The interface specifies gradients that are means under the train. Bags with the value at one point of the train look as
if the map were shifted, which disturbs the search for effects; so both are compared before the search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.dataset import MAD_TO_STD, Dataset
from trainid_ros.explain.effects import EffectTerm
from trainid_ros.explain.likelihood import log_bayes
from trainid_ros.explain.run_data import PULLING, Run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from trainid_ros.explain.likelihood import Hyperparameters
    from trainid_ros.explain.model import Model

    Array = NDArray[np.float64]

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


SLIP: Final = 'wheel_slip'
_MIN_SAMPLES: Final = 3
"""Minimum number of samples of a burst."""
_MIN_BURSTS: Final = 4
"""Minimum number of bursts."""
_AGREEING: Final = 0.8
"""Minimum share of the bursts during traction or braking that have the sign of the force."""
_MIN_SHARE: Final = 0.004
"""Minimum share of samples in bursts."""


@dataclass(frozen=True, slots=True)
class _Bursts:
    """Bursts with the sign of the force.

    Attributes:
        peaks: Their peaks [m/s].
        samples: Number of their samples.
        forced: Number of all bursts during traction or braking, of either sign.

    """

    peaks: tuple[float, ...]
    samples: int
    forced: int


def find_slip(dataset: Dataset) -> tuple[EffectTerm, float] | None:
    """Return the slip of a dataset and its evidence, 2 ln of a likelihood ratio; None if there is none."""
    starts, ends = _bursts(dataset)
    bursts = _agreeing(dataset, starts, ends)
    count, share = len(bursts.peaks), bursts.samples / dataset.dt.size
    if count < _MIN_BURSTS or count < _AGREEING * bursts.forced or share < _MIN_SHARE:
        return None
    # The sample maximum underestimates the upper limit of the peaks.
    largest = max(bursts.peaks) * (count + 1) / count
    spread = largest / count
    variances = [(share / math.sqrt(count)) ** 2 + (0.2 * share) ** 2, spread**2 + 0.1**2]
    return EffectTerm(SLIP, {'share': share, 'speed': largest}, np.diag(variances)), _evidence(dataset, count)


def _evidence(dataset: Dataset, count: int) -> float:
    """Return 2 ln of the likelihood ratio of ``count`` bursts with the sign of the force against chance (Poisson)."""
    # Number of bursts expected by chance from independent outliers, half of them with the sign of the force.
    single = float(np.mean(dataset.outlier))
    chance = max(0.5, 0.5 * dataset.dt.size * single**_MIN_SAMPLES)
    return 2.0 * (count * math.log(count / chance) - count + chance) if count > chance else 0.0


def _agreeing(dataset: Dataset, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> _Bursts:
    """Return the bursts in which the wheel is faster under traction, or slower while braking."""
    force = dataset.joined('traction') + dataset.joined('brake')
    peaks, samples, forced = [], 0, 0
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        deviation, pull = dataset.deviation[start:end], float(np.median(force[start:end]))
        peak = float(deviation[np.argmax(np.abs(deviation))])
        if abs(pull) <= PULLING:
            continue  # no force whose sign could agree
        forced += 1
        if peak * pull > 0.0:
            peaks.append(abs(peak))
            samples += end - start
    return _Bursts(tuple(peaks), samples, forced)


def _bursts(dataset: Dataset) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return first sample and end of all bursts: successive outliers of one sign in one run, shapes (k,)."""
    sign = np.where(dataset.outlier, np.sign(dataset.deviation), 0.0)
    fresh = np.ones(sign.size, dtype=bool)
    fresh[1:] = (sign[1:] != sign[:-1]) | (dataset.run_of[1:] != dataset.run_of[:-1])
    starts = np.flatnonzero(fresh)
    ends = np.append(starts[1:], sign.size)
    lasting = (sign[starts] != 0.0) & (ends - starts >= _MIN_SAMPLES)
    return starts[lasting], ends[lasting]


POINTS: Final = {'front': 0.0, 'middle': 0.5, 'rear': 1.0}
"""Points of the train and their distance behind its front, as a share of its length."""
_MIN_EVIDENCE: Final = 15.0
"""2 ln of the Bayes factor required for the value at a point."""
_SHARES: Final = (0.5, 1.5)
"""Limits of the estimated share of the change from the mean to the value at a point."""
_CELL_M: Final = 5.0
"""Length of a cell of the gradient profile [m]."""
_PLACES: Final = 24
"""Points under the train over which the gradient is averaged."""


def read_at(point: str, runs: Sequence[Run], length: float) -> tuple[Run, ...]:
    """Return runs with the gradient, given at one of :data:`POINTS`, averaged under the train.

    The gradient ahead of and behind the point is taken from all runs in the same direction.

    Args:
        point: Point of the train at which the gradient is given.
        runs: The runs.
        length: Length of the train [m].

    """
    profiles = {way: _Profile([run for run in runs if run.direction == way]) for way in {r.direction for r in runs}}
    behind = length * ((np.arange(_PLACES) + 0.5) / _PLACES - POINTS[point])
    return tuple(replace(run, gradient=profiles[run.direction].mean(run, behind)) for run in runs)


def preferred_point(model: Model, hyper: Hyperparameters, shift: float) -> str | None:
    """Return the point at which gradients are given, if the data support it more than a shift of the map; else None.

    Args:
        model: Model without effects.
        hyper: Hyperparameters estimated with it.
        shift: Evidence of a shifted map, 2 ln of its Bayes factor.

    """
    dataset, length = model.dataset, model.train_file.train.length
    given = dataset.joined('gradient')
    changes = [
        np.concatenate([run.gradient for run in read_at(point, dataset.runs, length)]) - given for point in POINTS
    ]
    (found,) = model.informations(hyper, [dataset.column(np.stack(changes, axis=1))])
    A, b = np.diag(found.A), found.b
    share, evidence = b / (A + 1.0), log_bayes(A, b, 1.0, 1)
    best = int(np.argmax(evidence))
    if evidence[best] > max(_MIN_EVIDENCE, shift) and _SHARES[0] < share[best] < _SHARES[1]:
        return tuple(POINTS)[best]
    return None


class _Profile:
    """Gradient [per mille] by position in one direction [m], mean of all runs in each cell."""

    def __init__(self, runs: Sequence[Run]) -> None:
        way = np.concatenate([_middles(run) for run in runs])
        gradient = np.concatenate([run.gradient for run in runs])
        cells, index = np.unique(np.floor(way / _CELL_M), return_inverse=True)
        self._way = (cells + 0.5) * _CELL_M
        self._gradient = np.bincount(index, gradient) / np.bincount(index)

    def mean(self, run: Run, behind: Array) -> Array:
        """Return the mean over points at given distances behind the front [m] on each stage, shapes (k,) to (n,)."""
        places = _middles(run)[:, None] - behind
        return np.asarray(np.interp(places, self._way, self._gradient).mean(axis=1))


def _middles(run: Run) -> Array:
    """Return the position of the front at mid-stage, rising in the direction of travel [m], shape (n,)."""
    return np.asarray(run.direction * run.position - 0.5 * run.dt * run.speed)
