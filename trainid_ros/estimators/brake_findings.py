# SPDX-License-Identifier: Apache-2.0
"""Report a wrong dead time of the brake as text for the maintainers of the train file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trainid_ros.results import BrakeRateEstimate

if TYPE_CHECKING:
    from trainid_ros.estimators.pipeline import EstimatorPipeline


def brake_findings(pipeline: EstimatorPipeline[Any]) -> tuple[str, ...]:
    """Return one sentence if the brake acts at another time than the train file says; none of other estimates."""
    if not isinstance(pipeline.current().estimate, BrakeRateEstimate):
        return ()
    warning = pipeline.stream.brake_delay.warning
    return (warning,) if warning else ()
