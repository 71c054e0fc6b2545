# SPDX-License-Identifier: Apache-2.0
"""A separate ROS graph for every test module that requests one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from test.hang import HANG_S
from trainid_ros.cli.processes import free_domain, local_environment
from trainid_ros.interface.records import INPUT_TOPICS, NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.ros.estimator_node import RESISTANCE, EstimatorNode
from trainid_ros.ros.topics import message_from_record, time_message

if TYPE_CHECKING:
    from trainid_ros.interface.records import InputTopic, Record

TRAIN_FILE = 'train: {mass: 194000.0, length: 118.0}\nresistance: {a: 1.5, b: 0.02, c: 0.0012}\n'
PROFILE = Path(__file__).parents[2] / 'config' / 'fastdds_localhost.xml'
START_NS = 1_700_000_000 * NS_PER_S
RESISTANCE_NODE = partial(EstimatorNode, RESISTANCE)


def coasting(count: int, start_ns: int = START_NS, speed: float = 20.0) -> list[Record]:
    """Records of a coasting train, all topics on the same stamps, with a little noise."""
    rng = np.random.default_rng(5)
    records: list[Record] = []
    for k in range(count):
        stamp = start_ns + k * NS_PER_S // 5
        records += [
            ForceRecord(stamp, 0.0),
            GradientRecord(stamp, 0.0, 0.0, False),
            BrakeRecord(stamp, 0.0, False),
            SpeedRecord(stamp, speed - 0.0045 * k + 0.01 * float(rng.standard_normal()), 4.0 * k),
        ]
    return records


def topic_of(record: Record) -> InputTopic:
    return next(topic for topic in INPUT_TOPICS if topic.record is type(record))


def feed(node: Any, records: Sequence[Record]) -> None:
    """Hand records to a node, and to those that share its inputs, as the subscriptions would."""
    for record in records:
        node._input_group.receive(topic_of(record), message_from_record(record))


class Published:
    """Collects the outputs that a node publishes."""

    def __init__(self, node: Any) -> None:
        self.messages: list[Any] = []
        serialize = node.serialize

        def collect(output: Any) -> Any:
            self.messages.append(output)
            return serialize(output)

        node.serialize = collect


class Simulated:
    """Simulated clock that can be set to any time."""

    def __init__(self, graph: Any, node: Any) -> None:
        self._graph, self._node = graph, node
        self._publisher = graph.plain('time').create_publisher(Clock, '/clock', 10)
        graph.until(self._publisher.get_subscription_count)

    def go(self, time_ns: int) -> None:
        self._publisher.publish(Clock(clock=time_message(time_ns)))
        self._graph.until(lambda: self._node.get_clock().now().nanoseconds == time_ns)
        assert self._node.get_clock().ros_time_is_active


class Graph:
    """One context with an executor that spins all its nodes until a condition holds."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        self.domain = domain
        rclpy.init(context=self.context, domain_id=domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []

    def add(self, node: Any) -> Any:
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def make(self, factory: Callable[..., Any], *, arguments: Sequence[str] = (), **parameters: object) -> Any:
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        cli = ['--ros-args', *arguments] if arguments else []
        node = factory(cli, context=self.context, cli_args=cli or None, parameter_overrides=overrides)
        return self.add(node)

    def active(self, train_file: str, factory: Any = RESISTANCE_NODE, **parameters: Any) -> Any:
        node = self.make(factory, train_file=train_file, **parameters)
        assert node.bring_up(), node.failure
        return node

    # Parameters of a resistance estimator whose prior is so narrow that it is fit to use at once.
    narrow: ClassVar[dict[str, float]] = {
        'estimator__prior_share': 0.0,
        'estimator__prior_std_a': 0.01,
        'estimator__prior_std_b': 1e-5,
        'estimator__prior_std_c': 1e-6,
    }
    start_ns = START_NS
    coasting = staticmethod(coasting)
    feed = staticmethod(feed)
    published = staticmethod(Published)

    def simulated(self, node: Any) -> Simulated:
        return Simulated(self, node)

    def plain(self, name: str) -> Any:
        return self.add(rclpy.create_node(name, context=self.context))

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + HANG_S
        while not condition():
            assert time.monotonic() < end, 'condition not met in time'
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, node: Any, kind: Any, name: str, request: Any = None) -> Any:
        client = node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        node.destroy_client(client)
        return future.result()

    def drop(self) -> None:
        for node in self._nodes:
            self.executor.remove_node(node)
            node.destroy_node()
        self._nodes = []

    def close(self) -> None:
        self.drop()
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)


@pytest.fixture(scope='module')
def _module_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    with pytest.MonkeyPatch.context() as patch:
        for variable, value in local_environment(PROFILE).items():
            patch.setenv(variable, value)
        patch.delenv('ROS_LOCALHOST_ONLY', raising=False)
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('log')))
        patch.setenv('ROS_HOME', str(tmp_path_factory.mktemp('home')))
        graph = Graph(free_domain(os.getpid()))
        yield graph
        graph.close()


@pytest.fixture
def graph(_module_graph: Graph) -> Iterator[Graph]:
    yield _module_graph
    _module_graph.drop()


@pytest.fixture
def train_file(tmp_path: Path) -> str:
    path = tmp_path / 'train.yaml'
    path.write_text(TRAIN_FILE, encoding='utf-8')
    return str(path)
