# SPDX-License-Identifier: Apache-2.0
"""What a subscriber can rely on: promised quality of service, a heartbeat, and what is latched."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import pytest
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import LivelinessPolicy, QoSProfile
from trainid_msgs.msg import ResistanceEstimate

from test.ros.graph import NARROW, START_NS, Graph, coasting, collected, feed
from tools.documents import ROOT, blocks
from trainid_ros.interface.results import Status
from trainid_ros.ros.topics import DEADLINE_S, LEASE_S, LIFESPAN_S, time_message

pytestmark = pytest.mark.ros


class Subscriber:
    """A strict subscriber of the resistance: its messages with their times, and the events of its middleware.

    Times are ticks of a timer at 10 Hz in the process of the node: where that is kept waiting, so are they.
    """

    def __init__(self, graph: Graph, deadline_s: float = DEADLINE_S) -> None:
        self.messages: list[Any] = []
        self.ticks: list[int] = []
        self._ticks = 0
        self.events: list[str] = []
        profile = QoSProfile(
            depth=50,
            deadline=Duration(seconds=deadline_s),
            liveliness=LivelinessPolicy.AUTOMATIC,
            liveliness_lease_duration=Duration(seconds=LEASE_S),
        )
        callbacks = SubscriptionEventCallbacks(
            deadline=lambda _: self.events.append('deadline missed'),
            liveliness=lambda event: self.events.append(f'alive {event.alive_count}'),
            incompatible_qos=lambda _: self.events.append('incompatible'),
        )
        node = graph.plain('strict')
        node.create_timer(0.1, self._tick)
        node.create_subscription(
            ResistanceEstimate, 'trainid/resistance', self._take, profile, event_callbacks=callbacks
        )

    def _take(self, message: Any) -> None:
        self.messages.append(message)
        self.ticks.append(self._ticks)

    def _tick(self) -> None:
        self._ticks += 1

    @property
    def statuses(self) -> list[Status]:
        return [Status(message.status) for message in self.messages]


def test_a_strict_subscriber_hears_an_active_node_at_least_once_a_second(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    subscriber = Subscriber(graph)
    graph.until(lambda: subscriber.messages)  # inputs have never come
    assert subscriber.messages[0].header.stamp == time_message(0)
    feed(node, coasting(12))
    graph.until(lambda: len(subscriber.messages) >= 1 + 12 + 2)
    assert [status is Status.STALE for status in subscriber.statuses] == [True, *[False] * 12, True, True]
    assert subscriber.messages[-1] == subscriber.messages[-2]
    assert max(after - before for before, after in pairwise(subscriber.ticks)) < 15
    assert 'incompatible' not in subscriber.events


def test_a_fault_is_repeated_too(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    node.fail(node.pipeline, 'tried')
    node.announce(node.pipeline)
    subscriber = Subscriber(graph)
    graph.until(lambda: len(subscriber.messages) > 1)
    assert set(subscriber.statuses) == {Status.FAULT}


def test_promises_are_offered_and_can_be_overridden(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    offered, latched = node.publisher.live.qos_profile, node.publisher.last_valid.qos_profile
    assert offered.deadline == Duration(seconds=DEADLINE_S)
    assert offered.lifespan == Duration(seconds=LIFESPAN_S)
    assert offered.liveliness == latched.liveliness == LivelinessPolicy.AUTOMATIC
    assert offered.liveliness_lease_duration == latched.liveliness_lease_duration == Duration(seconds=LEASE_S)
    # A late joiner gets the latched estimate however old it is.
    assert latched.lifespan == latched.deadline == QoSProfile(depth=1).lifespan
    graph.drop()
    name = 'qos_overrides./trainid/resistance.publisher'
    arguments = ('-p', f'{name}.deadline:=300000000', '-p', f'{name}.liveliness_lease_duration:=500000000')
    offered = graph.active(train_file, arguments=arguments).publisher.live.qos_profile
    assert (offered.deadline.nanoseconds, offered.liveliness_lease_duration.nanoseconds) == (300_000_000, 500_000_000)


def test_a_subscriber_that_asks_for_more_is_named_once_in_the_log(
    graph: Graph, train_file: str, capfd: pytest.CaptureFixture[str]
) -> None:
    graph.active(train_file)
    subscriber = Subscriber(graph, deadline_s=0.1)
    graph.until(lambda: subscriber.events)
    end = time.monotonic() + 1.5
    graph.until(lambda: time.monotonic() > end)
    logged = [line.partition('[resistance_estimator]: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert (subscriber.events, subscriber.messages) == (['incompatible'], [])
    assert [text for text in logged if 'QoS' in text or 'deadline' in text] == [
        'trainid/resistance: a subscriber has an incompatible QoS (DEADLINE); no messages are exchanged with it'
    ]


def test_a_late_joiner_gets_the_last_valid_estimate_and_learns_that_it_is_not_kept_up(
    graph: Graph, train_file: str
) -> None:
    node = graph.active(train_file, **NARROW, stale_after=4.0)
    published = collected(node)
    feed(node, coasting(160))
    valid = [output for output in published if output.status is Status.VALID][-1]
    got = graph.latched()
    graph.until(lambda: got)
    assert got[0].header.stamp == time_message(valid.stamp_ns)
    assert (got[0].a, Status(got[0].status)) == (valid.estimate.a, Status.VALID)
    graph.until(lambda: node.pipeline.status is Status.STALE)
    got = graph.latched('later')
    graph.until(lambda: got)
    assert Status(got[0].status) is Status.STALE
    feed(node, coasting(160, start_ns=START_NS + 60_000_000_000))
    graph.until(lambda: Status(got[-1].status) is Status.VALID)


def test_the_tutorial_shows_what_the_graph_says(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, arguments=['-r', '__ns:=/train_1'])
    text = (ROOT / 'docs' / 'tutorial_integrator.md').read_text(encoding='utf-8')
    (shown,) = (block.text for block in blocks(text) if block.text.startswith('Node name: '))
    topic = '/train_1/trainid/resistance'
    graph.until(lambda: node.get_publishers_info_by_topic(topic))
    (info,) = node.get_publishers_info_by_topic(topic)
    assert set(shown.splitlines()) <= set(str(info).splitlines())
