# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``resistance_estimator``: running resistance by V-MILS."""

from __future__ import annotations

from typing import Any, Final

from trainid_msgs.msg import ResistanceEstimate

from trainid_ros.estimators.pipeline import resistance_pipeline
from trainid_ros.estimators.resistance import algorithms
from trainid_ros.nodes.diagnostics import ShownValue
from trainid_ros.nodes.estimator_node import EstimatorNode, EstimatorSpec
from trainid_ros.nodes.runner import run_node

RESISTANCE: Final = EstimatorSpec(
    node_name='resistance_estimator',
    topic='trainid/resistance',
    message=ResistanceEstimate,
    last_valid_topic='trainid/last_valid/resistance',
    settings_field='resistance',
    algorithms=algorithms.RESISTANCE,
    pipeline=resistance_pipeline,
    shown=(
        ShownValue('resistance', 'N/kN', std='resistance_std'),
        ShownValue('a', 'N/kN', variance=0),
        ShownValue('b', 'N/kN per m/s', variance=1),
        ShownValue('c', 'N/kN per (m/s)^2', variance=2),
    ),
)


def make_node(arguments: Any = (), **options: Any) -> EstimatorNode:
    """Return the node, unconfigured."""
    return EstimatorNode(RESISTANCE, arguments=arguments, **options)


def main() -> int:
    """Run the node as a program."""
    return run_node(make_node)
