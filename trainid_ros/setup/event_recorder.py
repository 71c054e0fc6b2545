# SPDX-License-Identifier: Apache-2.0
"""The last minutes of all inputs, written to a bag when something happens: fault, contradiction, step or request.

The inputs are kept in memory as packed rows, in segments that begin with what the estimators had learned: a replay from
there repeats their numbers to the bit. Another thread writes the bag, so that no sample is late.
"""

from __future__ import annotations

import math
import re
import shutil
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from struct import Struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Row
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate, Status
from trainid_ros.interface.text import plus_minus
from trainid_ros.resistance.davis_posterior import resistance_std
from trainid_ros.train.forces import davis
from trainid_ros.train.train_file import Davis

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from trainid_ros.estimators.pipeline import EstimatorPipeline

MAX_ROWS: Final = 200_000
"""Messages kept at most, 15 MB: ten minutes of five topics at 66 Hz."""
SEGMENTS: Final = 6
"""Segments kept at most: the newest five make the span asked for, each with checkpoints of some 300 kB."""
MIN_PAUSE_NS: Final = 60 * NS_PER_S
"""Time between recordings, except for those requested [ns]."""
MAX_RECORDINGS: Final = 20
"""Recordings in the folder; each new one replaces the oldest."""
_AFTER_NS: Final = 30 * NS_PER_S
"""Time recorded after an event, which shows what came of it [ns]."""
# Change of an estimate that counts as a step [std]: one in two million by chance.
_STEP_STD: Final = 5.0
# Log time, then a row.
_ENTRY: Final = Struct('<qBqdd?')
_NAME: Final = re.compile(r'\d{8}T\d{6}Z_\w+_(fault|contradiction|step|request)')


Say: TypeAlias = 'Callable[[str], object]'
Clock: TypeAlias = 'Callable[[], int]'
WriteBag: TypeAlias = 'Callable[[Path, Iterable[tuple[int, Row]], Mapping[str, str]], None]'
"""Writes rows with their log times [ns] to a new bag, and texts to files in its folder; InputError, OSError."""


def step_of(before: Any, now: Any) -> str:
    """Return how far a resistance or brake rate is from an earlier estimate, '' within five standard deviations."""
    if isinstance(now, ResistanceEstimate):
        name, new, new_std = 'resistance [N/kN]', now.resistance, now.resistance_std
        old = davis(Davis(before.a, before.b, before.c), now.speed)
        old_std = resistance_std(before.covariance, now.speed)
    elif isinstance(now, BrakeRateEstimate):
        name, new, new_std = 'brake rate', now.brake_rate, now.brake_rate_std
        old, old_std = before.brake_rate, before.brake_rate_std
    else:
        return ''
    # Their errors are correlated, which makes the difference smaller than assumed here.
    is_step = abs(new - old) > _STEP_STD * math.hypot(new_std, old_std)
    return f'{name} from {plus_minus(old, old_std)} to {plus_minus(new, new_std)}' if is_step else ''


class Segment(NamedTuple):
    """Inputs without a gap, from a checkpoint on."""

    begin_ns: int  # Log time of the first input [ns]
    files: dict[str, str]  # What the estimators had learned before, and their train file, by name of the file
    entries: list[bytes]  # The inputs, packed


class Watch:
    """Finds what is worth a recording in one estimator: the kind of event and a text."""

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._was_fault = self._had_finding = False
        self._samples = 0
        self._reference: Any = None  # Estimate that later ones are compared with, at most a span old
        self._reference_ns = 0

    def events(self, pipeline: EstimatorPipeline[Any], now_ns: int) -> Iterator[tuple[str, str]]:
        """Yield the events since the last call, by a steady clock [ns]."""
        is_fault, finding = pipeline.status is Status.FAULT, pipeline.stream.finding
        if is_fault and not self._was_fault:
            yield 'fault', 'the estimator cannot continue'
        if finding and not self._had_finding:
            yield 'contradiction', f'inputs contradict each other: {finding}'
        self._was_fault, self._had_finding = is_fault, bool(finding)
        if not pipeline.status.is_usable or pipeline.samples == self._samples:
            return
        self._samples, estimate = pipeline.samples, pipeline.current().estimate
        step = '' if self._reference is None else step_of(self._reference, estimate)
        if step:
            yield 'step', step
        if step or self._reference is None or now_ns - self._reference_ns > self._span_ns:
            self._reference, self._reference_ns = estimate, now_ns


class EventRecorder:
    """Keeps the last inputs of some estimators, and writes them to a bag after an event.

    Attributes:
        files: What makes the texts in the folder of the bag, by name, as of its first input; empty ones are left out.
    """

    def __init__(
        self, folder: Path, minutes: float, write: WriteBag, log: Say, warn: Say, clock: Clock = time.monotonic_ns
    ) -> None:
        """Create the folder; InputError if that fails. ``log`` and ``warn`` are called from the writing thread."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f'record_folder = {str(folder)!r} cannot be created: {error.strerror}') from None
        self.files: dict[str, Callable[[], str]] = {}
        self._folder, self._write, self._log, self._warn, self._clock = folder, write, log, warn, clock
        self._span_ns = round(minutes * 60.0 * NS_PER_S)
        # Log times go on where the clock of the machine is set.
        self._offset_ns = time.time_ns() - clock()
        self._segments: deque[Segment] = deque(maxlen=SEGMENTS)
        self._newest_ns = 0
        self._watches: dict[str, Watch] = {}
        self._due: dict[str, str] = {}  # Kind of the event by its text
        self._free_ns = self._due_ns = 0  # When the next one may be written, and when it is due, by the steady clock
        self._thread = ThreadPoolExecutor(1, 'recorder')
        self._writing: Future[None] | None = None

    def take(self, row: Row) -> None:
        """Keep an input that arrives now, before the estimators take it in."""
        self._newest_ns = log_ns = max(self._newest_ns + 1, self._offset_ns + self._clock())
        segments, span_ns = self._segments, self._span_ns // (SEGMENTS - 1)
        last = segments[-1] if segments else None
        if last is None or log_ns - last.begin_ns >= span_ns or len(last.entries) >= MAX_ROWS // SEGMENTS:
            segments.append(Segment(log_ns, {name: make() for name, make in self.files.items()}, []))
            while len(segments) > 1 and segments[1].begin_ns <= log_ns - self._span_ns:
                segments.popleft()
        segments[-1].entries.append(_ENTRY.pack(log_ns, *row))

    def start_over(self) -> None:
        """Forget the inputs: an estimator that begins to take them in has missed some."""
        self._segments.clear()

    def look(self, name: str, pipeline: EstimatorPipeline[Any]) -> None:
        """Look for events in an estimator, by the name of its node; begin to write if that is due."""
        now_ns = self._clock()
        for kind, text in self._watches.setdefault(name, Watch(self._span_ns)).events(pipeline, now_ns):
            if not self._due:
                self._due_ns = max(self._free_ns, now_ns + _AFTER_NS)
            self._due[f'{name}: {text}'] = f'{name}_{kind}'
        is_free = self._writing is None or self._writing.done()
        if self._due and self._segments and now_ns >= self._due_ns and is_free:
            self._begin(now_ns)

    def request(self, name: str) -> str:
        """Write a bag soon, for a node; return what will happen; InputError before the first message."""
        if not self._segments:
            raise InputError('nothing is recorded: no message has come')
        self._due[f'{name}: requested'] = f'{name}_request'
        self._due_ns = 0
        return f'up to the last {self._span_ns / NS_PER_S / 60.0:g} min are written to {self._folder}'

    def _begin(self, now_ns: int) -> None:
        due, self._due, self._free_ns = self._due, {}, now_ns + MIN_PAUSE_NS
        made = self._segments[0].files | {'event.txt': '\n'.join([*due, ''])}
        entries = [entry for segment in self._segments for entry in segment.entries]
        at = datetime.fromtimestamp(self._newest_ns // NS_PER_S, UTC)
        path = self._folder / f'{at:%Y%m%dT%H%M%SZ}_{next(iter(due.values()))}'
        files = {name: text for name, text in made.items() if text}
        self._writing = self._thread.submit(self._store, path, entries, files)

    def _store(self, path: Path, entries: list[bytes], files: dict[str, str]) -> None:
        try:
            old = sorted(item for item in self._folder.iterdir() if item.is_dir() and _NAME.fullmatch(item.name))
            self._write(path, ((row[0], row[1:]) for row in map(_ENTRY.unpack, entries)), files)
        except (InputError, OSError) as error:
            self._warn(f'{path}: not recorded: {error}')
            return
        for item in old[: max(0, len(old) + 1 - MAX_RECORDINGS)]:
            shutil.rmtree(item, ignore_errors=True)
        self._log(f'{path}: {len(entries)} messages recorded: {"; ".join(files["event.txt"].splitlines())}')

    def flush(self) -> None:
        """Begin to write what would be due later, as nodes stop; the process ends after that."""
        if self._due and self._segments:
            self._begin(0)
