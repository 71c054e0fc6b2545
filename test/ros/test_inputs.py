# SPDX-License-Identifier: Apache-2.0
"""Nodes of one process share subscriptions and streams; foreign topics are followed as their publishers come and go."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, TypeAlias

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from test.ros.graph import LATCHED, START_NS, Changed, Graph, coasting, collected, feed
from trainid_ros.inputs.mapping import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import FORCE_TOPIC, MASS_TOPIC, NS_PER_S, SPEED_TOPIC
from trainid_ros.ros.estimator_node import SPECS
from trainid_ros.ros.inputs import (
    ForeignTopic,
    InputSubscription,
    SharedInputs,
    foreign_qos,
    label_of,
    required_inputs,
    subscribed_topics,
)
from trainid_ros.ros.topics import foreign_class
from trainid_ros.setup.checkpoint import Checkpoint

Act: TypeAlias = Callable[[Any], object]


def inputs_of(node: Any) -> list[str]:
    return [item.topic_name for item in node.subscriptions if item.topic_name.startswith('/ato/')]


def pause(node: Any) -> None:
    node.trigger_deactivate()


def resume(node: Any) -> None:
    node.trigger_activate()


def reset(node: Any) -> None:
    node.reset_on_request(node.pipeline)


def save_and_load(node: Any) -> None:
    node.save_on_request(node.pipeline)
    node.load_on_request(node.pipeline)


def nothing(_node: Any) -> None:
    return


def run(nodes: list[Any], place: int, first: Act, second: Act) -> list[str]:
    """Return what the nodes publish when one of them is changed in mid-drive, and again later."""
    published = [collected(node) for node in nodes]
    records = coasting(240)
    jumped = coasting(40, start_ns=START_NS - 100 * NS_PER_S)
    groups = list({id(node.shared.inputs): node for node in nodes}.values())
    for part, act in ((records[:400], first), (records[403:600], second), (records[680:], nothing), (jumped, nothing)):
        for node in groups:
            feed(node, part)
        act(nodes[place])
    return [repr(outputs) for outputs in published]


@pytest.mark.ros
@pytest.mark.parametrize(
    ('place', 'actions'),
    [
        (0, (nothing, nothing)),
        *((place, actions) for place in (0, 2) for actions in ((reset, nothing), (pause, resume))),
        (2, (save_and_load, reset)),
    ],
    ids=['undisturbed', 'reset', 'paused', 'other reset', 'other paused', 'other loaded'],
)
def test_nodes_that_share_inputs_publish_what_they_publish_alone(
    graph: Graph, train_file: str, place: int, actions: tuple[Act, Act], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The time between saving and loading, which differs, widens what is published before the next sample.
    monkeypatch.setattr(Checkpoint, 'age_s', lambda *_: 0.0)
    together = graph.all(train_file)
    found = run(together, place, *actions)
    streams = {id(node.pipeline.stream) for node in together}
    assert len(streams) == (1 if actions[0] is nothing else 2)
    graph.drop()
    expected = run([graph.active(train_file, spec) for spec in SPECS.values()], place, *actions)
    assert min(map(len, expected)) > 10_000
    assert found == expected


@pytest.mark.ros
def test_one_set_of_subscriptions_serves_all_until_the_last_node_leaves(graph: Graph, train_file: str) -> None:
    nodes = graph.all(train_file)
    assert [len(inputs_of(node)) for node in nodes] == [5, 0, 0]
    for node in nodes[:2]:
        node.trigger_deactivate()
        node.trigger_cleanup()
    used = nodes[2].pipeline.samples
    feed(nodes[2], coasting(20))
    assert nodes[2].pipeline.samples > used
    assert len(inputs_of(nodes[0])) == 5
    assert nodes[1].bring_up()
    assert inputs_of(nodes[1]) == []
    for node in nodes[1:]:
        node.trigger_shutdown()
    assert inputs_of(nodes[0]) == []


@pytest.mark.ros
def test_nodes_with_other_topics_or_quality_of_service_have_their_own_subscriptions(
    graph: Graph, train_file: str
) -> None:
    inputs = SharedInputs()
    deeper = ('-p', 'qos_overrides./ato/speed.subscription.depth:=100')
    for spec, arguments, count in zip(
        SPECS.values(), (('-r', 'ato/speed:=/other/speed'), deeper, ()), (4, 5, 5), strict=True
    ):
        node = graph.make(spec, arguments=arguments, train_file=train_file)
        node._inputs = inputs
        assert node.bring_up(), node.failure
        assert len(inputs_of(node)) == count


@pytest.mark.ros
def test_an_estimator_that_fails_leaves_the_others_alone(graph: Graph, train_file: str) -> None:
    nodes = graph.all(train_file)

    def fail(_sample: object) -> None:
        raise ZeroDivisionError

    nodes[0].pipeline.estimator = Changed(nodes[0].pipeline.estimator, step=fail)
    published = [collected(node) for node in nodes]
    feed(nodes[0], coasting(20))
    assert {item.status.name for item in published[0]} == {'FAULT'}
    assert (len(published[1]), len(published[2])) == (20, 40)  # an adhesion with each brake rate
    assert 'FAULT' not in {item.status.name for item in published[1] + published[2]}


FLOAT, INT = 'std_msgs/msg/Float64', 'std_msgs/msg/Int8'
_MISSING = ('no type support',)
RELIABLE = QoSProfile(depth=1)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def publisher(kind: str, profile: QoSProfile = RELIABLE) -> Any:
    return SimpleNamespace(topic_type=kind, qos_profile=profile)


class Opened:
    """The subscriptions that a foreign topic has opened and not closed."""

    def __init__(self, topic: ForeignTopic) -> None:
        self.now: list[Any] = []
        self.foreign = InputSubscription(topic, self._open, self.now.remove)

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


def test_counts_of_publishers_alternate_or_begin_again() -> None:
    topic = ForeignTopic('/x', ('speed',))
    unknown, one, again, two = (InputSubscription(topic, lambda *_: None, lambda _: None) for _ in range(4))
    for k in range(50):
        unknown.count(None)
        one.count(100 + 2 * k)  # with losses
        again.count(k % 45 + 1)
        two.count(100 + k // 2 if k % 2 else 5 + k // 2)
    assert [subscription.may_mix for subscription in (unknown, one, again, two)] == [True, False, False, True]
