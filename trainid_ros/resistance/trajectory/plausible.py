# SPDX-License-Identifier: Apache-2.0
"""What no train does, though a fit to it converges: a sign of a wrong unit or sign in what was measured.

Force in kN, speed in km/h or gradient in percent leave a motion that the model cannot follow. The fit then calls
speeds outliers, takes all of the motion for gusts, or finds a resistance that drives the train.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.core.errors import NoAnswerError

if TYPE_CHECKING:
    from trainid_ros.resistance.trajectory.davis_fit import DavisFit, DavisFitConfig

_MOST_OUTLIERS: Final = 0.3
# Resistance below zero by so many standard deviations is no chance.
_SIGMAS: Final = 3.0
# Gusts as strong as the resistance of a train itself [N/kN]; map errors of two per mille make half of it.
_MOST_GUST: Final = 4.0
_MOST_GAIN: Final = 0.1
# Of the speed [m/s]; a quantum of 1 mph makes an eighth of it.
_MOST_NOISE: Final = 1.0


def check_plausible(fit: DavisFit, config: DavisFitConfig) -> None:
    """Raise NoAnswerError, telling what is odd, if a fit is none of a train measured in the units agreed."""
    odd = _oddity(fit, config)
    if odd:
        msg = f'{odd}: check the units and signs of speed, force, mass and gradient, and the speed sensor'
        raise NoAnswerError(msg)


def _oddity(fit: DavisFit, config: DavisFitConfig) -> str:
    slow, fast = fit.speed_range
    for v in (slow, 0.5 * (slow + fast), fast):
        w, std = fit.resistance(v)
        if w < -_SIGMAS * std:
            return f'a resistance of {w:.3g} N/kN (std {std:.2g}) at {v:.1f} m/s would drive the train'
    if abs(fit.force_gain) > _MOST_GAIN:
        return f'the force would have to be wrong by {fit.force_gain:+.0%}'
    if fit.speed_std > _MOST_NOISE:
        return f'the speed scatters by {fit.speed_std:.2g} m/s'
    gust = math.sqrt(fit.disturbance / (2.0 * config.disturbance_time))
    if gust > _MOST_GUST:
        return f'forces and resistance leave {gust:.2g} N/kN of the motion unexplained'
    if fit.outliers > _MOST_OUTLIERS:
        return f'{fit.outliers:.0%} of the speeds are outliers'
    return ''
