# SPDX-License-Identifier: Apache-2.0
"""What a person is shown of a train at one moment, as plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from trainid_ros.interface.results import Status


# Numbers from here on are written with a power of ten.
_LONG: Final = 1e9


class Level(IntEnum):
    """Level of a diagnostic message; the same numbers as in ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3

    @property
    def severity(self) -> int:
        """How bad it is: unlike by the numbers, an error is worse than STALE."""
        return (Level.OK, Level.WARN, Level.STALE, Level.ERROR).index(self)

    @classmethod
    def _missing_(cls, value: object) -> Level:  # noqa: ARG003 - any other number, which may come from other software
        return cls.ERROR


@dataclass(frozen=True, slots=True)
class Finding:
    """What is wrong or in progress."""

    level: Level  # How bad it is
    source: str  # Node or input that it is about
    text: str  # What is the case, since when, and what to do


@dataclass(frozen=True, slots=True)
class InputView:
    """One input."""

    name: str  # Topic, without the namespace of the train
    value: str  # Its newest value with its unit, '' before the first
    rate: float  # Messages in a second [Hz], NaN if unknown
    age_s: float  # Age of the newest stamp [s], NaN if unknown or of another clock
    silent_s: float  # Time since the last message [s], infinite before the first
    publishers: tuple[str, ...]  # Nodes that publish it
    optional: bool  # True if the estimators can run without it


@dataclass(frozen=True, slots=True)
class Point:
    """An estimate of the past: how long ago [s], its value and standard deviation, in the unit of the estimate."""

    ago_s: float
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class EstimateView:
    """One estimate."""

    name: str  # What is estimated
    quantity: str  # The value that is shown
    unit: str  # Its unit, '' for none
    value: float  # The value, NaN before the first message
    std: float  # Its standard deviation
    details: str  # Further values as text
    status: Status | None  # Status, None before the first message
    status_s: float  # Time for which it has this status [s]
    is_longer: bool  # True if it had the status before it was first seen, for an unknown time
    idle: str  # Lifecycle state of its node if that is known and not active, else ''
    silent_s: float  # Time since the last message [s], infinite before the first
    is_silent: bool  # True if messages should have come since then
    is_published: bool  # True if a node publishes the topic
    used: int  # Samples used
    rejected: int  # Samples not used
    # Why, with their numbers, the most frequent first; empty before the first diagnostics
    reasons: tuple[tuple[str, int], ...]
    history: tuple[Point, ...]  # Past values, the oldest first


@dataclass(frozen=True, slots=True)
class TrainView:
    """One train."""

    namespace: str  # Namespace of its topics, '/' for the root
    time: str  # Time of day
    speed_kmh: float  # Speed [km/h], NaN if unknown
    inputs: tuple[InputView, ...]  # Its inputs
    estimates: tuple[EstimateView, ...]  # Its estimates
    findings: tuple[Finding, ...]  # What is wrong or in progress, the worst first
    has_diagnostics: bool  # True if any of its nodes has reported


def number(value: float, digits: int = 3) -> str:
    """Return a number with a fixed count of decimals, an absurd one with a power of ten; a dash if it is not finite."""
    if not math.isfinite(value):
        return '–'
    return f'{value:.{digits}f}' if abs(value) < _LONG else f'{value:.{digits}e}'


def with_band(estimate: EstimateView) -> str:
    """Return value, standard deviation and unit of an estimate."""
    text = f'{number(estimate.value)} ± {number(estimate.std)}'
    return f'{text} {estimate.unit}'.rstrip()


def state_of(estimate: EstimateView) -> str:
    """Return what a person should know first of an estimate: its status, or that it does not come."""
    if estimate.status is None:
        return estimate.idle.upper() or ('nothing yet' if estimate.is_published else 'no node')
    if estimate.is_silent:
        return f'{estimate.idle.upper() or "SILENT"} {duration(estimate.silent_s, 1)}'
    return f'{estimate.status.name} {"≥ " if estimate.is_longer else ""}{duration(estimate.status_s)}'


def duration(seconds: float, digits: int = 0) -> str:
    """Return a time span [s] in a few characters, with decimals below a minute if wanted."""
    if seconds < 60.0:
        return f'{seconds:.{digits}f} s' if digits else f'{int(seconds)} s'
    minutes, rest = divmod(int(seconds), 60)
    return f'{minutes}:{rest:02d} min' if minutes < 60 else f'{minutes // 60}:{minutes % 60:02d} h'


def rejections(estimate: EstimateView) -> str:
    """Return how many samples were not used, and why."""
    reasons = ', '.join(f'{name.lower().replace("_", " ")} {count}' for name, count in estimate.reasons)
    return f'used {estimate.used}, rejected {estimate.rejected}{f": {reasons}" if reasons else ""}'
