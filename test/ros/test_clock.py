# SPDX-License-Identifier: Apache-2.0
"""Missing inputs and jumps of stamps and clock, over a real graph."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from test.ros.graph import START_NS, Graph, Simulated, coasting, collected, feed
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason, Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.interface.records import Record

pytestmark = pytest.mark.ros


def shifted(records: Sequence[Record], seconds: float) -> list[Record]:
    """The same records at another time."""
    return [replace(record, stamp_ns=record.stamp_ns + round(seconds * NS_PER_S)) for record in records]


def test_missing_inputs_are_reported_after_the_timeout(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    published = collected(node)
    feed(node, coasting(30))
    newest = published[-1].stamp_ns
    count = len(published)
    node._watch()
    assert node._watchdog_timer.timer_period_ns < 0.9 * NS_PER_S  # it checks again within a second of the last input
    graph.until(lambda: len(published) > count)
    node._watch()
    assert [(output.status, output.stamp_ns) for output in published[count:]] == [(Status.STALE, newest)]


def test_missing_input_is_measured_on_simulated_time(graph: Graph, train_file: str) -> None:
    # Longer than the test may take: only simulated time can have passed.
    node = graph.active(train_file, use_sim_time=True, stale_after=60.0)
    clock, published, records = Simulated(graph, node), collected(node), coasting(30)
    clock.go(records[-1].stamp_ns)
    feed(node, records)
    graph.until(lambda: published)
    assert published[-1].status is not Status.STALE
    clock.go(records[-1].stamp_ns + 70 * NS_PER_S)
    graph.until(lambda: published[-1].status is Status.STALE)


@pytest.mark.parametrize(('policy', 'rejected'), [('reset', 0), ('ignore', 0), ('refuse', 4 * 189)])
def test_a_looped_bag_follows_the_policy(graph: Graph, train_file: str, policy: str, rejected: int) -> None:
    node = graph.active(train_file, use_sim_time=True, time_jump_policy=policy)
    clock, records = Simulated(graph, node), coasting(200)
    clock.go(START_NS)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    used = node.pipeline.used
    assert node.status_changes.since_ns >= START_NS
    clock.go(START_NS)  # the bag starts over
    assert node.running_pipeline() is node.pipeline
    assert node.status_changes.since_ns == 0
    feed(node, records)
    # A step of less than an hour loses nothing. Stamps within max_jump_back of the end are late, not a jump.
    assert (node.pipeline.resets, node.pipeline.rejections[Reason.STAMP_JUMP]) == (0, rejected)
    assert (node.pipeline.used > used) == (policy != 'refuse')


def test_stamps_that_jump_back_before_the_clock_reset_only_once(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    clock.go(records[-1].stamp_ns + 7200 * NS_PER_S)
    feed(node, shifted(records, 7200.0))
    feed(node, records[:40])
    assert node.pipeline.resets == 1
    clock.go(START_NS)
    feed(node, records[40:])
    assert node.pipeline.resets == 1


def test_a_small_step_back_of_the_clock_changes_nothing(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = Simulated(graph, node), coasting(100)
    feed(node, records)
    clock.go(records[-1].stamp_ns)
    clock.go(records[-1].stamp_ns - NS_PER_S)
    feed(node, shifted(records, 20.0))
    assert node.pipeline.resets == 0
