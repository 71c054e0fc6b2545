# SPDX-License-Identifier: Apache-2.0
"""Bitwise comparison of the messages of the live nodes with those of a replay."""

from __future__ import annotations

import struct
from collections import defaultdict
from dataclasses import dataclass, fields
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, NamedTuple

from trainid_ros.results import Status

if TYPE_CHECKING:
    from collections.abc import Iterable

    from trainid_ros.bag.bag_replay import AnyOutput


class Fingerprint(NamedTuple):
    """What identifies a message: its stamp, digests of its estimate and of its status and counters, and the status."""

    stamp_ns: int
    estimate: bytes
    health: bytes
    status: int


@dataclass(frozen=True, slots=True)
class Comparison:
    """Live messages of one topic against a replay.

    Attributes:
        replayed: Messages of the replay.
        received: Live messages received.
        equal: Live messages whose estimate equals the replayed one to the bit.
        equal_health: Those of them whose status and counters are equal too.
        missing: Replayed messages without a live one.
        extra: Live messages without a replayed one.
        reported_stale: Live messages that only report missing input, which a replay without a clock cannot detect.

    """

    replayed: int
    received: int
    equal: int
    equal_health: int
    missing: int
    extra: int
    reported_stale: int

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
