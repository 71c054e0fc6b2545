# SPDX-License-Identifier: Apache-2.0
"""What a pipeline saves, and whether a restored one is possible.

This module is not compiled: the types of the items of tuples are read from its classes when a state is restored.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

from trainid_ros.estimators.consistency import ConsistencyState
from trainid_ros.interface.results import Reason, Rejection, Status
from trainid_ros.state import check_not_negative, check_restored
from trainid_ros.stream.stream_state import StreamState


@dataclass(frozen=True, slots=True)
class ReasonCount:
    """How often something was rejected for one reason."""

    reason: Reason
    count: int


SNAPSHOT_S: Final = 120.0
"""Time in motion between snapshots [s]; a contradiction of the inputs is found within this time."""
SUSPECTED_S: Final = 20.0
"""Time in motion within which a change of the inputs is suspected [s]."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What an estimator had learned, and whether its uncertainty was true."""

    estimator: str  # State of the estimator as text
    consistency: ConsistencyState  # Innovations of the updates before


@dataclass(slots=True)
class Snapshots:
    """Saved states of an estimator, taken after each while of motion, to go back to when inputs were wrong."""

    before: Snapshot  # The state to go back to; it is older than it takes to find a contradiction
    newest: Snapshot  # The newest state
    moved_s: float = 0.0  # Time in motion since then [s]
    left: Snapshot | None = None  # The state where the stamps left their time base, None if they never did

    def add(self, state: Snapshot) -> None:
        """Add the present state."""
        self.before, self.newest, self.moved_s = self.newest, state, 0.0


@dataclass(frozen=True, slots=True)
class PipelineState:
    """State of a pipeline."""

    estimator: str  # State of the estimator as text
    snapshots: Snapshots  # Earlier ones
    stream: StreamState  # State of the stream of samples
    consistency: ConsistencyState  # Innovations of the last updates
    status: Status  # Status of the last output; not FAULT
    used: int  # Samples used
    samples: int  # Samples
    resets: int  # Number of resets
    rejections: tuple[ReasonCount, ...]  # Records and samples not used, by reason
    last_rejection: Rejection | None  # The newest of them, None if there was none
    speed: float  # Speed of the newest sample [m/s]
    sample_ns: int  # Its stamp [ns]

    def check(self) -> None:
        """Raise InputError unless this is a possible state."""
        kind = 'PipelineState'
        self.stream.check()
        check_not_negative(kind, moved_s=self.snapshots.moved_s)
        saved = self.snapshots
        for each in (self, saved.before, saved.newest, saved.left or saved.newest):
            check_restored(each.consistency.is_valid, kind, 'consistency')
        check_restored(self.status is not Status.FAULT, kind, 'status')
        check_not_negative(kind, used=self.used, samples=self.samples, resets=self.resets)
        check_not_negative(kind, speed=self.speed, sample_ns=self.sample_ns)
        check_not_negative(kind, rejections=min((item.count for item in self.rejections), default=0))

    def counted(self) -> Counter[Reason]:
        """Return the rejections."""
        return Counter({item.reason: item.count for item in self.rejections})


def reason_counts(rejections: Counter[Reason]) -> tuple[ReasonCount, ...]:
    """Return rejections to save, in their order."""
    return tuple(ReasonCount(reason, count) for reason, count in rejections.items())
