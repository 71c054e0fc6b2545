# SPDX-License-Identifier: Apache-2.0
"""What a stream of samples saves, and whether a restored one is possible.

This module is not compiled: the types of the items of tuples are read from its classes when a state is restored.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.interface.records import INPUT_TOPICS
from trainid_ros.interface.scalars import find_fault
from trainid_ros.state import MAX_NUMBER, check_not_negative, check_restored
from trainid_ros.stream.drive_history import DriveHistoryState
from trainid_ros.stream.left_time import LeftTime
from trainid_ros.stream.plausibility_state import PlausibilityState
from trainid_ros.stream.stuck_speed import StuckSpeedState
from trainid_ros.stream.travel import Travel
from trainid_ros.train.forces import BrakeCommandChange

if TYPE_CHECKING:
    from collections.abc import Mapping

_KIND: Final = 'StreamState'


@dataclass(frozen=True, slots=True)
class RowsState:
    """Rows of records as columns of equal length, see :data:`~trainid_ros.interface.records.Row`."""

    topic: tuple[int, ...] = ()
    stamp_ns: tuple[int, ...] = ()
    x: tuple[float, ...] = ()
    y: tuple[float, ...] = ()
    flag: tuple[bool, ...] = ()

    def is_valid(self, *, in_order: bool = True) -> bool:
        """Return whether these can be records, with increasing stamps if ``in_order``; y may be NaN."""
        n = len(self.stamp_ns)
        if not len(self.topic) == len(self.x) == len(self.y) == len(self.flag) == n:
            return False
        if not all(0 <= topic < len(INPUT_TOPICS) for topic in self.topic):
            return False
        rows = zip(self.topic, self.stamp_ns, self.x, strict=True)
        # The second number of a gradient is a curvature here.
        possible = all(find_fault(topic, stamp_ns, x, 0.0) is None for topic, stamp_ns, x in rows)
        return (
            possible
            and not any(abs(y) >= MAX_NUMBER for y in self.y)
            and not (in_order and any(a >= b for a, b in pairwise(self.stamp_ns)))
        )


@dataclass(frozen=True, slots=True)
class TrackState:
    """State of the track of one topic: its rows, its newest stamp, and the stamps that its interval is learned from."""

    rows: RowsState = field(default_factory=RowsState)
    last_ns: int = 0
    seen: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class AlignerState:
    """State of the alignment; the names are those of its attributes."""

    force: TrackState
    gradient: TrackState
    brake: TrackState
    mass: TrackState
    speeds_seen: tuple[int, ...]
    pending: RowsState
    newest_ns: int
    speed_ns: int
    agreeing: tuple[int, ...]
    released_ns: int
    sample_ns: int
    due_ns: int
    command: RowsState
    travel: Travel
    suspects: RowsState
    left: LeftTime

    def check(self) -> None:
        """Raise InputError unless this is a possible state."""
        tracks = (self.force, self.gradient, self.brake, self.mass)
        check_restored(all(track.rows.is_valid() for track in tracks), _KIND, 'tracks')
        check_restored(self.pending.is_valid() and self.suspects.is_valid(in_order=False), _KIND, 'records')
        check_restored(self.command.is_valid() and len(self.command.x) <= 1, _KIND, 'command')
        check_restored(self.travel.is_valid, _KIND, 'travel')
        check_restored(self.left.is_valid, _KIND, 'left')
        stamps = (self.newest_ns, self.speed_ns, self.released_ns, self.sample_ns, self.due_ns)
        check_not_negative(_KIND, stamps=min(*stamps, *(track.last_ns for track in tracks)))


@dataclass(frozen=True, slots=True)
class StreamState:
    """State of a stream."""

    aligner: AlignerState  # Records that no sample has been made of yet
    history: DriveHistoryState  # History of the drive
    stop_position: float  # Position at which wheel corrections start [m], NaN while unknown
    stuck: StuckSpeedState  # State of the check for a stuck speed
    plausibility: PlausibilityState  # State of the checks of inputs against each other
    is_skipping: bool  # Whether the stream rejected the last sample
    # Changes of the brake command in the samples that it rejected since the last accepted one
    skipped: tuple[BrakeCommandChange, ...]
    first_ns: int  # First stamp since the start or a jump [ns]
    behind_ns: int  # How far the last required topic is behind the newest stamp [ns]

    def check(self) -> None:
        """Raise InputError unless this is a possible state."""
        self.aligner.check()
        check_restored(self.history.is_valid, _KIND, 'history')
        check_restored(not math.isinf(self.stop_position), _KIND, 'stop_position')
        check_restored(_is_possible(asdict(self.stuck)), _KIND, 'stuck')
        check_restored(_is_possible(asdict(self.plausibility)), _KIND, 'plausibility')
        check_restored(self.plausibility.is_valid, _KIND, 'plausibility')
        known = all(-MAX_NUMBER < change.target_acceleration <= 0.0 for change in self.skipped)
        check_restored(known and (self.is_skipping or not self.skipped), _KIND, 'skipped')
        check_not_negative(_KIND, first_ns=self.first_ns)


# Numbers of the checks that may be unknown, and sums that are not negative.
_UNKNOWN: Final = frozenset({'speed', 'position', 'dt', 'dt_before', 'area', 'area_before', 'answer', 'answer_before'})
_SUMS: Final = frozenset(
    {
        'yy',
        'xx',
        'count',
        'edges',
        'jerks',
        'square',
        'steepness',
        'seconds',
        'learned',
        'limit',
        'spikes',
        'reversals',
        'offset_variance',
        'gain_variance',
        'scatter',
        'spread',
        'off',
        'mended',
        'blocks',
        'excess',
        'passed',
        'left_s',
        'held_s',
        'braked_s',
        'rest_s',
        'time_s',
        'weight',
        'repeats',
        'most',
        'changes',
        'peak',
        'suspected_s',
        'still',
        'longest_still',
        'leaps',
        'lately_by_speed',
    }
)


def _is_possible(values: Mapping[str, Any]) -> bool:
    """Return whether all numbers of nested checks are finite, and their sums not negative."""
    for name, value in values.items():
        low = 0.0 if name in _SUMS else -MAX_NUMBER
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, dict):
                possible = _is_possible(item)
            else:
                is_unknown = name in _UNKNOWN and isinstance(item, float) and math.isnan(item)
                possible = isinstance(item, str) or is_unknown or low <= item < MAX_NUMBER
            if not possible:
                return False
    return True
