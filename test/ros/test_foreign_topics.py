# SPDX-License-Identifier: Apache-2.0
"""Types and quality of service of foreign topics, as their publishers come and go."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from trainid_ros.inputs.mapping import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import FORCE_TOPIC, MASS_TOPIC, NS_PER_S, SPEED_TOPIC
from trainid_ros.ros.inputs import (
    ForeignSubscription,
    ForeignTopic,
    foreign_qos,
    label_of,
    required_inputs,
    subscribed_topics,
)
from trainid_ros.ros.topics import foreign_class

FLOAT, INT = 'std_msgs/msg/Float64', 'std_msgs/msg/Int8'
_MISSING = ('no type support',)
RELIABLE = QoSProfile(depth=1)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def publisher(kind: str, profile: QoSProfile = RELIABLE) -> Any:
    return SimpleNamespace(topic_type=kind, qos_profile=profile)


class Opened:
    """The subscriptions that a foreign topic has opened and not closed."""

    def __init__(self, topic: ForeignTopic) -> None:
        self.now: list[Any] = []
        self.foreign = ForeignSubscription(topic, self._open, self.now.remove)

    def _open(self, kind: Any, profile: QoSProfile) -> Any:
        self.now.append(SimpleNamespace(kind=kind.__name__, qos_profile=profile))
        return self.now[-1]

    def follow(self, steady_s: float, *publishers: Any) -> str:
        self.foreign.follow(publishers, round(steady_s * NS_PER_S))
        return ' '.join(item.kind for item in self.now)


def test_the_topics_of_a_mapping_replace_our_own() -> None:
    text = """
speed: {topic: /odom, field: x}
position: {topic: /odom, field: y}
force: {sum: [{topic: car, field: x}, {topic: car, field: y}]}
gradient: {from: line}
"""
    topics = subscribed_topics(parse_mapping(text, 'map.yaml'))
    assert [label_of(topic) for topic in topics] == [
        'ato/brake_command', 'ato/mass', '/odom (speed, position)', 'car (force)'
    ]  # fmt: skip
    assert [required_inputs(topic) for topic in topics[1:]] == [(), (SPEED_TOPIC,), (FORCE_TOPIC,)]
    assert MASS_TOPIC in topics


@pytest.mark.parametrize(
    ('name', 'reason'),
    [
        ('nobody_msgs/msg/Speed', 'the package nobody_msgs is not installed here'),
        ('std_msgs/msg/Speed', 'the package std_msgs that is installed here has no such type'),
        ('os.path/msg/Speed', 'is not a type of messages'),
        ('std_srvs/srv/Trigger', 'is not a type of messages'),
    ],
)
def test_a_type_that_cannot_be_imported_is_named(name: str, reason: str) -> None:
    assert foreign_class(FLOAT) is Float64
    with pytest.raises(InputError, match=f'{name}.*{reason}'):
        foreign_class(name)


def test_the_subscription_follows_the_type_of_the_publisher() -> None:
    opened = Opened(ForeignTopic('/x', ('speed',)))
    assert opened.follow(0.0) == ''
    assert opened.follow(1.0, publisher(FLOAT)) == 'Float64'
    assert opened.follow(2.0) == 'Float64'  # it may come again
    assert opened.follow(3.0, publisher('nobody_msgs/msg/Speed')) == ''
    assert 'not installed' in opened.foreign.problem
    assert opened.follow(4.0, publisher(INT)) == 'Int8'
    assert opened.foreign.problem == ''


def test_a_type_that_cannot_be_subscribed_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = Opened(ForeignTopic('/x', ('speed',)))

    def fail(*_: object) -> None:
        raise RuntimeError(*_MISSING)

    with monkeypatch.context() as patch:
        patch.setattr(opened.foreign, '_open', fail)
        assert opened.follow(0.0, publisher(FLOAT)) == ''
    found = opened.foreign.unreadable()
    assert found is not None
    assert found.unheard == (f'{FLOAT}: cannot be subscribed (no type support)',)
    assert opened.follow(0.3, publisher(FLOAT)) == 'Float64'
    assert opened.foreign.unreadable() is None


def test_a_type_of_a_killed_publisher_is_left_when_no_messages_come() -> None:
    opened = Opened(ForeignTopic('/x', ('speed',)))
    both = publisher(FLOAT), publisher(INT)
    assert opened.follow(10.0, both[0]) == 'Float64'
    opened.foreign.arrived('', 11 * NS_PER_S)
    assert opened.follow(11.5, *both) == 'Float64'
    assert opened.follow(12.5, *both) == 'Int8'
    opened.foreign.arrived('', 14 * NS_PER_S)
    assert opened.follow(14.5, *both) == 'Int8'


def test_a_subscription_promises_what_all_publishers_offer_only_where_values_hold() -> None:
    load, speed = ForeignTopic('/load', ('mass',)), ForeignTopic('/x', ('speed', 'mass'))
    for topic, offered, expected in (
        (load, (LATCHED,), (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)),
        (load, (LATCHED, RELIABLE), (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)),
        (load, (LATCHED, BEST_EFFORT), (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)),
        (speed, (LATCHED,), (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)),
    ):
        profile = foreign_qos(topic, offered)
        assert (profile.reliability, profile.durability) == expected
