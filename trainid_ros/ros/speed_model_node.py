# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``speed_model_estimator``: estimates the speed model, by default with AM-VFF-RLS."""

from __future__ import annotations

from typing import Any, Final

from trainid_msgs.msg import SpeedModelEstimate

from trainid_ros.ros.diagnostics import ShownValue
from trainid_ros.ros.estimator_node import EstimatorNode, EstimatorSpec
from trainid_ros.ros.jobs import SPEED_MODEL_JOB
from trainid_ros.ros.runner import run_node

SPEED_MODEL: Final = EstimatorSpec(
    job=SPEED_MODEL_JOB,
    message=SpeedModelEstimate,
    shown=(
        ShownValue('prediction_error', 'm/s'),
        ShownValue('a1', '1/(m/s)', variance=0),
        ShownValue('a2', '', variance=1),
        ShownValue('b1', 'm/s per N/kN', variance=2),
        ShownValue('d0', 'm/s', variance=3),
        ShownValue('a', 'N/kN'),
        ShownValue('b', 'N/kN per m/s'),
        ShownValue('c', 'N/kN per (m/s)^2'),
        ShownValue('mass_factor', ''),
    ),
)


def make_node(arguments: Any = (), **options: Any) -> EstimatorNode:
    """Return the node, unconfigured."""
    return EstimatorNode(SPEED_MODEL, arguments=arguments, **options)


def main() -> int:
    """Run the node as a program."""
    return run_node(make_node)
