# SPDX-License-Identifier: Apache-2.0
"""One bag of the demo: its live run is compared with a replay to the bit, scored and made a chapter of the report."""

from __future__ import annotations

import math
import struct
from collections import defaultdict
from dataclasses import dataclass, fields
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, NamedTuple

from trainid_ros.bag.bag_replay import AnyOutput, Replay, replay
from trainid_ros.bag.reader import BagReader, LoggedRecord
from trainid_ros.demo.view import LABELS
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.pipelines import EstimatorSettings
from trainid_ros.report.chapter import AccuracyScore, Chapter, RejectionCounts, score_brake_rate, score_resistance

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from trainid_ros.demo.bags import DemoBag
    from trainid_ros.demo.live import LiveRun
    from trainid_ros.recording import Recorder


class Fingerprint(NamedTuple):
    """What identifies a message: its stamp, digests of its estimate and of its status and counters, and the status."""

    stamp_ns: int
    estimate: bytes
    health: bytes
    status: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Live messages of one topic against a replay."""

    replayed: int  # Messages of the replay
    received: int  # Live messages received
    equal: int  # Live messages whose estimate equals the replayed one to the bit
    equal_health: int  # Those of them whose status and counters are equal too
    missing: int  # Replayed messages without a live one
    extra: int  # Live messages without a replayed one
    reported_stale: int  # Live messages that only report missing input, which a replay without a clock cannot detect

    @property
    def exact(self) -> bool:
        """True if every message of the replay was received, with the same estimate to the bit."""
        return self.equal == self.replayed and self.missing == 0 and self.extra == 0


def fingerprint_of_output(output: AnyOutput) -> Fingerprint:
    """Return the fingerprint of the message that a node would publish for an output."""
    estimate, rejection = output.estimate, output.last_rejection
    values = [getattr(estimate, item.name) for item in fields(estimate)]
    reason, text = (0, '') if rejection is None else (int(rejection.reason), str(rejection))
    health = (int(output.status), output.used, output.rejected, reason, text)
    return Fingerprint(output.stamp_ns, _bits(values), _digest(repr(health).encode()), int(output.status))


def fingerprint_of_message(message: Any, stamp_ns: int, names: Iterable[str]) -> Fingerprint:
    """Return the fingerprint of a message; ``names`` are the fields of its estimate in their order."""
    values = [getattr(message, name) for name in names]
    counters = (int(message.used), int(message.rejected), int(message.last_reject_reason))
    health = (int(message.status), *counters, str(message.last_reject_text))
    return Fingerprint(stamp_ns, _bits(values), _digest(repr(health).encode()), int(message.status))


def compare(live: Iterable[Fingerprint], replayed: Iterable[Fingerprint]) -> Comparison:
    """Compare by stamp; messages with the same stamp are compared in their order."""
    expected: dict[int, list[Fingerprint]] = defaultdict(list)
    for item in replayed:
        expected[item.stamp_ns].append(item)
    total = sum(map(len, expected.values()))
    received = equal = equal_health = extra = reported_stale = 0
    for item in live:
        received += 1
        waiting = expected.get(item.stamp_ns)
        if not waiting:
            reported_stale += item.status == Status.STALE
            extra += item.status != Status.STALE
            continue
        wanted = waiting.pop(0)
        equal += item.estimate == wanted.estimate
        equal_health += item.estimate == wanted.estimate and item.health == wanted.health
    missing = sum(map(len, expected.values()))
    return Comparison(total, received, equal, equal_health, missing, extra, reported_stale)


def _bits(values: Iterable[Any]) -> bytes:
    numbers: list[float] = []
    for value in values:
        numbers.extend(value if hasattr(value, '__len__') else (value,))
    return _digest(struct.pack(f'<{len(numbers)}d', *numbers))


def _digest(data: bytes) -> bytes:
    return blake2b(data, digest_size=12).digest()


@dataclass(frozen=True, slots=True)
class ComparisonOutcome:
    """Result of the demo for one bag."""

    chapter: Chapter  # For the report
    comparisons: tuple[tuple[str, Comparison], ...]  # Live against replay, by estimate
    resistance: AccuracyScore | None  # Errors of w at the current speed [N/kN], None without truth
    brake_rate: AccuracyScore | None  # Errors of the brake rate [1], None without truth
    rate: float  # Recorded seconds per second of the live run [1]

    @property
    def worked(self) -> bool:
        """True if every live estimate equals its replayed one."""
        return all(comparison.exact for _, comparison in self.comparisons)


class _Check:
    """Takes fingerprints of a replay, and records its inputs, which are those of the live run."""

    def __init__(self, recorder: Recorder) -> None:
        self.fingerprints: dict[type, list[Fingerprint]] = {kind: [] for kind in LABELS}
        self._recorder = recorder

    def on_record(self, entry: LoggedRecord) -> None:
        self._recorder.on_record(entry)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002 - only stamps are compared
        self.fingerprints[type(output.estimate)].append(fingerprint_of_output(output))


def conclude(bag: DemoBag, live: LiveRun, duration_s: float, progress: Callable[[float], None]) -> ComparisonOutcome:
    """Replay a bag off line and compare.

    Args:
        bag: The bag.
        live: Result of the live run.
        duration_s: Length that was played [s], 0 for all.
        progress: Called with the number of inputs replayed since its last call.
    """
    check = _Check(live.recorder)
    with BagReader(bag.path) as reader:
        limit_s = duration_s if duration_s > 0.0 else math.inf
        replayed = replay(reader, bag.train_file, EstimatorSettings(), progress, (check,), duration_s=limit_s)
    pairs = ((label, live.fingerprints[kind], check.fingerprints[kind]) for kind, label in LABELS.items())
    comparisons = tuple((label, compare(received, expected)) for label, received, expected in pairs)
    recording = live.recorder.finish()
    rate = recording.duration_s / live.wall_s if live.wall_s > 0.0 else math.nan
    notes = tuple(describe_comparison(label, comparison) for label, comparison in comparisons)
    chapter = _chapter(bag, live, replayed, notes, f'live over ROS 2 at {rate:.0f} x real time, then off line')
    return ComparisonOutcome(
        chapter=chapter,
        comparisons=comparisons,
        resistance=None if bag.truth is None else score_resistance(recording, bag.truth),
        brake_rate=None if bag.truth is None else score_brake_rate(recording, bag.truth),
        rate=rate,
    )


def describe_comparison(label: str, comparison: Comparison) -> str:
    """Return the comparison of live and replay in words."""
    if comparison.exact and comparison.equal_health == comparison.equal:
        text = f'live equals replay to the bit: all {comparison.replayed} messages'
    elif comparison.exact:
        text = (
            f'live equals replay to the bit: all {comparison.replayed} estimates '
            f'({comparison.replayed - comparison.equal_health} differ in status or counters)'
        )
    else:
        text = (
            f'live differs from replay: {comparison.equal} of {comparison.replayed} estimates are equal to the bit, '
            f'{comparison.missing} were missed, {comparison.extra} have no counterpart'
        )
    return f'{label}: {text}'


def _chapter(bag: DemoBag, live: LiveRun, replayed: Replay, notes: tuple[str, ...], how: str) -> Chapter:
    # A node that published nothing live still has its prior, which the replay shows too.
    newest: dict[type, Any] = {
        ResistanceEstimate: replayed.resistance.output,
        SpeedModelEstimate: replayed.speed_model.output,
        BrakeRateEstimate: replayed.brake_rate.output,
        **live.newest,
    }
    rejections = tuple(
        RejectionCounts(label, tuple(sorted(live.rejections.get(kind, {}).items()))) for kind, label in LABELS.items()
    )
    return Chapter(
        title=bag.title,
        bag=str(bag.path),
        train_file_name=str(bag.train_path),
        train_file=bag.train_file,
        how=how,
        recording=live.recorder.finish(),
        resistance=newest[ResistanceEstimate],
        speed_model=newest[SpeedModelEstimate],
        brake_rate=newest[BrakeRateEstimate],
        rejections=rejections,
        truth=bag.truth,
        notes=notes,
    )
