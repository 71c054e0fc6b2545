# SPDX-License-Identifier: Apache-2.0
"""An ATO that stops by the estimates of nodes in another process."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
import pytest
import rclpy

from trainid_ros.ato.days import drive_day
from trainid_ros.train.train_file import dump_train_file

pytestmark = pytest.mark.ros

Graph: TypeAlias = Any  # the fixture of conftest.py
EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'python' / 'closed_loop.py'
example = SimpleNamespace(**runpy.run_path(str(EXAMPLE), run_name='example'))
SEED, RUNS, RATE = 4, 4, 10.0


@pytest.fixture
def nodes(graph: Graph, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    path = tmp_path / 'day.yaml'
    path.write_text(dump_train_file(example.day('tram', RUNS, SEED).case.stated), encoding='utf-8')
    command = [sys.executable, '-m', 'trainid_ros.cli.main', 'run', '--train', str(path)]
    with subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': str(graph.domain)}) as process:
        yield process
        process.terminate()


@pytest.mark.usefixtures('nodes')
def test_it_stops_as_well_as_in_one_process(graph: Graph) -> None:
    plan = example.day('tram', RUNS, SEED)
    node = rclpy.create_node('ato', context=graph.context)
    try:
        graph.until(lambda: node.count_subscribers('ato/speed') > 0)
        found = example.drive(plan, SEED, RATE, node)
    finally:
        node.destroy_node()
    alone, nominal = drive_day(plan, 'live', SEED), drive_day(plan, 'nominal', SEED)
    # At ten times the pace a delay of a tenth of a second counts as a second while values move in the first stops.
    later = slice(2, None)
    assert np.abs(found.errors[later]).max() < 0.3
    assert np.abs(found.errors[later] - alone.errors[later]).max() < 0.25
    assert np.abs(found.errors).max() < 0.25 * np.abs(nominal.errors).max()
