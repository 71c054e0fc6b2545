# SPDX-License-Identifier: Apache-2.0
"""A separate ROS graph for every test module that requests one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from test.ros.graph import Diagnosed, Graph
from trainid_ros.cli.processes import free_domain, local_environment

PROFILE = Path(__file__).parents[2] / 'config' / 'fastdds_localhost.xml'


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
def diagnosed(graph: Graph) -> Diagnosed:
    return Diagnosed(graph)


@pytest.fixture
def others(graph: Graph) -> Iterator[Graph]:
    """Another process, as it were: within one participant a topic has one type."""
    made = Graph(graph.domain)
    yield made
    made.close()


@pytest.fixture
def train_file(tmp_path: Path) -> str:
    path = tmp_path / 'train.yaml'
    path.write_text(
        'train: {mass: 194000.0, length: 118.0}\nresistance: {a: 1.5, b: 0.02, c: 0.0012}\n', encoding='utf-8'
    )
    return str(path)
