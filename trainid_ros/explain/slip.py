# SPDX-License-Identifier: Apache-2.0
"""Wheel slip and slide: bursts in which the wheel is faster than the train under traction and slower while braking.

They are not modelled as a resistance. They differ from single outliers in their duration and in having the sign of the
force.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.explain.model import EffectTerm
from trainid_ros.explain.run_data import PULLING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trainid_ros.explain.dataset import Dataset

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
