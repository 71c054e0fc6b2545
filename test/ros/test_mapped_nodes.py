# SPDX-License-Identifier: Apache-2.0
"""Nodes with a mapping: foreign topics are found when they come, read as in a bag, and named when they cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped, Vector3Stamped  # type: ignore[import-untyped]
from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64

from test.foreign_bag import MAPPING, write_foreign
from test.ros.graph import LATCHED, START_NS, Diagnosed, Graph, Simulated, coasting, collected, feed
from trainid_ros.bag.reader import BagReader
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import load_mapping
from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.ros.inputs import ForeignTopic
from trainid_ros.ros.playback import BagPlayer
from trainid_ros.ros.topics import foreign_class
from trainid_ros.train.train_file import load_train_file

pytestmark = pytest.mark.ros

SPEED_ONLY = 'speed: {topic: /odo/twist, field: twist.linear.x, unit: km/h}\n'
SPEED = 'resistance_estimator: input /odo/twist (speed)'


@pytest.fixture
def mapping_file(tmp_path: Path) -> str:
    path = tmp_path / 'map.yaml'
    path.write_text(MAPPING, encoding='utf-8')
    return str(path)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    write_foreign(tmp_path / 'bag', coasting(150))
    return tmp_path / 'bag'


@pytest.fixture
def start(graph: Graph, train_file: str, tmp_path: Path) -> Callable[..., Any]:
    """Starts a node with a mapping."""

    def start_one(text: str, **parameters: Any) -> Any:
        (tmp_path / 'part.yaml').write_text(text, encoding='utf-8')
        return graph.active(train_file, mapping_file=str(tmp_path / 'part.yaml'), diagnostic_period=0.1, **parameters)

    return start_one


def odometer(others: Graph, kind: Any = TwistStamped) -> Callable[[], object]:
    """Return what publishes one message on the topic of the speed."""
    node = others.plain('odometer')
    publisher = node.create_publisher(kind, '/odo/twist', 10)

    def publish() -> None:
        message = kind()
        if kind is TwistStamped:
            message.twist.linear.x = 72.0
            message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    return publish


def subscribed(node: Any) -> set[str]:
    return {item.topic_name for item in node.subscriptions} - {'/clock', '/parameter_events'}


def test_live_estimates_equal_the_replay_of_the_bag_to_the_bit(
    graph: Graph, train_file: str, mapping_file: str, bag: Path
) -> None:
    nodes = graph.all(train_file, mapping_file=mapping_file)
    published, group = [collected(node) for node in nodes], nodes[0].shared.inputs
    topics = {topic.name: topic for topic in group.subscriptions}
    with BagReader(bag, inputs=mapped_inputs(Path(mapping_file), load_train_file(train_file))) as reader:
        kinds = {name: foreign_class(kind.name) for name, kind in reader.mapped_types().items()}
        for log_ns, topic, data in reader.stored():
            group.receive(topics[topic], deserialize_message(data, kinds[topic]), log_ns)
        pipelines = [node.shared.kind.pipeline(load_train_file(train_file), node._settings) for node in nodes]
        expected: list[list[Any]] = [[] for _ in pipelines]
        for record in reader.records():
            for pipeline, made in zip(pipelines, expected, strict=True):
                pipeline.take(pipeline.stream.push(record), made.append)
    assert min(map(len, expected)) > 140
    assert [[*map(repr, item)] for item in published] == [[*map(repr, made)] for made in expected]


def test_played_messages_arrive_as_they_are_in_the_bag(
    graph: Graph, others: Graph, train_file: str, mapping_file: str, bag: Path
) -> None:
    node = graph.active(train_file, mapping_file=mapping_file)
    received: dict[str, list[Any]] = {}
    receive = node.shared.inputs.receive

    def note(topic: Any, message: Any, received_ns: int) -> None:
        received.setdefault(topic.name, []).append(message)
        receive(topic, message, received_ns)

    node.shared.inputs.receive = note
    player = others.make(BagPlayer, bag=str(bag), mapping_file=mapping_file, rate=20.0, wait=1, duration=4.0)
    assert player.bring_up(), player.failure

    def done() -> bool:
        others.executor.spin_once(timeout_sec=0.0)
        return bool(player.finished)

    graph.until(done)
    with BagReader(bag, mapping=load_mapping(mapping_file)) as reader:
        kinds = {name: foreign_class(kind.name) for name, kind in reader.mapped_types().items()}
        expected: dict[str, list[Any]] = {name: [] for name in kinds}
        for log_ns, topic, data in reader.stored():
            if log_ns <= START_NS + 4 * NS_PER_S:
                expected[topic].append(deserialize_message(data, kinds[topic]))
    graph.until(lambda: sum(map(len, received.values())) >= sum(map(len, expected.values())))
    assert received == expected
    assert node.pipeline.samples > 15


def test_the_player_waits_for_the_topics_of_its_mapping_alone(graph: Graph, mapping_file: str, bag: Path) -> None:
    speed = yaml.safe_load(Path(mapping_file).read_text(encoding='utf-8'))['speed']
    Path(mapping_file).write_text(yaml.safe_dump({'speed': speed}), encoding='utf-8')
    listener = graph.plain('listener')
    with BagReader(bag, mapping=load_mapping(mapping_file)) as reader:
        for name, kind in reader.mapped_types().items():
            listener.create_subscription(foreign_class(kind.name), name, lambda _: None, 10)
    player = graph.up(BagPlayer, bag=str(bag), mapping_file=mapping_file, rate=100.0, wait=1, duration=0.5)
    assert 'ato/mass' in player._outputs  # to which nobody listens
    graph.until(lambda: player.finished)


def test_a_publisher_may_come_later_and_start_again_with_another_type(
    graph: Graph, diagnosed: Diagnosed, others: Graph, start: Callable[..., Any]
) -> None:
    node = start(SPEED_ONLY)
    assert subscribed(node) == {'/ato/force', '/ato/gradient', '/ato/brake_command', '/ato/mass'}
    assert diagnosed.until(SPEED, '').startswith('never received, no publisher, since ')
    publish = odometer(others, Float64)
    diagnosed.until(SPEED, 'Float64 has no header', publish)
    assert diagnosed.level(SPEED) == DiagnosticStatus.ERROR
    assert 'topic /odo/twist: ' in diagnosed.message(SPEED)
    assert diagnosed.message(SPEED).endswith(': correct the mapping file or this publisher')
    others.drop()
    again = Graph(graph.domain)
    publish = odometer(again)
    graph.until(lambda: publish() or diagnosed.level(SPEED) == DiagnosticStatus.OK)
    assert 'no ato/force yet' in node.shared.missing_inputs()
    assert 'odo' not in node.shared.missing_inputs()
    again.close()


def test_a_type_whose_package_is_missing_is_named(
    diagnosed: Diagnosed, others: Graph, start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr('trainid_ros.ros.topics.import_module', fail)
    start(SPEED_ONLY)
    publish = odometer(others)
    text = 'geometry_msgs/msg/TwistStamped: the package geometry_msgs is not installed here'
    assert diagnosed.until(SPEED, text, publish).endswith(': install it')
    assert diagnosed.level(SPEED) == DiagnosticStatus.ERROR


def test_a_notch_that_is_not_in_the_table_is_named(
    graph: Graph, diagnosed: Diagnosed, others: Graph, start: Callable[..., Any]
) -> None:
    start('brake_command: {topic: /notch, field: data, table: {0: 0.0, 1: -0.3}, stamp: receive}')
    name = 'resistance_estimator: input /notch (brake_command)'
    publisher = others.plain('handle').create_publisher(Float64, '/notch', 10)

    text = '/notch: 7 is not in table'
    message = diagnosed.until(name, text, lambda: publisher.publish(Float64(data=7.0)))
    assert message.endswith(': correct the mapping file or this publisher')
    graph.until(lambda: publisher.publish(Float64(data=1.0)) or 'not in table' not in diagnosed.message(name))


def test_the_time_of_reception_is_that_of_the_clock_of_the_node(
    graph: Graph, others: Graph, start: Callable[..., Any]
) -> None:
    node = start('speed: {topic: /wheel, field: data, stamp: receive}', use_sim_time=True)
    clock = Simulated(graph, node)
    clock.go(START_NS)
    publisher = others.plain('wheel').create_publisher(Float64, '/wheel', 10)
    (monitor,) = (item for item in node.shared.monitors.by_topic.values() if isinstance(item.topic, ForeignTopic))
    graph.until(lambda: publisher.publish(Float64(data=20.0)) or monitor.count)
    assert monitor.newest_ns == START_NS


def test_values_that_hold_are_latched_if_their_publisher_offers_it(
    graph: Graph, others: Graph, start: Callable[..., Any]
) -> None:
    others.plain('scales').create_publisher(Float64, '/load', LATCHED).publish(Float64(data=200.0))
    node = start('mass: {topic: /load, field: data, unit: t, stamp: receive}')
    (monitor,) = (item for item in node.shared.monitors.by_topic.values() if isinstance(item.topic, ForeignTopic))
    graph.until(lambda: monitor.count)
    assert monitor.optional


def test_relative_topics_lie_in_the_namespace_of_the_node(
    graph: Graph, others: Graph, start: Callable[..., Any]
) -> None:
    text = 'gradient: {topic: slope, field: vector.y}'
    nodes = [start(text, arguments=('-r', f'__ns:={name}')) for name in ('/train_1', '/train_2')]
    publisher = others.plain('map').create_publisher(Vector3Stamped, '/train_2/slope', 10)
    graph.until(lambda: '/train_2/slope' in subscribed(nodes[1]))
    graph.until(
        lambda: publisher.publish(Vector3Stamped()) or any(m.count for m in nodes[1].shared.monitors.by_topic.values())
    )
    assert '/train_1/slope' not in subscribed(nodes[0])


def test_a_gradient_of_the_line_waits_for_a_position(tmp_path: Path, start: Callable[..., Any]) -> None:
    train = tmp_path / 'train.yaml'
    line = 'line: {gradient: [[0.0, 1.0], [500.0, 2.0]]}\n'
    train.write_text(train.read_text(encoding='utf-8') + line, encoding='utf-8')
    node = start('gradient: {from: line}')
    assert 'no gradient of the line, as the position is not known yet' in node.shared.missing_inputs()
    feed(node, [record for record in coasting(3) if isinstance(record, SpeedRecord)])
    assert 'gradient' not in node.shared.missing_inputs()


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('speed: {topic: /x}', 'part.yaml: speed.field is missing'),
        ('gradient: {from: line}', 'no line.gradient is in the train file'),
    ],
)
def test_an_unusable_mapping_fails_to_configure(
    graph: Graph, train_file: str, tmp_path: Path, text: str, reason: str
) -> None:
    path = tmp_path / 'part.yaml'
    path.write_text(text, encoding='utf-8')
    node = graph.make(train_file=train_file, mapping_file=str(path))
    assert not node.bring_up()
    assert reason in node.failure


def test_qos_of_a_foreign_topic_can_be_overridden(graph: Graph, others: Graph, start: Callable[..., Any]) -> None:
    node = start(SPEED_ONLY, arguments=('-p', 'qos_overrides./odo/twist.subscription.depth:=7'))
    odometer(others)
    graph.until(lambda: '/odo/twist' in subscribed(node))
    (topic,) = (topic for topic in node.shared.inputs.subscriptions if isinstance(topic, ForeignTopic))
    assert node.shared.inputs.subscriptions[topic].profile.depth == 7
