# SPDX-License-Identifier: Apache-2.0
"""``trainid monitor`` beside real nodes and a player, as a person at a terminal reads it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import pytest

from test.hang import HANG_S
from trainid_ros.cli.processes import ProcessGroup, free_domain, local_environment

pytestmark = pytest.mark.ros

ROOT = Path(__file__).parents[2]
TRAIN = str(ROOT / 'bags' / 'tiny' / 'train.yaml')
BAG = str(ROOT / 'bags' / 'tiny')
PROFILE = ROOT / 'config' / 'fastdds_localhost.xml'
NODES = ('resistance_estimator', 'speed_model_estimator', 'brake_rate_estimator')
ESCAPES = re.compile(r'\x1b\[[0-9;?]*[A-Za-z]')
HOME = '\x1b[H'
COLUMNS, ROWS = 100, 40


class Terminal:
    """``trainid monitor`` in a pseudo-terminal."""

    def __init__(self, *arguments: str, **environment: str) -> None:
        self._main, side = pty.openpty()
        fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack('HHHH', ROWS, COLUMNS, 0, 0))
        inherited = {name: value for name, value in os.environ.items() if name != 'NO_COLOR'}
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'trainid_ros.cli.main', 'monitor', *arguments],
            stdin=side,
            stdout=side,
            stderr=side,
            env=inherited | {'TERM': 'xterm-256color', 'LANG': 'C.UTF-8', 'PYTHONUTF8': '1'} | environment,
            start_new_session=True,
        )
        os.close(side)
        self.received = ''

    def read(self) -> None:
        """Read what is written within a short time."""
        if select.select([self._main], [], [], 0.05)[0]:
            try:
                self.received += os.read(self._main, 65536).decode(errors='replace')
            except OSError:  # the other side is closed
                time.sleep(0.01)

    def screen(self) -> str:
        """Return the words of the last picture that was drawn."""
        return ' '.join(ESCAPES.sub('', self.received.split(HOME)[-1]).split())

    def until(self, *wanted: str) -> None:
        """Wait until a picture holds all these words."""
        end = time.monotonic() + HANG_S
        while not all(word in self.screen() for word in wanted):
            assert self.process.poll() is None, self.received[-2000:]
            assert time.monotonic() < end, f'{wanted} are not in:\n{self.screen()}'
            self.read()

    def until_input(self, name: str, rate: float) -> None:
        """Wait until an input comes with about this rate [Hz], which a loaded machine may upset for some seconds."""
        end = time.monotonic() + HANG_S
        while True:
            shown = re.findall(rf'{name} ([\d.]+) Hz ([\d.]+) s', self.screen())
            if shown and abs(float(shown[0][0]) - rate) < 0.3 * rate and float(shown[0][1]) < 1.0:
                return
            assert time.monotonic() < end, f'{name} does not come with {rate} Hz in:\n{self.screen()}'
            self.read()

    def end(self, number: signal.Signals) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        end = time.monotonic() + HANG_S
        while self.process.poll() is None:
            assert time.monotonic() < end, 'the monitor does not end'
            self.read()
        self.read()
        return self.process.returncode

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._main)


@pytest.fixture
def terminals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Terminal]]:
    for variable, value in local_environment(PROFILE).items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setenv('ROS_DOMAIN_ID', str(free_domain(os.getpid() + 31)))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    opened: list[Terminal] = []
    yield opened
    for terminal in opened:
        terminal.close()


def open_monitor(terminals: list[Terminal], *arguments: str, **environment: str) -> Terminal:
    terminals.append(Terminal(*arguments, **environment))
    return terminals[-1]


def test_a_person_sees_the_train_and_a_killed_node(terminals: list[Terminal], tmp_path: Path) -> None:
    clock = ['-p', 'use_sim_time:=true']
    space = ['--ros-args', '-r', '__ns:=/train_7']
    monitor = open_monitor(terminals, '--ros-args', *clock)
    monitor.until('Nothing is published yet in any namespace', 'trainid run')
    with ProcessGroup(tmp_path) as group:
        nodes = {name: group.start(name, 'run', '--train', TRAIN, '--node', name, *space, *clock) for name in NODES}
        group.start('player', 'play', BAG, '--rate', '2', '--start', '20', '--wait', '3', '--loop', *space)
        monitor.until('/train_7', '3 of 3 estimates', 'N/kN w at', 'mass factor', '1 = nominal')
        monitor.until('CONVERGING', 'drive on, it learns at changing speeds')
        monitor.until('/train_7/bag_player', 'km/h', 'used', 'stated ±')
        monitor.until_input('ato/speed', 10.0)
        nodes['brake_rate_estimator'].kill()
        drawn = monitor.received.count(HOME)
        monitor.until('2 of 3 estimates', 'SILENT', 'brake_rate_estimator: no estimate since')
        assert monitor.received.count(HOME) - drawn <= 10  # of 2 s, one every 0.25 s, and two not read
    assert monitor.end(signal.SIGINT) == 0
    assert 'Traceback' not in monitor.received
    assert monitor.received.endswith('\x1b[?25h\x1b[?1049l')  # the cursor is back, and the screen from before


def test_without_colours_there_is_a_line_each_second_at_most(terminals: list[Terminal], tmp_path: Path) -> None:
    with ProcessGroup(tmp_path) as group:
        group.start('nodes', 'run', '--train', TRAIN, '--ros-args', '-r', '__ns:=/train_7')
        monitor = open_monitor(terminals, '--namespace', 'train_7', '--duration', str(HANG_S), NO_COLOR='1')
        monitor.until('/train_7 ', 'STALE', 'ato/speed never', 'start the node that publishes it')
        seen = monitor.received.count(' UTC /train_7 ')
        while monitor.received.count(' UTC /train_7 ') < seen + 4:
            monitor.read()
        assert monitor.end(signal.SIGTERM) == 0
    assert '\x1b' not in monitor.received
    lines = [line for line in monitor.received.splitlines() if ' UTC /train_7 ' in line]
    times = [datetime.strptime(line.split()[0], '%H:%M:%S') for line in lines]
    steps_s = [(after - before).seconds for before, after in pairwise(times)]
    assert steps_s
    assert min(steps_s) >= 1  # each comes a moment later than a second after the last


def test_on_a_dumb_terminal_another_namespace_is_named(terminals: list[Terminal], tmp_path: Path) -> None:
    with ProcessGroup(tmp_path) as group:
        group.start('nodes', 'run', '--train', TRAIN, '--ros-args', '-r', '__ns:=/train_7')
        monitor = open_monitor(terminals, '--namespace', '/train_8', '--duration', str(HANG_S), TERM='dumb')
        monitor.until('in the namespace /train_8', 'There are trains in /train_7')
        assert monitor.end(signal.SIGINT) == 0
    assert '\x1b' not in monitor.received  # it cannot draw


def test_a_time_with_nothing_published_gives_no_answer(terminals: list[Terminal]) -> None:
    monitor = open_monitor(terminals, '--duration', '1', NO_COLOR='1')
    assert monitor.process.wait() == 1


MUTE = """
import rclpy, sys
from trainid_msgs.msg import AtoSpeed
rclpy.init()
publisher = rclpy.create_node('mute').create_publisher(AtoSpeed, 'ato/speed', 1)
sys.stdin.read()
"""


def test_a_publisher_that_publishes_nothing_gives_no_answer(terminals: list[Terminal]) -> None:
    with subprocess.Popen([sys.executable, '-c', MUTE], stdin=subprocess.PIPE) as node:
        open_monitor(terminals).until('/mute', 'never')
        monitor = open_monitor(terminals, '--duration', '2', NO_COLOR='1')
        assert monitor.process.wait() == 1
        node.kill()


def test_a_short_time_is_enough_where_something_is_published(terminals: list[Terminal], tmp_path: Path) -> None:
    with ProcessGroup(tmp_path) as group:
        group.start('player', 'play', BAG, '--wait', '0', '--loop')
        open_monitor(terminals).until('/bag_player', '5.0 Hz')
        command = [sys.executable, '-m', 'trainid_ros.cli.main', 'monitor', '--duration', '1.5']
        forced = os.environ | {'FORCE_COLOR': '1', 'LC_ALL': 'C'}
        found = subprocess.run(command, capture_output=True, check=False, env=forced)
    assert found.returncode == 0
    assert b'km/h | resistance' in found.stdout
    assert found.stdout.isascii()
    assert b'\x1b' not in found.stdout  # a file, whatever FORCE_COLOR says


@pytest.mark.parametrize('command', [('monitor', '--duration', '1'), ('run', '--train', TRAIN), ('play', BAG)])
def test_a_number_for_use_sim_time_is_refused(command: tuple[str, ...]) -> None:
    arguments = [*command, '--ros-args', '-p', 'use_sim_time:=1']
    done = subprocess.run(
        [sys.executable, '-m', 'trainid_ros.cli.main', *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "'use_sim_time' to '1' of type 'INTEGER', expecting type 'BOOL'" in line


@pytest.mark.parametrize(
    ('name', 'said'),
    [('1x', 'must not have a token that starts with a number'), ('/a//b', "must not contain repeated '/'")],
)
def test_a_namespace_that_cannot_be_is_refused(name: str, said: str) -> None:
    command = [sys.executable, '-m', 'trainid_ros.cli.main', 'monitor', '--namespace', name, '--duration', '1']
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 2
    assert found.stderr.splitlines() == [f'trainid: error: --namespace {name}: namespace {said}']
