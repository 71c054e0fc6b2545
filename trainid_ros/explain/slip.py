# SPDX-License-Identifier: Apache-2.0
"""Wheel slip and slide: bursts in which the wheel is faster than the train under traction and slower while braking.

No resistance shows them; they are told from single outliers by lasting, and by the sign of the force they go with.
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
_LASTING: Final = 3
_FEWEST: Final = 4
_AGREEING: Final = 0.8
_LEAST_SHARE: Final = 0.004
"""Share of samples in bursts below which there is no slip to speak of."""


@dataclass(frozen=True, slots=True)
class _Bursts:
    """Bursts that follow the force: their peaks [m/s], how many samples they hold, and all that met a force."""

    peaks: tuple[float, ...]
    samples: int
    forced: int


def find_slip(dataset: Dataset) -> tuple[EffectTerm, float] | None:
    """Return the slip of a drive and 2 ln of the odds that its bursts follow the force, or None."""
    starts, ends = _bursts(dataset)
    bursts = _agreeing(dataset, starts, ends)
    count, share = len(bursts.peaks), bursts.samples / dataset.dt.size
    if count < _FEWEST or count < _AGREEING * bursts.forced or share < _LEAST_SHARE:
        return None
    # The largest of so many lies below the largest that there can be.
    largest = max(bursts.peaks) * (count + 1) / count
    spread = largest / count
    variances = [(share / math.sqrt(count)) ** 2 + (0.2 * share) ** 2, spread**2 + 0.1**2]
    return EffectTerm(SLIP, {'share': share, 'speed': largest}, np.diag(variances)), _evidence(dataset, count)


def _evidence(dataset: Dataset, count: int) -> float:
    """Return 2 ln of the odds of so many bursts that follow the force against bursts by chance (Poisson)."""
    # Isolated outliers would make so many bursts by chance, half of them with the force.
    single = float(np.mean(dataset.outlier))
    chance = max(0.5, 0.5 * dataset.dt.size * single**_LASTING)
    return 2.0 * (count * math.log(count / chance) - count + chance) if count > chance else 0.0


def _agreeing(dataset: Dataset, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> _Bursts:
    """Return those bursts in which the wheel is faster under traction, or slower while braking."""
    force = dataset.joined('traction') + dataset.joined('brake')
    peaks, samples, forced = [], 0, 0
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        deviation, pull = dataset.deviation[start:end], float(np.median(force[start:end]))
        peak = float(deviation[np.argmax(np.abs(deviation))])
        if abs(pull) <= PULLING:
            continue  # neither with a force nor against it
        forced += 1
        if peak * pull > 0.0:
            peaks.append(abs(peak))
            samples += end - start
    return _Bursts(tuple(peaks), samples, forced)


def _bursts(dataset: Dataset) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return first sample and end of all stretches of outliers of one sign that last, run by run, shapes (k,)."""
    sign = np.where(dataset.outlier, np.sign(dataset.deviation), 0.0)
    fresh = np.ones(sign.size, dtype=bool)
    fresh[1:] = (sign[1:] != sign[:-1]) | (dataset.run_of[1:] != dataset.run_of[:-1])
    starts = np.flatnonzero(fresh)
    ends = np.append(starts[1:], sign.size)
    lasting = (sign[starts] != 0.0) & (ends - starts >= _LASTING)
    return starts[lasting], ends[lasting]
