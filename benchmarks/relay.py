# SPDX-License-Identifier: Apache-2.0
"""A bare rclpy node with the topics of the estimators that computes nothing: what the middleware alone takes.

It publishes empty estimates as soon as every input has reached the stamp of a speed.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.executors import ExternalShutdownException
from trainid_msgs import msg as trainid_msgs

from trainid_ros.interface.records import (
    INPUT_TOPICS,
    OUTPUT_TOPICS,
    REQUIRED_TOPICS,
    SPEED_TOPIC,
    InputTopic,
    stamp_of,
)
from trainid_ros.ros.topics import estimate_qos, input_qos, message_class

if TYPE_CHECKING:
    from rclpy.node import Node


class Relay:
    """Passes on the stamps of complete samples."""

    def __init__(self, node: Node) -> None:
        self._newest = dict.fromkeys(REQUIRED_TOPICS, 0)
        self._pending: list[Any] = []
        self._outputs = [
            node.create_publisher(getattr(trainid_msgs, topic.message), topic.name, estimate_qos())
            for topic in OUTPUT_TOPICS
        ]
        for topic in INPUT_TOPICS:
            node.create_subscription(message_class(topic), topic.name, partial(self._take, topic), input_qos())

    def _take(self, topic: InputTopic, message: Any) -> None:
        if topic not in self._newest:
            return
        self._newest[topic] = max(self._newest[topic], stamp_of(message))
        if topic is SPEED_TOPIC:
            self._pending.append(message)
        complete_ns = min(self._newest.values())
        while self._pending and stamp_of(self._pending[0]) <= complete_ns:
            header = self._pending.pop(0).header
            for output in self._outputs:
                output.publish(output.msg_type(header=header))


def main() -> None:
    rclpy.init()
    try:
        node = rclpy.create_node('relay')
        Relay(node)
        rclpy.spin(node)
    except ExternalShutdownException:
        return


if __name__ == '__main__':
    main()
