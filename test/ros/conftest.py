# SPDX-License-Identifier: Apache-2.0
"""A separate ROS graph for every test module that requests one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from trainid_ros.demo.domain import free_domain

TRAIN_FILE = 'train: {mass: 194000.0, length: 118.0}\nresistance: {a: 1.5, b: 0.02, c: 0.0012}\n'
# Reached only by failures: a busy machine may stall a process for seconds.
DEADLINE_S = 50.0


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

    def plain(self, name: str) -> Any:
        return self.add(rclpy.create_node(name, context=self.context))

    def until(self, condition: Callable[[], object], deadline_s: float = DEADLINE_S) -> None:
        end = time.monotonic() + deadline_s
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
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
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
