# SPDX-License-Identifier: Apache-2.0
"""The demo end to end on a small bag: four nodes and a player in three processes, none of which is left."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from test.hang import HANG_S
from trainid_ros.bag.writer import BagWriter
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.truth import save_truth
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile, dump_train_file

pytestmark = pytest.mark.ros

NODES = 4
PROCESSES = 3
Start: TypeAlias = Callable[..., subprocess.Popen[str]]


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    train = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001), line=Line(stops=(0.0, 500.0)))
    simulation = simulate(Scenario(train, runs=1), np.random.default_rng(3))
    path = tmp_path_factory.mktemp('demo') / 'run'
    with BagWriter(path) as writer:
        for record in simulation.records:
            writer.write_record(record)
    (path / 'train.yaml').write_text(dump_train_file(train), encoding='utf-8')
    save_truth(simulation.truth, path / 'truth.yaml')
    return path


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts a demo; none outlives the test."""
    started: list[subprocess.Popen[str]] = []
    # Tests that run in the background ignore SIGINT, which their children would inherit.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def run(bag: Path, out: Path, *options: str) -> subprocess.Popen[str]:
        command = [sys.executable, '-m', 'trainid_ros.cli.main', 'demo', str(bag), '--out', str(out), *options]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield run
    signal.signal(signal.SIGINT, before)
    for process in started:
        if process.poll() is None:
            process.kill()
            process.communicate()


def children_of(demo: subprocess.Popen[str]) -> list[int]:
    """Return the processes started by a demo, orphaned or not: its process id is in their arguments."""
    found = []
    for entry in Path('/proc').iterdir():
        try:
            command = (entry / 'cmdline').read_bytes().split(b'\0') if entry.name.isdecimal() else []
        except OSError:
            continue
        if b'trainid_ros.cli.processes' in command and str(demo.pid).encode() in command:
            found.append(int(entry.name))
    return found


def test_quick_demo_end_to_end(start: Start, bag: Path, tmp_path: Path) -> None:
    process = start(bag, tmp_path / 'out', '--quick', '--rate', '15', '--json')
    out, err = process.communicate()
    assert process.returncode == 0, err
    answer: dict[str, Any] = json.loads(out)
    assert answer['worked'] is True
    chapter = answer['bags'][0]
    assert len(chapter['live_against_replay']) == NODES
    for comparison in chapter['live_against_replay'].values():
        assert comparison['equal'] == comparison['replayed'] > 200
        assert comparison['missing'] == comparison['extra'] == 0
    assert chapter['scores']['brake_rate']['outputs'] > 100
    assert chapter['v_mils']['estimate']['a'] != chapter['resistance']['estimate']['a']
    text = (tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')
    assert text.count('<svg') == 8
    assert 'live equals replay to the bit' in text
    assert '>V-MILS<' in text[text.index('Resistance curve against speed') :]
    assert 'km/h' in err
    assert children_of(process) == []


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_demo_leaves_no_process_behind(
    start: Start, bag: Path, tmp_path: Path, number: signal.Signals
) -> None:
    process = start(bag, tmp_path / 'out', '--rate', '1')
    log = tmp_path / 'out' / 'log' / bag.name / 'bag_player.log'
    deadline = time.monotonic() + HANG_S
    while not (log.is_file() and len(children_of(process)) >= PROCESSES):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert 'Traceback' not in err
    # A child that was being started is ended by the kernel, after its parent.
    deadline = time.monotonic() + HANG_S
    while children_of(process):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_node_that_cannot_start_is_reported_in_one_line(start: Start, bag: Path, tmp_path: Path) -> None:
    broken = tmp_path / 'broken'
    broken.mkdir()
    for item in bag.iterdir():
        (broken / item.name).write_bytes(item.read_bytes())
    # Valid as a file, but outside the range of the node parameter.
    text = (broken / 'train.yaml').read_text(encoding='utf-8')
    (broken / 'train.yaml').write_text(text.replace('time_constant: 0.4', 'time_constant: 5000.0'), encoding='utf-8')
    process = start(broken, tmp_path / 'out')
    _, err = process.communicate()
    assert process.returncode in (1, 2)
    assert err.count('\n') == 1
    assert 'time_constant' in err
    assert children_of(process) == []
