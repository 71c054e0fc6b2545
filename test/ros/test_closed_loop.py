# SPDX-License-Identifier: Apache-2.0
"""An ATO that stops by the estimates of nodes in another process."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy

from ato.days import drive_day
from test.ros.graph import Graph
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.interface.records import BRAKE_RATE_TOPIC, NS_PER_S, RESISTANCE_TOPIC, OutputTopic, stamp_of
from trainid_ros.ros.topics import message_class
from trainid_ros.train.train_file import dump_train_file

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'python' / 'closed_loop.py'
example = SimpleNamespace(**runpy.run_path(str(EXAMPLE), run_name='example'))
SEED, RUNS, RATE = 4, 3, 60.0  # as fast as the nodes, on any machine
# Age of the newest estimate of nodes that keep pace, and wait for one that is lost [s].
LATEST_S, LOST_S = 0.6, 0.5


@pytest.fixture
def nodes(graph: Graph, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    path = tmp_path / 'day.yaml'
    path.write_text(dump_train_file(example.day('tram', RUNS, SEED).case.stated), encoding='utf-8')
    command = [sys.executable, '-m', 'trainid_ros.cli.main', 'run', '--train', str(path)]
    with subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}) as process:
        yield process
        process.terminate()


class InStep(example.NodeValues):  # type: ignore[name-defined]
    """Waits at each tick until the nodes have taken in what was published, however busy the machine is."""

    def __init__(self, node: Any, *arguments: Any) -> None:
        super().__init__(node, *arguments)
        self._newest_s = dict.fromkeys((RESISTANCE_TOPIC, BRAKE_RATE_TOPIC), 0.0)
        for topic in self._newest_s:
            node.create_subscription(message_class(topic), topic.name, partial(self._note, topic), 10)

    def _note(self, topic: OutputTopic, message: Any) -> None:
        self._newest_s[topic] = stamp_of(message) / NS_PER_S

    def values(self) -> Any:
        """Wait for an estimate that is as new as in real time, but only shortly: a message may be lost."""
        end = time.monotonic() + LOST_S
        while self._now_s - min(self._newest_s.values()) > LATEST_S and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.01)
        return super().values()


@pytest.mark.usefixtures('nodes')
def test_it_stops_as_well_as_in_one_process(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(example.drive.__globals__, 'NodeValues', InStep)
    plan = example.day('tram', RUNS, SEED)
    node = rclpy.create_node('ato', context=graph.context)
    try:
        graph.until(lambda: node.count_subscribers('ato/speed') > 0)
        found, share = example.drive(plan, SEED, RATE, node)
    finally:
        node.destroy_node()
    alone, nominal = drive_day(plan, 'live', SEED), drive_day(plan, 'nominal', SEED)
    print(found.errors, alone.errors, nominal.errors, share)
    assert np.abs(found.errors).max() < 0.3
    assert np.abs(found.errors - alone.errors).max() < 0.25
    assert share > 0.1
    assert np.abs(found.errors).max() < 0.25 * np.abs(nominal.errors).max()


def test_without_nodes_it_fails_with_one_line(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', str(graph.domain))
    monkeypatch.setattr(sys, 'argv', ['closed_loop.py', '--runs', '1'])
    monkeypatch.setitem(example.drive.__globals__, 'DISCOVERY_S', 0.2)
    try:
        assert example.main() == 1
    finally:
        rclpy.shutdown()
    out, err = capfd.readouterr()
    assert out == ''
    assert err.splitlines() == [
        'closed_loop.py: error: no node takes in ato/speed in /: start trainid run --train day.yaml'
    ]


@pytest.mark.parametrize(
    ('option', 'value', 'said'),
    [
        ('--world', 'foo', "invalid choice: 'foo'"),
        ('--runs', '0', 'must be at least 1'),
        ('--rate', '0', "'0' must be a number > 0"),
        ('--prepare', '/nowhere/day.yaml', '/nowhere/day.yaml: No such file or directory'),
    ],
)
def test_a_wrong_argument_is_named(
    option: str, value: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, 'argv', ['closed_loop.py', option, value])
    with pytest.raises(SystemExit, match='2'):
        example.main()
    last = capsys.readouterr().err.splitlines()[-1]
    assert f'argument {option}: ' in last
    assert said in last


def test_estimates_that_never_come_are_no_live_ones(graph: Graph) -> None:
    plan, node = example.day('tram', 1, SEED), rclpy.create_node('ato', context=graph.context)
    try:
        values = example.NodeValues(node, plan.case.stated, 1e6)
        values.values()
        with pytest.raises(NoAnswerError, match=r'no live estimate of the brake rate .*: train file: no estimate yet'):
            _ = values.live_share
    finally:
        node.destroy_node()
