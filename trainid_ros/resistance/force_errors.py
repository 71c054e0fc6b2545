# SPDX-License-Identifier: Apache-2.0
"""How far the known forces may be wrong: their scale and delay, and the resistance of curves.

With T the reported specific traction [N/kN] and R the radius of the curve, the true forces are taken as

    (1 + kappa) T(t + delta)   and   w_curve + kappa_curve 600 m / R.

The force gain over the mass is one scale: only their ratio shows in the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from trainid_ros.train.train_file import Train, TrainFile

CURVE_RADIUS: Final = 600.0
"""Radius at which the error of the curve resistance is stated [m]."""
DELAY_RANGE: Final = (-0.2, 0.4)
"""Delays of the force that can be estimated [s]: later reports must have come, and the cubic reaches no farther."""
# A delay so near the end of its range is one beyond it; a mixture of delays at the end is never quite there.
_AT_END_S: Final = 0.01
# Uncertainty of the curve resistance: share of the coefficient where no std is stated, and where there is no effect.
_CURVE_SHARE: Final = 0.2
_CURVE_STD: Final = 0.5
# Change of a weighed load's error from stop to stop, and of a load that is not weighed.
_WEIGHED_STEP: Final = 0.004
_UNWEIGHED_STEP: Final = 0.03
# The error of a mass is that of the empty train and the scales, which stays, and of the load: this share of it changes.
_CHANGING: Final = 0.5
_LEAST_STD: Final = 1e-4


@dataclass(frozen=True, slots=True)
class ForceErrors:
    """Prior standard deviations of kappa [1], delta [s] and kappa_curve [N/kN at 600 m]."""

    scale: float
    delay: float
    curve: float

    @property
    def variances(self) -> tuple[float, float, float]:
        """Variances of kappa, delta and kappa_curve; none is zero, so that information is finite."""
        scale, delay, curve = (max(std, _LEAST_STD) ** 2 for std in (self.scale, self.delay, self.curve))
        return scale, delay, curve


EXACT: Final = ForceErrors(0.0, 0.0, 0.0)
"""Forces that are known exactly."""


def force_errors(train_file: TrainFile, delay_std: float) -> ForceErrors:
    """Return how well a train file knows its forces; ``delay_std`` [s] is that of a setting."""
    train = train_file.train
    return ForceErrors(
        scale=math.hypot(train.mass_std, train.force_std),
        delay=delay_std,
        curve=curve_std(train_file),
    )


def curve_std(train_file: TrainFile) -> float:
    """Return the standard deviation of the curve resistance at 600 m [N/kN]."""
    for effect in train_file.effects:
        if effect.name == 'curve_resistance':
            coefficient = dict(effect.parameters).get('coefficient', 0.0)
            return dict(effect.std).get('coefficient', _CURVE_SHARE * coefficient) / CURVE_RADIUS
    return _CURVE_STD


def is_delay_at_end(delay: float) -> bool:
    """Return whether a delay [s] is at the end of what can be estimated, so that the true one may lie beyond."""
    return any(abs(delay - end) < _AT_END_S for end in DELAY_RANGE)


def scale_step(train: Train, *, weighed: bool) -> float:
    """Return the standard deviation of the change of kappa at a stop, where passengers change [1]."""
    return min(_WEIGHED_STEP if weighed else _UNWEIGHED_STEP, _CHANGING * train.mass_std)
