# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``brake_rate_estimator``: brake rate by GSMA."""

from __future__ import annotations

from typing import Any, Final

from trainid_msgs.msg import BrakeRateEstimate

from trainid_ros.estimators.brake_rate import algorithms
from trainid_ros.estimators.pipeline import brake_rate_pipeline
from trainid_ros.nodes.diagnostics import ShownValue
from trainid_ros.nodes.estimator_node import EstimatorNode, EstimatorSpec
from trainid_ros.nodes.runner import run_node

BRAKE_RATE: Final = EstimatorSpec(
    node_name='brake_rate_estimator',
    topic='trainid/brake_rate',
    message=BrakeRateEstimate,
    last_valid_topic='trainid/last_valid/brake_rate',
    settings_field='brake_rate',
    algorithms=algorithms.BRAKE_RATE,
    pipeline=brake_rate_pipeline,
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
