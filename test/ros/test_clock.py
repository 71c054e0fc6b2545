# SPDX-License-Identifier: Apache-2.0
"""Missing inputs and jumps of stamps and clock, over a real graph."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.interface.records import Record

pytestmark = pytest.mark.ros

Graph: TypeAlias = Any  # the fixture of conftest.py


def shifted(records: Sequence[Record], seconds: float) -> list[Record]:
    """The same records at another time."""
    return [replace(record, stamp_ns=record.stamp_ns + round(seconds * NS_PER_S)) for record in records]


def test_missing_inputs_are_reported_after_the_timeout(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file)
    published = graph.published(node)
    graph.feed(node, graph.coasting(30))
    newest = published.messages[-1].stamp_ns
    count = len(published.messages)
    node._watch()
    assert node._watchdog_timer.timer_period_ns < 0.9 * NS_PER_S  # it checks again within a second of the last input
    graph.until(lambda: len(published.messages) > count)
    node._watch()
    assert [(output.status, output.stamp_ns) for output in published.messages[count:]] == [(Status.STALE, newest)]


def test_missing_inputs_are_reported_without_any_sample(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, stale_after=0.1)
    published = graph.published(node)
    graph.feed(node, graph.coasting(1)[:3])  # no speed, no sample
    graph.until(lambda: published.messages)
    node._watch()
    assert [(message.status, message.stamp_ns) for message in published.messages] == [(Status.STALE, 0)]


def test_missing_input_is_measured_on_simulated_time(graph: Graph, train_file: str) -> None:
    # Longer than the test may take: only simulated time can have passed.
    node = graph.active(train_file, use_sim_time=True, stale_after=60.0)
    clock, published, records = graph.simulated(node), graph.published(node), graph.coasting(30)
    clock.go(records[-1].stamp_ns)
    graph.feed(node, records)
    graph.until(lambda: published.messages)
    assert published.messages[-1].status is not Status.STALE
    clock.go(records[-1].stamp_ns + 70 * NS_PER_S)
    graph.until(lambda: published.messages[-1].status is Status.STALE)


@pytest.mark.parametrize(('policy', 'resets', 'rejected'), [('reset', 0, 0), ('ignore', 0, 0), ('refuse', 0, 4 * 189)])
def test_a_looped_bag_follows_the_policy(
    graph: Graph, train_file: str, policy: str, resets: int, rejected: int
) -> None:
    node = graph.active(train_file, use_sim_time=True, time_jump_policy=policy)
    clock, records = graph.simulated(node), graph.coasting(200)
    clock.go(graph.start_ns)
    graph.feed(node, records)
    clock.go(records[-1].stamp_ns)
    used = node.pipeline.used
    assert node.status_changes.since_ns >= graph.start_ns
    clock.go(graph.start_ns)  # the bag starts over
    assert node.running_pipeline() is node.pipeline
    assert node.status_changes.since_ns == 0
    graph.feed(node, records)
    pipeline = node.pipeline
    assert pipeline.resets == resets
    jumps = sum(count for reason, count in pipeline.rejections.items() if reason.name == 'STAMP_JUMP')
    if policy in ('reset', 'ignore'):  # a step of less than an hour loses nothing
        assert (pipeline.used > used, jumps) == (True, rejected)
    else:
        # Stamps within max_jump_back of the end are late or duplicate, not a jump.
        assert (pipeline.used, jumps) == (used, rejected)


def test_stamps_that_jump_back_before_the_clock_reset_only_once(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = graph.simulated(node), graph.coasting(100)
    clock.go(records[-1].stamp_ns + 7200 * NS_PER_S)
    graph.feed(node, shifted(records, 7200.0))
    graph.feed(node, records[:40])
    assert node.pipeline.resets == 1
    clock.go(graph.start_ns)
    graph.feed(node, records[40:])
    assert node.pipeline.resets == 1


def test_a_small_step_back_of_the_clock_changes_nothing(graph: Graph, train_file: str) -> None:
    node = graph.active(train_file, use_sim_time=True)
    clock, records = graph.simulated(node), graph.coasting(100)
    graph.feed(node, records)
    clock.go(records[-1].stamp_ns)
    clock.go(records[-1].stamp_ns - NS_PER_S)
    graph.feed(node, shifted(records, 20.0))
    assert node.pipeline.resets == 0
