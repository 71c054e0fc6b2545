# SPDX-License-Identifier: Apache-2.0
"""Estimates published with the quality of service of the nodes; as a program, until it is killed."""

from __future__ import annotations

import math
import time
from typing import Any

import rclpy

from trainid_ros.interface.records import BRAKE_RATE_TOPIC, NS_PER_S, RESISTANCE_TOPIC
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, Status
from trainid_ros.ros.topics import estimate_message, latched_qos, message_class, offered_estimate_qos

W = ResistanceEstimate(2.0, 0.03, 0.0012, (0.01, *[0.0] * 8), 2.4, 0.1, 10.0, 0.1, 0.01, 0.2, 3.0, 18.0, 0.1)
F = BrakeRateEstimate(0.9, 0.02, math.nan, 10.0, 0.0, 0.0, 50.0, False, 0.0, 0.01, 0.1)


class Estimates:
    """Publishes resistance and brake rate, with stamps that are late by a time [s]."""

    def __init__(self, node: Any, late_s: float = 0.0) -> None:
        topics = (RESISTANCE_TOPIC, BRAKE_RATE_TOPIC)
        self.live = [node.create_publisher(message_class(x), x.name, offered_estimate_qos()) for x in topics]
        self._clock, self._late_ns = node.get_clock(), round(late_s * NS_PER_S)
        self._latched = [node.create_publisher(message_class(x), x.last_valid, latched_qos()) for x in topics]

    def publish(self, status: Status = Status.VALID, *, latched: bool = True, live: bool = True) -> None:
        for k, estimate in enumerate((W, F)):
            message = self._message(estimate, status)
            for publisher, wanted in ((self.live[k], live), (self._latched[k], latched)):
                if wanted:
                    publisher.publish(message)

    def _message(self, estimate: Any, status: Status) -> Any:
        stamp_ns = self._clock.now().nanoseconds - self._late_ns
        return estimate_message(Output(stamp_ns, estimate, status, 5, 0, None))


if __name__ == '__main__':
    rclpy.init()
    own = Estimates(rclpy.create_node('estimator', namespace='train_7'))
    while True:
        own.publish()
        time.sleep(0.2)
