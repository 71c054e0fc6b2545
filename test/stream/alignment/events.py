# SPDX-License-Identifier: Apache-2.0
"""Times of records and kinds of events, as the tests of the alignment write them."""

from __future__ import annotations

from typing import TypeVar

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Rejection
from trainid_ros.stream.alignment import AlignmentEvent, TimeJump
from trainid_ros.stream.samples import Sample

START = 1_700_000_000 * NS_PER_S
Event = TypeVar('Event', Sample, Rejection, TimeJump)


def at(seconds: float) -> int:
    """Return a time after the start [s] as a stamp [ns]."""
    return START + round(seconds * NS_PER_S)


def of(kind: type[Event], events: list[AlignmentEvent]) -> list[Event]:
    """Return the events of one kind."""
    return [event for event in events if isinstance(event, kind)]
