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
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Final, Self

from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.files import shared_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path
    from types import TracebackType

_PATIENCE_S: Final = 6.0
_POLL_S: Final = 0.02
_PR_SET_PDEATHSIG: Final = 1
_LAST_LINES: Final = 3
_ENDING: Final[tuple[signal.Signals, ...]] = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True, slots=True)
class Child:
    """A running command with its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def log_tail(self) -> str:
        """Return the last lines of its log as one line."""
        lines = self.log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
        return ' | '.join(line.strip() for line in lines[-_LAST_LINES:]) or 'no output'


@contextmanager
def _signals_held() -> Iterator[None]:
    """Defer SIGINT and SIGTERM until the block has ended."""
    caught: list[signal.Signals] = []
    before = {number: signal.signal(number, lambda n, _: caught.append(signal.Signals(n))) for number in _ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in caught:
            signal.raise_signal(number)


class ProcessGroup:
    """Child processes that all end with the ``with`` block: SIGTERM first, SIGKILL for those that remain."""

    def __init__(self, folder: Path) -> None:
        """Set the folder of the logs, which must exist."""
        self._folder = folder
        self._children: list[Child] = []
        self._logs: list[IO[bytes]] = []

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all children."""
        self.stop()

    def start(self, name: str, arguments: Sequence[str]) -> Child:
        """Start ``trainid ARGUMENTS`` with its output in ``NAME.log``."""
        path = self._folder / f'{name}.log'
        log = path.open('wb')
        self._logs.append(log)
        command = [sys.executable, '-m', 'trainid_ros.cli.processes', str(os.getpid()), *arguments]
        # A signal between the start of a child and its entry in the list would leave it running.
        with _signals_held():
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
            child = Child(name, process, path)
            self._children.append(child)
        return child

    def ended(self) -> tuple[Child, ...]:
        """Return the children that have ended."""
        return tuple(child for child in self._children if child.process.poll() is not None)

    def check(self, may_end: Child | None = None) -> None:
        """Raise NoAnswerError, with the end of its log, for a child that has ended; one may end without an error."""
        for child in self.ended():
            code = child.process.returncode
            if child is not may_end or code != 0:
                raise NoAnswerError(f'{child.name} ended with exit code {code} ({child.log}: {child.log_tail()})')

    def stop(self) -> tuple[Child, ...]:
        """End all children and wait for them; return those that had to be killed."""
        # A second Ctrl-C must not interrupt the clean-up.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            self._signal_all(signal.SIGTERM)
            deadline = time.monotonic() + _PATIENCE_S
            while len(self.ended()) < len(self._children) and time.monotonic() < deadline:
                time.sleep(_POLL_S)
            killed = tuple(child for child in self._children if child.process.poll() is None)
            self._signal_all(signal.SIGKILL)
            for child in self._children:
                child.process.wait()
            for log in self._logs:
                log.close()
        finally:
            signal.signal(signal.SIGINT, before)
        self._children, self._logs = [], []
        return killed

    def _signal_all(self, number: int) -> None:
        for child in self._children:
            if child.process.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(child.process.pid, number)


# From the RTPS specification: ports of a domain and of its first participants.
_BASE_PORT: Final = 7400
_PORTS_OF_DOMAIN: Final = 250
_OFFSETS: Final = (0, 10, 11, 12, 13)
# ROS recommends domains up to 101; 0 is the default of all processes.
_DOMAINS: Final = 101
_FAST_DDS: Final = 'rmw_fastrtps_cpp'


def free_domain(first: int) -> int:
    """Return a domain whose ports are all free, searching from ``first``.

    Raises:
        InputError: All are in use.
    """
    for step in range(_DOMAINS):
        domain = 1 + (first + step) % _DOMAINS
        if _are_free(_BASE_PORT + _PORTS_OF_DOMAIN * domain + offset for offset in _OFFSETS):
            return domain
    raise InputError(f'ROS_DOMAIN_ID: all domains from 1 to {_DOMAINS} are in use')


def _are_free(ports: Iterable[int]) -> bool:
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(('', port))
            except OSError:
                return False
    return True


def local_environment(profile: Path) -> dict[str, str]:
    """Return the variables with which ROS uses this machine alone; ``profile`` says the same to Fast DDS."""
    # LOCALHOST finds nobody outside, but overrides a profile and opens sockets on all interfaces.
    reads_profile = os.environ.get('RMW_IMPLEMENTATION', _FAST_DDS) == _FAST_DDS
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
    # This older switch would disable the range above.
    os.environ.pop('ROS_LOCALHOST_ONLY', None)
    os.environ.pop('ROS_STATIC_PEERS', None)
    return domain


def die_with(parent: int) -> None:
    """Ask the kernel for SIGTERM when the parent process ends; only Linux supports this."""
    if sys.platform == 'linux':
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            sys.exit(f'trainid: the parent process {parent} is gone')


if __name__ == '__main__':
    from trainid_ros.cli.main import main

    die_with(int(sys.argv[1]))
    sys.exit(main(sys.argv[2:]))
