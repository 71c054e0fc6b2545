# SPDX-License-Identifier: Apache-2.0
"""Child processes in a ROS domain of their own that never outlive the parent's ``with`` block, even if it is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.files import shared_path

_MAX_END_S: Final = 6.0  # in which children end after SIGTERM, before they are killed [s]


class ProcessGroup:
    """``trainid`` commands that all end with the ``with`` block: SIGTERM first, SIGKILL for those that remain.

    Should the process be killed, the kernel ends them too. Their logs are in a folder, which must exist.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._children: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start ``trainid ARGUMENTS`` with its output in ``NAME.log``."""
        command = [sys.executable, '-m', 'trainid_ros.cli.processes', str(os.getpid()), *arguments]
        with (self._folder / f'{name}.log').open('wb') as log:
            self._children[name] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        return self._children[name]

    def check(self, may_end: str = '') -> None:
        """Raise NoAnswerError, with the end of its log, for a child that has ended; one may end without an error."""
        for name, child in self._children.items():
            code = child.poll()
            if code is None or (code == 0 and name == may_end):
                continue
            log = self._folder / f'{name}.log'
            lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()[-3:]
            tail = ' | '.join(line.strip() for line in lines) or 'no output'
            raise NoAnswerError(f'{name} ended with exit code {code} ({log}: {tail})')

    def stop(self) -> tuple[str, ...]:
        """End all children and wait for them; return the names of those that had to be killed."""
        # A second Ctrl-C must not interrupt the clean-up.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._signal_all(signal.SIGTERM)
            deadline, killed = time.monotonic() + _MAX_END_S, []
            for name, child in self._children.items():
                try:
                    child.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    killed.append(name)
            self._signal_all(signal.SIGKILL)
            for child in self._children.values():
                child.wait()
        finally:
            signal.signal(signal.SIGINT, before)
        self._children = {}
        return tuple(killed)

    def _signal_all(self, number: int) -> None:
        for child in self._children.values():
            if child.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(child.pid, number)


def free_domain(first: int) -> int:
    """Return a domain whose ports are all free, searching from ``first``; InputError if all are in use."""
    # ROS recommends domains up to 101; 0 is the default of all processes.
    for domain in (1 + (first + step) % 101 for step in range(101)):
        # By the RTPS specification: the first port of all, the ports of a domain, those of its first participants.
        if all(_is_free(7400 + 250 * domain + offset) for offset in (0, 10, 11, 12, 13)):
            return domain
    raise InputError('ROS_DOMAIN_ID: all domains from 1 to 101 are in use')


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.bind(('', port))
        return True
    return False


def local_environment(profile: Path) -> dict[str, str]:
    """Return the variables with which ROS uses this machine alone; ``profile`` says the same to Fast DDS."""
    # LOCALHOST finds nobody outside, but overrides a profile and opens sockets on all interfaces.
    reads_profile = os.environ.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp') == 'rmw_fastrtps_cpp'
    return {
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile.absolute()),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT' if reads_profile else 'LOCALHOST',
    }


def isolate(logs: Path) -> int:
    """Put this process and its children into an unused domain, with queues for a fast playback; return the domain."""
    domain = free_domain(os.getpid())
    os.environ |= {
        **local_environment(shared_path('config/fastdds_replay.xml')),
        'ROS_DOMAIN_ID': str(domain),
        'ROS_LOG_DIR': str(logs.absolute()),
    }
    for older in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):  # the first would disable the range above
        os.environ.pop(older, None)
    return domain


def die_with(parent: int) -> None:
    """Ask the kernel for SIGTERM when the parent process ends."""
    if sys.platform == 'linux':
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)
        if os.getppid() != parent:
            sys.exit(f'trainid: the parent process {parent} is gone')


if __name__ == '__main__':
    from trainid_ros.cli.main import main

    die_with(int(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
