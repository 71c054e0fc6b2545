# SPDX-License-Identifier: Apache-2.0
"""Error model of the known forces: scale and delay of the traction, and error of the curve resistance.

With T the reported specific traction [N/kN] and R the curve radius, the true forces are modelled as

    (1 + kappa) T(t + delta)   and   w_curve + kappa_curve 600 m / R.

Force gain and mass share one scale kappa: only their ratio is observable in the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from trainid_ros.train.train_file import Train, TrainFile

CURVE_RADIUS: Final = 600.0
"""Radius at which the error of the curve resistance is stated [m]."""
MIN_DELAY: Final = -0.2
MAX_DELAY: Final = 0.4
"""Range of estimable force delays [s], limited by the reports available ahead and the range of the cubic."""
# A delay this near the end of the range counts as beyond it; the mean of a mixture never quite reaches the end.
_AT_END_S: Final = 0.01
# Standard deviation of the curve resistance: share of the coefficient if no std is stated, and value at 600 m [N/kN]
# if the train file has no curve effect.
_CURVE_SHARE: Final = 0.2
_CURVE_STD: Final = 0.5
# Std of the change of kappa at a stop with a weighed load and with an unweighed one.
_WEIGHED_STEP: Final = 0.004
_UNWEIGHED_STEP: Final = 0.03
# The mass error of empty train and scales is constant, that of the load is not: share of the mass error that changes.
_CHANGING: Final = 0.5
_MIN_STD: Final = 1e-4


@dataclass(frozen=True, slots=True)
class ForceErrors:
    """Prior standard deviations of kappa [1], delta [s] and kappa_curve [N/kN at 600 m]."""

    scale: float
    delay: float
    curve: float

    @property
    def variances(self) -> tuple[float, float, float]:
        """Variances of kappa [1], delta [s^2] and kappa_curve [(N/kN)^2], positive so that information is finite."""
        scale, delay, curve = (max(std, _MIN_STD) ** 2 for std in (self.scale, self.delay, self.curve))
        return scale, delay, curve


def force_errors(train_file: TrainFile, delay_std: float) -> ForceErrors:
    """Return the prior standard deviations of the force errors from a train file; ``delay_std`` [s] is a setting."""
    train = train_file.train
    return ForceErrors(
        scale=math.hypot(train.mass_std, train.force_std),
        delay=delay_std,
        curve=curve_std(train_file),
    )


def curve_std(train_file: TrainFile) -> float:
    """Return the prior standard deviation of the curve resistance at 600 m [N/kN]."""
    for effect in train_file.effects:
        if effect.name == 'curve_resistance':
            coefficient = dict(effect.parameters).get('coefficient', 0.0)
            return dict(effect.std).get('coefficient', _CURVE_SHARE * coefficient) / CURVE_RADIUS
    return _CURVE_STD


def is_delay_at_end(delay: float) -> bool:
    """Return whether a delay [s] is at an end of its range, so that the true one may lie beyond."""
    return abs(delay - MIN_DELAY) < _AT_END_S or abs(delay - MAX_DELAY) < _AT_END_S


def scale_step(train: Train, *, weighed: bool) -> float:
    """Return the standard deviation of the change of kappa at a stop [1], where the passenger load changes."""
    return min(_WEIGHED_STEP if weighed else _UNWEIGHED_STEP, _CHANGING * train.mass_std)
