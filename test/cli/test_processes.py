# SPDX-License-Identifier: Apache-2.0
"""Child processes never outlive the group, however they handle signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import pytest

from test.hang import HANG_S
from trainid_ros.cli import processes
from trainid_ros.cli.processes import ProcessGroup, free_domain, local_environment
from trainid_ros.interface.errors import NoAnswerError

CONFIG = Path(__file__).parents[2] / 'config'


def is_alive(pid: int) -> bool:
    """Return True for a process that exists and is not a zombie."""
    with suppress(OSError):
        return Path(f'/proc/{pid}/stat').read_text(encoding='utf-8').rpartition(')')[2].split()[0] != 'Z'
    return False


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + HANG_S
    while is_alive(pid):
        assert time.monotonic() < deadline, f'process {pid} is still there'
        time.sleep(0.02)


def test_a_child_that_ends_is_a_failure_unless_it_may_without_an_error(tmp_path: Path) -> None:
    with ProcessGroup(tmp_path) as group:
        assert group.start('version', '--version').wait() == 0
        group.check(may_end='version')
        with pytest.raises(NoAnswerError, match=r'version ended with exit code 0 .*: trainid '):
            group.check()
    with ProcessGroup(tmp_path) as group:
        group.start('bad', 'info', str(tmp_path / 'nothing')).wait()
        with pytest.raises(NoAnswerError, match=r'bad ended with exit code 2 .*no such bag'):
            group.check(may_end='bad')


def test_stop_kills_children_that_ignore_sigterm_whatever_interrupts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, '_MAX_END_S', 0.5)
    # It answers SIGTERM by interrupting its parent, which must not stop the clean-up, and stays.
    code = (
        'import os,signal,time\n'
        'signal.signal(15, lambda *_: os.kill(os.getppid(), 2)); print("ready", flush=True)\n'
        'while True: time.sleep(900)'
    )
    monkeypatch.setattr(processes.subprocess, 'Popen', _instead(code))  # type: ignore[attr-defined]
    with pytest.raises(ZeroDivisionError), ProcessGroup(tmp_path) as group:
        child = group.start('stubborn')
        _wait_for(tmp_path / 'stubborn.log', 'ready')
        assert group.stop() == ('stubborn',)
        assert child.returncode == -signal.SIGKILL
        other = group.start('other')
        raise ZeroDivisionError
    assert other.returncode is not None


def test_stop_reaches_grandchildren_and_runs_on_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (
        'import subprocess,sys,time\n'
        'p = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(900)"])\n'
        'print("pid", p.pid, "end", flush=True); time.sleep(900)'
    )
    monkeypatch.setattr(processes.subprocess, 'Popen', _instead(code))  # type: ignore[attr-defined]
    grandchild = 0
    with pytest.raises(ZeroDivisionError), ProcessGroup(tmp_path) as group:
        child = group.start('parent')
        grandchild = int(_wait_for(tmp_path / 'parent.log', 'end').split()[1])
        assert is_alive(grandchild)
        raise ZeroDivisionError
    wait_until_gone(grandchild)
    assert not is_alive(child.pid)


def test_child_ends_with_a_parent_that_was_killed() -> None:
    code = (
        'import sys, time\n'
        'from pathlib import Path\n'
        'import subprocess, os\n'
        'run = "import os,sys,time; from trainid_ros.cli.processes import die_with; die_with(int(sys.argv[1]));"\n'
        'run += "print(os.getpid(), flush=True); time.sleep(900)"\n'
        'p = subprocess.Popen([sys.executable, "-c", run, str(os.getpid())], start_new_session=True)\n'
        'time.sleep(900)\n'
    )
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert is_alive(pid)
        os.kill(parent.pid, signal.SIGKILL)
        wait_until_gone(pid)


def test_domain_in_use_is_skipped() -> None:
    import socket  # noqa: PLC0415 - only here

    domain = free_domain(os.getpid())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(('', 7400 + 250 * domain))
        other = free_domain(domain - 1)
    assert 1 <= other <= 101
    assert other != domain


def _instead(code: str) -> object:
    start = subprocess.Popen

    def run(_command: list[str], **options: object) -> subprocess.Popen[bytes]:
        return start([sys.executable, '-c', code], **options)  # type: ignore[call-overload,no-any-return]

    return run


def _wait_for(log: Path, word: str) -> str:
    deadline = time.monotonic() + HANG_S
    while word not in (text := log.read_text(encoding='utf-8')):
        assert time.monotonic() < deadline, text
        time.sleep(0.02)
    return text


@pytest.mark.parametrize('name', ['fastdds_replay.xml', 'fastdds_localhost.xml'])
def test_the_profiles_use_this_machine_alone(name: str) -> None:
    root = ElementTree.parse(CONFIG / name).getroot()
    space = {'d': 'http://www.eprosima.com'}
    transports = root.iterfind('.//d:transport_descriptor', space)
    networks = [item for item in transports if item.findtext('d:type', namespaces=space) != 'SHM']
    assert [[place.text for place in item.iterfind('.//d:address', space)] for item in networks] == [['127.0.0.1']]
    assert [item.text for item in root.iterfind('.//d:useBuiltinTransports', space)] == ['false']


def test_a_middleware_that_reads_no_profile_finds_nobody_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for middleware in ('rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp'):
        monkeypatch.setenv('RMW_IMPLEMENTATION', middleware)
        found.append(local_environment(Path('profile.xml'))['ROS_AUTOMATIC_DISCOVERY_RANGE'])
    assert found == ['SYSTEM_DEFAULT', 'LOCALHOST']
