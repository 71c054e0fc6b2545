# SPDX-License-Identifier: Apache-2.0
"""A ROS graph of its own for tests, with what they feed into nodes and collect from them."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from trainid_msgs.msg import ResistanceEstimate

from test.hang import HANG_S
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    Record,
    SpeedRecord,
    input_topic,
)
from trainid_ros.ros.diagnostics import EstimatorSpec
from trainid_ros.ros.estimator_node import RESISTANCE, SPECS, EstimatorNode
from trainid_ros.ros.inputs import SharedInputs
from trainid_ros.ros.topics import message_from_record, time_message

START_NS: Final = 1_700_000_000 * NS_PER_S
OWN: Final = 'resistance_estimator: estimator'
# Parameters of a resistance estimator whose prior is so narrow that it is fit to use at once.
NARROW: Final[dict[str, Any]] = {
    'estimator__prior_share': 0.0,
    'estimator__prior_std_a': 0.01,
    'estimator__prior_std_b': 1e-5,
    'estimator__prior_std_c': 1e-6,
}
LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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


def feed(node: Any, records: Sequence[Record]) -> None:
    """Hand records to a node, and to those that share its inputs, as the subscriptions would."""
    for record in records:
        node.shared.inputs.receive(input_topic(record), message_from_record(record))


def collected(node: Any) -> list[Any]:
    """Return the list that the outputs of a node go to as it publishes them."""
    outputs: list[Any] = []
    serialize = node.serialize

    def collect(output: Any) -> Any:
        outputs.append(output)
        return serialize(output)

    node.serialize = collect
    return outputs


def cycle(node: Any) -> None:
    """Take a node down, and up again."""
    node.trigger_deactivate()
    node.trigger_cleanup()
    assert node.bring_up(), node.failure


class Changed:
    """An object with some of its attributes replaced."""

    def __init__(self, original: Any, **changes: object) -> None:
        self._original = original
        self.__dict__.update(changes)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


class Simulated:
    """Simulated clock that can be set to any time."""

    def __init__(self, graph: Graph, node: Any) -> None:
        self._graph, self._node = graph, node
        self._publisher = graph.plain('time').create_publisher(Clock, '/clock', 10)
        graph.until(self._publisher.get_subscription_count)

    def go(self, time_ns: int) -> None:
        self._publisher.publish(Clock(clock=time_message(time_ns)))
        self._graph.until(lambda: self._node.get_clock().now().nanoseconds == time_ns)
        assert self._node.get_clock().ros_time_is_active


class Diagnosed:
    """The newest diagnostics by name."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self.by_name: dict[str, Any] = {}
        self.said: list[str] = []  # All names and messages so far
        graph.plain('display').create_subscription(DiagnosticArray, '/diagnostics', self._note, 10)

    def _note(self, message: Any) -> None:
        self.by_name |= {status.name: status for status in message.status}
        self.said += [f'{status.name}: {status.message}' for status in message.status]

    def level(self, name: str) -> Any:
        return self.by_name[name].level if name in self.by_name else None

    def message(self, name: str) -> str:
        return str(self.by_name[name].message) if name in self.by_name else ''

    def values(self, name: str) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.by_name[name].values} if name in self.by_name else {}

    def until(self, name: str, text: str, act: Callable[[], object] = lambda: None) -> str:
        """Wait until a status says this, after doing something each time; return all it says."""
        self._graph.until(lambda: act() or (name in self.by_name and text in self.message(name)))
        return self.message(name)


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

    def make(self, kind: Any = RESISTANCE, *, arguments: Sequence[str] = (), **parameters: object) -> Any:
        """Return a node of an estimator, or of a class."""
        factory = partial(EstimatorNode, kind) if isinstance(kind, EstimatorSpec) else kind
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        cli = ['--ros-args', *arguments] if arguments else []
        return self.add(factory(cli, context=self.context, cli_args=cli or None, parameter_overrides=overrides))

    def up(self, kind: Any = RESISTANCE, **options: Any) -> Any:
        """Return a node that is active."""
        node = self.make(kind, **options)
        assert node.bring_up(), node.failure
        return node

    def active(self, train_file: str, kind: Any = RESISTANCE, **options: Any) -> Any:
        return self.up(kind, train_file=train_file, **options)

    def all(self, train_file: str, **options: Any) -> list[Any]:
        """Return the active nodes of all estimators, which share their inputs."""
        inputs, nodes = SharedInputs(), []
        for spec in SPECS.values():
            nodes.append(self.make(spec, train_file=train_file, **options))
            nodes[-1]._inputs = inputs
            assert nodes[-1].bring_up(), nodes[-1].failure
        return nodes

    def latched(self, name: str = 'listener') -> list[Any]:
        """Return the list that latched resistances go to."""
        got: list[Any] = []
        topic = 'trainid/last_valid/resistance'
        self.plain(name).create_subscription(ResistanceEstimate, topic, got.append, LATCHED)
        return got

    def plain(self, name: str) -> Any:
        return self.add(rclpy.create_node(name, context=self.context))

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + HANG_S
        while not condition():
            assert time.monotonic() < end, 'condition not met in time'
            self.executor.spin_once(timeout_sec=0.02)

    def spin(self, count: int) -> None:
        for _ in range(count):
            self.executor.spin_once(timeout_sec=0.01)

    def call(self, node: Any, kind: Any, name: str, request: Any = None) -> Any:
        client = node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        node.destroy_client(client)
        return future.result()

    def end(self, node: Any) -> None:
        """Deactivate a node, and drop all."""
        node.trigger_deactivate()
        self.drop()

    def drop(self) -> None:
        for node in self._nodes:
            self.executor.remove_node(node)
            node.destroy_node()
        self._nodes = []

    def close(self) -> None:
        self.drop()
        self.executor.shutdown()
        rclpy.shutdown(context=self.context)
