# SPDX-License-Identifier: Apache-2.0
"""The client in a ROS graph: late joiners, namespaces, and what happens when a node ends or goes stale."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pytest
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy

from test.ros.graph import NARROW, Graph, coasting, feed
from trainid_ros.client import TrainModel
from trainid_ros.interface.records import BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, OutputTopic
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, Status
from trainid_ros.ros.topics import fill_estimate, latched_qos, message_class, offered_estimate_qos

pytestmark = pytest.mark.ros

W = ResistanceEstimate(2.0, 0.03, 0.0012, (0.01, *[0.0] * 8), 2.4, 0.1, 10.0, 0.1, 0.01, 0.2, 3.0, 18.0, 0.1)
F = BrakeRateEstimate(0.9, 0.02, math.nan, 10.0, 0.0, 0.0, 50.0, False, 0.0, 0.01, 0.1)


class Estimates:
    """Publishes resistance and brake rate with the quality of service of the nodes."""

    def __init__(self, node: Any) -> None:
        topics = (RESISTANCE_TOPIC, BRAKE_RATE_TOPIC)
        self.live = [node.create_publisher(message_class(x), x.name, offered_estimate_qos()) for x in topics]
        self._latched = [node.create_publisher(message_class(x), x.last_valid, latched_qos()) for x in topics]

    def publish(self, status: Status = Status.VALID, *, latched: bool = True, live: bool = True) -> None:
        for k, (topic, estimate) in enumerate(((RESISTANCE_TOPIC, W), (BRAKE_RATE_TOPIC, F))):
            message = self._message(topic, estimate, status)
            for publisher, wanted in ((self.live[k], live), (self._latched[k], latched)):
                if wanted:
                    publisher.publish(message)

    @staticmethod
    def _message(topic: OutputTopic, estimate: Any, status: Status) -> Any:
        return fill_estimate(message_class(topic)(), Output(10**18, estimate, status, 5, 0, None))


def member(graph: Graph, namespace: str) -> Any:
    return graph.add(rclpy.create_node('member', namespace=namespace, context=graph.context))


@pytest.fixture
def publisher(graph: Graph) -> Iterator[subprocess.Popen[bytes]]:
    environment = os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}
    process = subprocess.Popen([sys.executable, __file__], env=environment)
    yield process
    process.kill()
    process.wait()


def test_a_late_joiner_uses_the_latched_estimate_at_once(graph: Graph, train_file: str) -> None:
    estimates = Estimates(graph.plain('estimator'))
    estimates.publish(live=False)
    model = TrainModel(graph.plain('controller'), train_file)
    assert model.brake_rate().reason == 'train file: no estimate yet'
    graph.until(lambda: model.brake_rate().live and model.resistance(10.0).live)
    # Nobody keeps it up: the estimators publish at least once a second.
    graph.until(lambda: not model.brake_rate().live)
    assert model.brake_rate().reason == 'train file: no new estimate for more than 0.75 s'


def test_a_latched_copy_does_not_count_beside_newer_estimates(graph: Graph, train_file: str) -> None:
    estimates = Estimates(graph.plain('estimator'))
    model = TrainModel(graph.plain('controller'), train_file)
    graph.until(lambda: all(publisher.get_subscription_count() for publisher in estimates.live))
    estimates.publish(Status.STALE, latched=False)
    graph.until(lambda: 'STALE' in model.brake_rate().reason)
    estimates.publish(Status.VALID, live=False)
    end = time.monotonic() + 0.3
    graph.until(lambda: time.monotonic() > end)
    assert 'STALE' in model.brake_rate().reason


def test_a_killed_node_is_replaced_by_the_train_file_within_a_second(
    graph: Graph, train_file: str, publisher: subprocess.Popen[bytes]
) -> None:
    now_s = 0.0  # goes on as the test wants, however busy the machine is

    def go_on(time_s: float) -> None:
        nonlocal now_s
        now_s += time_s

    def follow(condition: Callable[[], bool]) -> None:
        def is_met() -> bool:
            go_on(0.02)
            return condition()

        graph.until(is_met)

    model = TrainModel(member(graph, 'train_7'), train_file, clock=lambda: now_s)
    follow(lambda: model.brake_rate().live and model.brake_rate().value < 0.97)
    publisher.kill()
    go_on(0.8)
    assert not model.brake_rate().live
    go_on(0.2)
    assert (model.brake_rate().live, model.brake_rate().value) == (False, 1.0)
    assert model.resistance(10.0).live is False
    assert model.stopping_distance(20.0).reason == 'train file: no new estimate for more than 0.75 s'
    # Its lease has ended.
    follow(lambda: model.brake_rate().reason == 'train file: its node is gone')
    # Another node takes over: no jump.
    estimates, rates = Estimates(member(graph, 'train_7')), [1.0]
    graph.until(lambda: all(publisher.get_subscription_count() for publisher in estimates.live))
    while len(rates) < 30:
        go_on(0.05)
        estimates.publish()
        graph.until(lambda: model.brake_rate().live)
        rates.append(model.brake_rate().value)
    assert model.brake_rate().live
    assert 0.9 < min(rates) < 0.99
    assert max(before - after for before, after in pairwise(rates)) < 0.03


def test_a_node_without_inputs_is_replaced_by_the_train_file(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, **NARROW)
    model = TrainModel(graph.plain('controller'), train_file)
    graph.until(lambda: 'STALE' in model.resistance(10.0).reason)
    feed(node, coasting(160))
    graph.until(lambda: model.resistance(20.0).live)
    graph.until(lambda: not model.resistance(20.0).live)
    graph.until(lambda: model.resistance(20.0).reason == 'train file: STALE, inputs of the node are missing')


def test_a_publisher_that_offers_less_is_named(graph: Graph, train_file: str) -> None:
    model = TrainModel(graph.plain('controller'), train_file)
    graph.plain('other').create_publisher(
        message_class(BRAKE_RATE_TOPIC),
        BRAKE_RATE_TOPIC.name,
        QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    graph.until(lambda: 'incompatible' in model.brake_rate().reason)
    assert model.brake_rate().reason.endswith('incompatible quality of service (RELIABILITY)')


if __name__ == '__main__':  # publishes like the nodes, until it is killed
    rclpy.init()
    own = Estimates(rclpy.create_node('estimator', namespace='train_7'))
    while True:
        own.publish()
        time.sleep(0.2)
