# SPDX-License-Identifier: Apache-2.0
"""What a pipeline saves, and whether a restored one is possible.

This module is not compiled: the types of the items of tuples are read from its classes when a state is restored.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

from trainid_ros.estimators.consistency import ConsistencyState
from trainid_ros.results import Reason, Rejection, Status
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
    """What an estimator had learned, and whether its uncertainty was true.

    Attributes:
        estimator: State of the estimator as text.
        consistency: Innovations of the updates before.

    """

    estimator: str
    consistency: ConsistencyState


@dataclass(slots=True)
class Snapshots:
    """Saved states of an estimator, taken after each while of motion, to go back to when inputs were wrong.

    Attributes:
        before: The state to go back to; it is older than it takes to find a contradiction.
        newest: The newest state.
        moved_s: Time in motion since then [s].
        left: The state where the stamps left their time base, None if they never did.

    """

    before: Snapshot
    newest: Snapshot
    moved_s: float = 0.0
    left: Snapshot | None = None

    def add(self, state: Snapshot) -> None:
        """Add the present state."""
        self.before, self.newest, self.moved_s = self.newest, state, 0.0


@dataclass(frozen=True, slots=True)
class PipelineState:
    """State of a pipeline.

    Attributes:
        estimator: State of the estimator as text.
        snapshots: Earlier ones.
        stream: State of the stream of samples.
        consistency: Innovations of the last updates.
        status: Status of the last output; not FAULT.
        used: Samples used.
        samples: Samples.
        resets: Number of resets.
        rejections: Records and samples not used, by reason.
        last_rejection: The newest of them, None if there was none.
        speed: Speed of the newest sample [m/s].
        sample_ns: Its stamp [ns].

    """

    estimator: str
    snapshots: Snapshots
    stream: StreamState
    consistency: ConsistencyState
    status: Status
    used: int
    samples: int
    resets: int
    rejections: tuple[ReasonCount, ...]
    last_rejection: Rejection | None
    speed: float
    sample_ns: int

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
