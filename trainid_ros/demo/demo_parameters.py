# SPDX-License-Identifier: Apache-2.0
"""Parameters of the demo's nodes: no message may be lost at any playback rate."""

from __future__ import annotations

from typing import Any, Final

import yaml

from trainid_ros.messages import BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, SPEED_MODEL_TOPIC, OutputTopic
from trainid_ros.records import INPUT_TOPICS

# Nodes and the topic of their estimate, in starting order.
NODES: Final = {
    'resistance_estimator': RESISTANCE_TOPIC,
    'speed_model_estimator': SPEED_MODEL_TOPIC,
    'brake_rate_estimator': BRAKE_RATE_TOPIC,
}
# More than the messages in any demo bag: a node that falls behind catches up at the end and loses none.
_DEPTH: Final = 40000
_LOSSLESS: Final = {'history': 'keep_last', 'depth': _DEPTH, 'reliability': 'reliable'}


def parameter_file() -> str:
    """Return a ROS parameter file with the QoS overrides of the three nodes."""
    return yaml.safe_dump({node: {'ros__parameters': _overrides(topic)} for node, topic in NODES.items()})


def _overrides(output: OutputTopic) -> dict[str, Any]:
    topics: dict[str, Any] = {f'/{topic.name}': {'subscription': dict(_LOSSLESS)} for topic in INPUT_TOPICS}
    topics[f'/{output.name}'] = {'publisher': dict(_LOSSLESS)}
    return {'qos_overrides': topics}
