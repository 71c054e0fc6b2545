# SPDX-License-Identifier: Apache-2.0
"""Child processes, each with its own process group and log, that never outlive the parent's ``with`` block."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from types import TracebackType

_PATIENCE_S: Final = 6.0
_POLL_S: Final = 0.02
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
        command = [sys.executable, '-m', 'trainid_ros.demo.child', str(os.getpid()), *arguments]
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
