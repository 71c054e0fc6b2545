# SPDX-License-Identifier: Apache-2.0
"""Plausibility check of a converged fit, to detect wrong units or signs in the measurements.

With force in kN, speed in km/h or gradient in percent the model cannot follow the motion. The fit then classifies
speeds as outliers, attributes the motion to gusts, or gives a negative resistance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.errors import NoAnswerError

if TYPE_CHECKING:
    from trainid_ros.resistance.trajectory.davis_fit import DavisFit, DavisFitConfig

_MAX_OUTLIERS: Final = 0.3
# A resistance below zero by this many standard deviations is significant.
_SIGMAS: Final = 3.0
# Gusts as large as the resistance of a train [N/kN]; map errors of two per mille give half of it.
_MAX_GUST: Final = 4.0
_MAX_GAIN: Final = 0.1
# Noise of the speed [m/s]; a quantum of 1 mph gives an eighth of it.
_MAX_NOISE: Final = 1.0


def check_plausible(fit: DavisFit, config: DavisFitConfig) -> None:
    """Raise NoAnswerError, naming the cause, if a fit is implausible for a train measured in the specified units."""
    odd = _oddity(fit, config)
    if odd:
        msg = f'{odd}: check the units and signs of speed, force, mass and gradient, and the speed sensor'
        raise NoAnswerError(msg)


def _oddity(fit: DavisFit, config: DavisFitConfig) -> str:
    slow, fast = fit.speed_range
    for v in (slow, 0.5 * (slow + fast), fast):
        w, std = fit.resistance(v)
        if w < -_SIGMAS * std:
            return f'a negative resistance of {w:.3g} N/kN (std {std:.2g}) at {v:.1f} m/s would drive the train'
    if abs(fit.force_gain) > _MAX_GAIN:
        return f'the fit requires a force error of {fit.force_gain:+.0%}'
    if fit.speed_std > _MAX_NOISE:
        return f'the speed noise is {fit.speed_std:.2g} m/s'
    gust = math.sqrt(fit.disturbance / (2.0 * config.disturbance_time))
    if gust > _MAX_GUST:
        return f'forces and resistance leave {gust:.2g} N/kN of the motion unexplained'
    if fit.outliers > _MAX_OUTLIERS:
        return f'{fit.outliers:.0%} of the speeds are outliers'
    return ''
