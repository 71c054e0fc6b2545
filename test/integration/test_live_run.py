# SPDX-License-Identifier: Apache-2.0
"""The real commands as processes: a bag played through the live nodes equals its replay, and all exit cleanly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from trainid_msgs import msg as messages

from test.foreign_bag import MAPPING, write_foreign
from test.ros.graph import Graph
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.cli.demo import node_parameters
from trainid_ros.cli.main import main
from trainid_ros.cli.processes import free_domain, local_environment
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import load_mapping
from trainid_ros.ros.topics import LEASE_S, estimate_message, latched_qos, time_message
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import load_train_file

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
PROFILE = ROOT / 'config' / 'fastdds_localhost.xml'
TRAIN = ROOT / 'config' / 'trains' / 'yizhuang.yaml'
OUTPUTS: dict[str, tuple[Any, Callable[..., EstimatorPipeline[Any]]]] = {
    'trainid/resistance': (messages.ResistanceEstimate, resistance_pipeline),
    'trainid/speed_model': (messages.SpeedModelEstimate, speed_model_pipeline),
    'trainid/brake_rate': (messages.BrakeRateEstimate, brake_rate_pipeline),
}
RATE = '16'
PLAYED_S = 50.0
FOREIGN_S = 20.0
# This machine, and the group of DDS discovery, which is joined there.
LOCAL = ('127.', '239.255.0.1:')


class Processes:
    """Starts ``trainid`` commands and ensures that none outlives the test."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.domain = domain
        self._folder = folder
        self._running: list[subprocess.Popen[str]] = []
        self._environment = os.environ | {
            **local_environment(PROFILE),
            'ROS_DOMAIN_ID': str(domain),
            'ROS_LOG_DIR': str(folder),
            'ROS_PYTHON_CHECK_FIELDS': '1',
            'PYTHONUNBUFFERED': '1',
        }

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, '-m', 'trainid_ros.cli.main', *arguments]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=self._environment
        )
        self._running.append(process)
        return process

    def stop_all(self) -> None:
        for process in self._running:
            if process.poll() is None:
                process.kill()
            process.communicate()


def finish(process: subprocess.Popen[str], signal_number: int | None = None) -> tuple[int, str, str]:
    """Wait for the end of a process, after a signal if one is given."""
    if signal_number is not None:
        process.send_signal(signal_number)
    out, err = process.communicate()
    return process.returncode, out, err


def wait_for_lines(process: subprocess.Popen[str], count: int) -> list[str]:
    assert process.stdout is not None
    return [process.stdout.readline().strip() for _ in range(count)]


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    started = Processes(tmp_path, free_domain(os.getpid()))
    yield started
    started.stop_all()


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('bags') / 'run'
    scenario = Scenario(load_train_file(TRAIN), runs=1)
    records = simulate(scenario, np.random.default_rng(3)).records
    end = records[-1].stamp_ns  # the train brakes before
    with BagWriter(path) as writer:
        for record in records:
            if record.stamp_ns >= end - round(PLAYED_S * 1e9):
                writer.write_record(record)
    return path


class Listener(Graph):
    """Collects all estimates on the graph of the processes."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        self.received: dict[str, list[Any]] = {topic: [] for topic in OUTPUTS}
        self.node = self.plain('listener')
        for topic, (kind, _) in OUTPUTS.items():
            self.node.create_subscription(kind, topic, self.received[topic].append, QoSProfile(depth=10000))


@pytest.fixture
def listener(processes: Processes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Listener]:
    for variable, value in local_environment(PROFILE).items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    made = Listener(processes.domain)
    yield made
    made.close()


def replayed(bag: Path, topic: str, mapping: Path | None = None) -> list[Any]:
    """Messages that the pipeline alone gives for the same records."""
    _, make = OUTPUTS[topic]
    pipeline = make(load_train_file(TRAIN), EstimatorSettings())
    with BagReader(bag, inputs=mapped_inputs(mapping, load_train_file(TRAIN))) as reader:
        outputs = [output for record in reader.records() for output in pipeline.push(record)]
    return [estimate_message(output) for output in outputs]


def content(message: Any) -> dict[str, bytes]:
    """Every field of a message, to the bit."""
    fields = {}
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        fields[name] = repr(value).encode() if name == 'header' else np.array(value).tobytes()
    return fields


def without_stale_repeats(outputs: list[Any]) -> list[dict[str, bytes]]:
    """Contents of the messages without those that only report missing input: clocks, not stamps, trigger those."""
    contents, stamp = [], time_message(0)
    for message in outputs:
        if message.status != message.STALE or message.header.stamp != stamp:
            contents.append(content(message))
        stamp = message.header.stamp
    return contents


@pytest.mark.parametrize('is_foreign', [False, True], ids=['own', 'foreign'])
def test_live_estimates_equal_the_replay_to_the_bit(
    processes: Processes, listener: Listener, bag: Path, tmp_path: Path, is_foreign: bool
) -> None:
    played, played_s, mapping, topics = bag, PLAYED_S, None, tuple(OUTPUTS)
    options, parameters = [], node_parameters()
    if is_foreign:
        played, played_s, mapping, topics = tmp_path / 'foreign', FOREIGN_S, tmp_path / 'map.yaml', topics[:1]
        mapping.write_text(MAPPING, encoding='utf-8')
        with BagReader(bag) as reader:
            write_foreign(played, list(reader.records())[: round(20.0 * FOREIGN_S)])
        reliable = {'history': 'keep_last', 'depth': 1000, 'reliability': 'reliable'}
        overrides = {topic: {'subscription': dict(reliable)} for topic in load_mapping(mapping).topics}
        parameters = yaml.safe_dump({'resistance_estimator': {'ros__parameters': {'qos_overrides': overrides}}})
        options = ['--map', str(mapping)]
    # By default inputs are best effort and may be lost on a busy machine; these nodes lose none.
    lossless = tmp_path / 'lossless.yaml'
    lossless.write_text(parameters, encoding='utf-8')
    names = [f'{topic.removeprefix("trainid/")}_estimator' for topic in topics]
    chosen = ['--node', names[0]] if is_foreign else []
    ros_args = ('--ros-args', '--params-file', str(lossless), '-p', 'use_sim_time:=true')
    nodes = processes.start('run', '--train', str(TRAIN), *options, *chosen, *ros_args)
    assert [line.split()[0] for line in wait_for_lines(nodes, len(names))] == names
    listener.until(lambda: all(listener.node.count_publishers(topic) for topic in topics))
    player = processes.start('play', str(played), *options, '--rate', RATE, '--wait', '1')
    listener.until(lambda: player.poll() is not None)
    code, _, err = finish(player)
    assert (code, 'Traceback' in err) == (0, False), err
    expected = {topic: replayed(played, topic, mapping) for topic in topics}
    last = {topic: outputs[-1].header.stamp for topic, outputs in expected.items()}
    listener.until(lambda: all(listener.received[topic][-1].header.stamp == last[topic] for topic in topics))
    code, _, err = finish(nodes, signal.SIGTERM)
    assert (code, 'Traceback' in err) == (0, False), err
    for topic, outputs in expected.items():
        assert without_stale_repeats(listener.received[topic]) == without_stale_repeats(outputs)
        assert len(outputs) > 0.9 * 5.0 * played_s


@pytest.mark.parametrize('signal_number', [signal.SIGINT, signal.SIGTERM])
def test_run_exits_cleanly_after_one_signal_or_many(processes: Processes, signal_number: int) -> None:
    nodes = processes.start('run', '--train', str(TRAIN), '--node', 'resistance_estimator')
    (line,) = wait_for_lines(nodes, 1)
    assert line.startswith('resistance_estimator is active: filter-bank on /trainid/resistance; parameters given: ')
    if signal_number == signal.SIGINT:
        # The first ends the executor within 0.2 s; the others meet a process that cleans up or ends.
        for _ in range(20):
            nodes.send_signal(signal_number)
            time.sleep(0.05 if nodes.poll() is None else 0.0)
    code, _, err = finish(nodes, signal_number)
    assert (code, 'Traceback' in err) == (0, False), err


def test_run_fails_once_others_have_shut_all_nodes_down(processes: Processes, listener: Listener) -> None:
    nodes = processes.start('run', '--train', str(TRAIN), '--node', 'resistance_estimator')
    (line,) = wait_for_lines(nodes, 1)
    assert line.startswith('resistance_estimator is active: filter-bank on /trainid/resistance; parameters given: ')
    change = listener.node.create_client(ChangeState, 'resistance_estimator/change_state')
    listener.until(change.service_is_ready)
    change.call_async(ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN)))
    listener.until(lambda: nodes.poll() is not None)
    code, _, err = finish(nodes, signal.SIGTERM)
    assert (code, 'resistance_estimator: shut down by a request of another process' in err) == (1, True), err


def listening(pid: int) -> set[str]:
    """Addresses of the network sockets of a process; numbers in /proc are hexadecimal, the last byte first."""
    links = {str(path.readlink()) for path in Path(f'/proc/{pid}/fd').iterdir() if path.is_symlink()}
    found = set()
    for kind in ('udp', 'udp6', 'tcp', 'tcp6'):
        for line in Path(f'/proc/{pid}/net/{kind}').read_text(encoding='ascii').splitlines()[1:]:
            words = line.split()
            if f'socket:[{words[9]}]' in links:
                address, _, port = words[1].partition(':')
                found.add(f'{".".join(str(byte) for byte in reversed(bytes.fromhex(address)))}:{int(port, 16)}')
    assert found
    return found


def test_a_killed_node_is_seen_once_its_lease_ends(processes: Processes, listener: Listener) -> None:
    alive: list[int] = []
    callbacks = SubscriptionEventCallbacks(liveliness=lambda event: alive.append(event.alive_count))
    kind, topic = messages.ResistanceEstimate, 'trainid/last_valid/resistance'
    listener.node.create_subscription(kind, topic, lambda _: None, latched_qos(), event_callbacks=callbacks)
    nodes = processes.start('run', '--train', str(TRAIN), '--node', 'resistance_estimator')
    listener.until(lambda: alive == [1])
    assert not {address for address in listening(nodes.pid) if not address.startswith(LOCAL)}
    # A node without inputs says so, at least once a second.
    listener.until(lambda: len(listener.received['trainid/resistance']) > 1)
    assert {message.status for message in listener.received['trainid/resistance']} == {kind.STALE}
    ticks: list[None] = []  # at 10 Hz, in this process: where it is kept waiting, so are they
    listener.node.create_timer(0.1, lambda: ticks.append(None))
    nodes.kill()
    listener.until(lambda: alive == [1, 0])
    assert len(ticks) < 10.0 * (LEASE_S + 1.0)


@pytest.mark.parametrize('signal_number', [signal.SIGINT, signal.SIGTERM])
def test_play_exits_cleanly(processes: Processes, listener: Listener, bag: Path, signal_number: int) -> None:
    player = processes.start('play', str(bag), '--loop')
    listener.until(lambda: listener.node.count_publishers('ato/speed'))
    code, _, err = finish(player, signal_number)
    assert (code, 'Traceback' in err) == (0, False), err


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (
            ('run', '--train', str(TRAIN), '--ros-args', '-p', 'alignment.perod:=1.0'),
            "unknown parameter 'alignment.perod'",
        ),
        (('run', '--ros-args', '--params-file', 'none.yaml'), 'none.yaml'),
        (('play', str(ROOT / 'bags' / 'tiny_foreign')), 'no messages on the input topics'),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(
    processes: Processes, arguments: tuple[str, ...], reason: str
) -> None:
    code, _, err = finish(processes.start(*arguments))
    lines = [line for line in err.splitlines() if line.startswith('trainid: error:')]
    assert (code, len(lines), 'Traceback' in err) == (2, 1, False), err
    assert reason in lines[0]


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (('run', '--train', 'no/such.yaml'), 'no/such.yaml: cannot be read'),
        (('play', 'no/such/bag'), 'no/such/bag'),
        (('run', '--map', 'none.yaml'), 'none.yaml: cannot be read'),
        (('play', str(ROOT / 'bags' / 'tiny_foreign'), '--map', 'none.yaml'), 'none.yaml: cannot be read'),
        (('play', str(ROOT / 'bags' / 'tiny'), '--rate', '0'), 'rate'),
    ],
)
def test_bad_input_is_one_line_before_ros_starts(
    arguments: tuple[str, ...], reason: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr('trainid_ros.ros.node.start_ros', lambda _: pytest.fail('ROS starts'))
    with suppress(SystemExit):  # of a wrong option
        assert main([*arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('trainid: error:')
    assert reason in line
