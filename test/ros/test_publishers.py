# SPDX-License-Identifier: Apache-2.0
"""Which publishers of a topic are heard, and why others are not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_hash import TypeHash
from trainid_msgs.msg import AtoSpeed

from trainid_ros.ros.topics import NAMELESS, Publishers, input_qos, sort_publishers, type_name

SPEED = 'trainid_msgs/msg/AtoSpeed'


OURS, THEIRS = (str(TypeHash(1, bytes([byte] * 32))) for byte in (1, 2))


def info(name: str, kind: str = SPEED, definition: str = OURS) -> Any:
    return SimpleNamespace(
        node_namespace='/',
        node_name=name,
        topic_type=kind,
        topic_type_hash=definition,
        qos_profile=QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
    )


def test_the_name_of_a_type_is_that_of_the_graph() -> None:
    assert type_name(AtoSpeed) == SPEED


def test_publishers_with_the_type_are_heard() -> None:
    assert sort_publishers([info('b'), info('a')], SPEED, OURS, input_qos()) == Publishers(('/a', '/b'))


def test_one_with_another_type_is_named() -> None:
    found = sort_publishers([info('a'), info('odo', 'std_msgs/msg/Float64')], SPEED, OURS, input_qos())
    assert found == Publishers(('/a',), (f'/odo publishes std_msgs/msg/Float64 instead of {SPEED}',))
    assert found.count == 2


def test_one_with_another_definition_is_named_where_that_is_known() -> None:
    infos = [info('a', definition=THEIRS), info('b', definition=str(TypeHash()))]
    found = sort_publishers(infos, SPEED, OURS, input_qos())
    assert found == Publishers(('/b',), (f'/a publishes another version of {SPEED}, whose messages are misread',))
    assert sort_publishers(infos, SPEED, '', input_qos()).heard == ('/a', '/b')


def test_all_reasons_of_an_incompatible_quality_of_service_are_named() -> None:
    strict = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=1))
    (text,) = sort_publishers([info('a')], SPEED, OURS, strict).unheard
    assert text == (
        '/a has an incompatible quality of service (Volatile publisher and transient local subscription, '
        'Subscription has a deadline, but publisher does not)'
    )


def test_one_that_was_killed_counts_once_with_its_successor_which_has_no_name_at_first() -> None:
    found = sort_publishers([info('a'), info('a'), info('_NODE_NAME_UNKNOWN_')], SPEED, OURS, input_qos())
    assert (found.heard, found.at_a_time().heard) == (('/a', '/a', NAMELESS), ('/a',))
    assert Publishers((NAMELESS,)).at_a_time().heard == (NAMELESS,)
