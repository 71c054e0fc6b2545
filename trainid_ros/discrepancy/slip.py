# SPDX-License-Identifier: Apache-2.0
"""Wheel slip and slide: bursts in which the wheel is faster than the train under traction and slower while braking.

No resistance shows them; they are told from single outliers by lasting, and by the sign of the force they go with.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.discrepancy.model import Member

if TYPE_CHECKING:
    from trainid_ros.discrepancy.nodes import Drive

SLIP: Final = 'wheel_slip'
_LASTING: Final = 3
_FEWEST: Final = 4
_AGREEING: Final = 0.8
_PULLING: Final = 1.0  # N/kN
# Of bursts by chance half agree with the force; twice the log of the odds of one that does.
_LEAST_SHARE: Final = 0.004


def find_slip(drive: Drive) -> tuple[Member, float] | None:
    """Return the slip of a drive and 2 ln of the odds that its bursts follow the force, or None."""
    force = drive.joined('traction') + drive.joined('brake')
    starts, ends = _bursts(drive)
    agreeing, peaks, samples = 0, [], 0
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        deviation, pull = drive.deviation[start:end], float(np.median(force[start:end]))
        peak = float(deviation[np.argmax(np.abs(deviation))])
        if abs(pull) > _PULLING and peak * pull > 0.0:
            agreeing += 1
            peaks.append(abs(peak))
            samples += end - start
    share = samples / drive.dt.size
    if agreeing < _FEWEST or agreeing < _AGREEING * len(starts) or share < _LEAST_SHARE:
        return None
    # Isolated outliers would make so many bursts by chance, half of them with the force.
    single = float(np.mean(drive.outlier))
    chance = max(0.5, 0.5 * drive.dt.size * single**_LASTING)
    evidence = 2.0 * (agreeing * math.log(agreeing / chance) - agreeing + chance) if agreeing > chance else 0.0
    largest = max(peaks) * (agreeing + 1) / agreeing
    spread = largest / agreeing
    variances = [(share / math.sqrt(agreeing)) ** 2 + (0.2 * share) ** 2, spread**2 + 0.1**2]
    return Member(SLIP, {'share': share, 'speed': largest}, np.diag(variances)), evidence


def _bursts(drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Return first and end of all stretches of outliers of one sign that last, run by run."""
    sign = np.where(drive.outlier, np.sign(drive.deviation), 0.0)
    fresh = np.ones(sign.size, dtype=bool)
    fresh[1:] = (sign[1:] != sign[:-1]) | (drive.run_of[1:] != drive.run_of[:-1])
    starts = np.flatnonzero(fresh)
    ends = np.append(starts[1:], sign.size)
    lasting = (sign[starts] != 0.0) & (ends - starts >= _LASTING)
    return starts[lasting], ends[lasting]
