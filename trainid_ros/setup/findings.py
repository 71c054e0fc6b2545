# SPDX-License-Identifier: Apache-2.0
"""Report what is wrong with the brake of the train file as text for its maintainers.

Report a wrong force scale or a delayed force as text for the maintainers of the train file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.resistance.davis_posterior import is_delay_at_end

if TYPE_CHECKING:
    from trainid_ros.estimators.pipeline import EstimatorPipeline
    from trainid_ros.interface.results import ResistanceEstimate


def brake_findings(pipeline: EstimatorPipeline[Any]) -> tuple[str, ...]:
    """Return a sentence for the dead time or else the rate over speed, if it is wrong; none for other estimates."""
    if not isinstance(pipeline.estimator, BrakeRateEstimator):
        return ()
    warning = pipeline.stream.brake_delay.warning
    return (warning,) if warning else ()


# An error is reported if it differs from zero by this many standard deviations ...
_SIGNIFICANT: Final = 4.0
# ... and is large enough to matter: 1 % of the force, half a sample period.
_MIN_SCALE_ERROR: Final = 0.01
_MIN_DELAY_S: Final = 0.1


def force_findings(estimate: ResistanceEstimate) -> tuple[str, ...]:
    """Return one sentence per significant error of the reported force; none where it is not estimated."""
    scale, delay = estimate.force_scale - 1.0, estimate.force_delay
    found = []
    if abs(scale) > max(_MIN_SCALE_ERROR, _SIGNIFICANT * estimate.force_scale_std):
        value = f'{estimate.force_scale:.3f} ± {estimate.force_scale_std:.3f}'
        found.append(f'force scale {value}: mass or force of the train file is off')
    if abs(delay) > max(_MIN_DELAY_S, _SIGNIFICANT * estimate.force_delay_std):
        sense = 'later' if delay > 0.0 else 'earlier'
        found.append(f'force delay {_delay(estimate)}: ato/force is stamped {sense} than it acts')
    return tuple(found)


def _delay(estimate: ResistanceEstimate) -> str:
    delay, std = estimate.force_delay, estimate.force_delay_std
    if is_delay_at_end(delay):
        return f'{abs(delay):.1f} s or more, which cannot be estimated'
    return f'{abs(delay):.2f} ± {std:.2g} s'
