# SPDX-License-Identifier: Apache-2.0
"""The client in a ROS graph: late joiners, namespaces, and what happens when a node ends or goes stale."""

from __future__ import annotations

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

from test.ros import published_estimates
from test.ros.graph import NARROW, Graph, coasting, feed
from test.ros.published_estimates import Estimates
from trainid_ros.client import TrainModel
from trainid_ros.client.arguments import MAX_STAMP_AGE
from trainid_ros.interface.records import BRAKE_RATE_TOPIC
from trainid_ros.interface.results import Status
from trainid_ros.ros.topics import message_class

pytestmark = pytest.mark.ros


def member(graph: Graph, namespace: str) -> Any:
    return graph.add(rclpy.create_node('member', namespace=namespace, context=graph.context))


@pytest.fixture
def publisher(graph: Graph) -> Iterator[subprocess.Popen[bytes]]:
    environment = os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}
    process = subprocess.Popen([sys.executable, published_estimates.__file__], env=environment)
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
    model = TrainModel(graph.plain('controller'), train_file, max_stamp_age=MAX_STAMP_AGE.high)
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


def test_two_publishers_bring_the_train_file_back_until_one_is_left(graph: Graph, train_file: str) -> None:
    estimates, others = (Estimates(graph.plain(name)) for name in ('estimator', 'bag'))
    model = TrainModel(graph.plain('controller'), train_file)
    publishers = [*estimates.live, *others.live]
    graph.until(lambda: all(publisher.get_subscription_count() for publisher in publishers))

    def reason(*sources: Estimates) -> str:
        for source in sources:
            source.publish(latched=False)
        graph.spin(6)  # takes in what was published
        return model.brake_rate().reason

    graph.until(lambda: 'two publishers' in reason(estimates, estimates, others))
    assert model.brake_rate().reason.startswith('train file: trainid/brake_rate has two publishers')
    assert not model.resistance(10.0).live
    graph.until(lambda: reason(estimates).startswith('VALID'))


def test_a_bag_of_another_day_is_not_believed(graph: Graph, train_file: str) -> None:
    estimates = Estimates(graph.plain('bag'), late_s=3600.0)
    model = TrainModel(graph.plain('controller'), train_file)
    graph.until(lambda: all(publisher.get_subscription_count() for publisher in estimates.live))
    estimates.publish(latched=False)
    graph.until(lambda: 's behind the clock' in model.brake_rate().reason)
    assert model.brake_rate().reason.endswith('is a bag played without use_sim_time?')
    assert not model.brake_rate().live
