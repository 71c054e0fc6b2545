# SPDX-License-Identifier: Apache-2.0
"""The policy for SROS 2 holds what the nodes use, and nothing else; without keys nothing runs unprotected."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from test.ros.graph import Graph
from trainid_ros.client import TrainModel
from trainid_ros.ros.estimator_node import SPECS
from trainid_ros.ros.train_monitor import TrainMonitor

FILE = Path(__file__).parents[2] / 'config' / 'sros2_policy.xml'


def granted(enclave: str, node: str) -> dict[str, set[str]]:
    """The full names that the policy grants to a node, by right."""
    rights: dict[str, set[str]] = {}
    for group in ElementTree.parse(FILE).find(f".//enclave[@path='{enclave}']//profile[@node='{node}']") or ():
        (right,) = group.attrib
        rights[right] = {full_name(item.text or '', node) for item in group}
    return rights


def used_by(node: Any) -> dict[str, set[str]]:
    """The full names that a node uses, by right; it may call no services."""
    name, space = node.get_name(), node.get_namespace()
    assert not node.get_client_names_and_types_by_node(name, space)
    used = {
        'publish': {topic for topic, _ in node.get_publisher_names_and_types_by_node(name, space)},
        'subscribe': {topic for topic, _ in node.get_subscriber_names_and_types_by_node(name, space)},
        'reply': {service for service, _ in node.get_service_names_and_types_by_node(name, space)},
    }
    return {right: names for right, names in used.items() if names}


def full_name(name: str, node: str) -> str:
    return name if name.startswith('/') else f'/{node}{name[1:]}' if name.startswith('~') else f'/{name}'


def test_the_policy_has_an_enclave_for_each_process_and_no_other() -> None:
    enclaves = {item.get('path'): item.findall('.//profile') for item in ElementTree.parse(FILE).iter('enclave')}
    nodes = {path: [item.get('node') for item in profiles] for path, profiles in enclaves.items()}
    assert nodes == {
        '/trainid': list(SPECS),
        **{f'/trainid/{name}': [name] for name in SPECS},
        '/trainid/monitor': ['trainid_monitor'],
        '/trainid/controller': ['ato_controller'],
    }
    assert {item.get('ns') for profiles in enclaves.values() for item in profiles} == {'/'}


def test_the_policy_only_allows_topics_and_answers() -> None:
    groups = [group for item in ElementTree.parse(FILE).iter('profile') for group in item]
    found = {(group.tag, tuple(group.attrib.items()), frozenset(item.tag for item in group)) for group in groups}
    assert found == {
        ('topics', (('publish', 'ALLOW'),), frozenset({'topic'})),
        ('topics', (('subscribe', 'ALLOW'),), frozenset({'topic'})),
        ('services', (('reply', 'ALLOW'),), frozenset({'service'})),
    }


@pytest.mark.ros
@pytest.mark.parametrize('name', list(SPECS))
def test_a_node_uses_exactly_what_the_policy_grants(graph: Graph, train_file: str, name: str) -> None:
    node = graph.active(train_file, SPECS[name])
    assert granted(f'/trainid/{name}', name) == granted('/trainid', name) == used_by(node)


@pytest.mark.ros
def test_the_monitor_uses_exactly_what_the_policy_grants(graph: Graph) -> None:
    monitor = graph.add(TrainMonitor((), '', context=graph.context))
    monitor._subscribe('/')
    assert granted('/trainid/monitor', 'trainid_monitor') == used_by(monitor)


@pytest.mark.ros
def test_a_controller_uses_exactly_what_the_policy_grants(graph: Graph, train_file: str) -> None:
    node = graph.plain('ato_controller')
    model = TrainModel(node, train_file)
    used = used_by(node)
    used['subscribe'].add('/parameter_events')  # by nodes in C++
    assert granted('/trainid/controller', 'ato_controller') == used
    assert model is not None


TRAIN = Path(__file__).parents[2] / 'bags' / 'tiny' / 'train.yaml'
NODE = 'import sys; from trainid_ros.ros.estimator_node import resistance_main; sys.exit(resistance_main())'
COMMANDS = {
    'resistance_estimator': ('-c', NODE),
    'run': ('-m', 'trainid_ros.cli.main', 'run', '--train', str(TRAIN)),
    'monitor': ('-m', 'trainid_ros.cli.main', 'monitor'),
}


@pytest.mark.ros
@pytest.mark.parametrize('has_enclave', [True, False])
@pytest.mark.parametrize('name', COMMANDS)
def test_without_keys_nothing_starts_and_the_last_line_says_why(tmp_path: Path, name: str, has_enclave: bool) -> None:
    folder = tmp_path / 'enclaves' / 'trainid'
    (folder if has_enclave else tmp_path).mkdir(parents=True, exist_ok=True)
    secure = {'ROS_SECURITY_KEYSTORE': str(tmp_path), 'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce'}
    command = [sys.executable, *COMMANDS[name], '--ros-args', '--enclave', '/trainid']
    done = subprocess.run(command, env=os.environ | secure, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    # Before it, ROS itself may say where it looks for keys, and what it cannot close.
    assert 'ROS cannot start' in done.stderr.splitlines()[-1]
    assert 'Traceback' not in done.stderr
