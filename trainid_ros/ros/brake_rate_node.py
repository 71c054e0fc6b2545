# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``brake_rate_estimator``: estimates the brake rate, by default with GSMA."""

from __future__ import annotations

from typing import Any, Final

from trainid_msgs.msg import BrakeRateEstimate

from trainid_ros.ros.diagnostics import ShownValue
from trainid_ros.ros.estimator_node import EstimatorNode, EstimatorSpec
from trainid_ros.ros.jobs import BRAKE_RATE_JOB
from trainid_ros.ros.runner import run_node

BRAKE_RATE: Final = EstimatorSpec(
    job=BRAKE_RATE_JOB,
    message=BrakeRateEstimate,
    shown=(
        ShownValue('brake_rate', '', std='brake_rate_std'),
        ShownValue('effective_particles', ''),
    ),
)


def make_node(arguments: Any = (), **options: Any) -> EstimatorNode:
    """Return the node, unconfigured."""
    return EstimatorNode(BRAKE_RATE, arguments=arguments, **options)


def main() -> int:
    """Run the node as a program."""
    return run_node(make_node)
