# SPDX-License-Identifier: Apache-2.0
"""Report what is wrong with the brake of the train file as text for its maintainers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator

if TYPE_CHECKING:
    from trainid_ros.estimators.pipeline import EstimatorPipeline


def brake_findings(pipeline: EstimatorPipeline[Any]) -> tuple[str, ...]:
    """Return a sentence for the dead time or else the rate over speed, if it is wrong; none for other estimates."""
    if not isinstance(pipeline.estimator, BrakeRateEstimator):
        return ()
    warning = pipeline.stream.brake_delay.warning
    return (warning,) if warning else ()
