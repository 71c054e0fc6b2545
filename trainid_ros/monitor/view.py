# SPDX-License-Identifier: Apache-2.0
"""What a person is shown of a train at one moment, as plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from trainid_ros.results import Status


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
    """What is wrong or in progress.

    Attributes:
        level: How bad it is.
        source: Node or input that it is about.
        text: What is the case, since when, and what to do.

    """

    level: Level
    source: str
    text: str


@dataclass(frozen=True, slots=True)
class InputView:
    """One input.

    Attributes:
        name: Topic, without the namespace of the train.
        value: Its newest value with its unit, '' before the first.
        rate: Messages in a second [Hz], NaN if unknown.
        age_s: Age of the newest stamp [s], NaN if unknown or of another clock.
        silent_s: Time since the last message [s], infinite before the first.
        publishers: Nodes that publish it.
        optional: True if the estimators can run without it.

    """

    name: str
    value: str
    rate: float
    age_s: float
    silent_s: float
    publishers: tuple[str, ...]
    optional: bool


@dataclass(frozen=True, slots=True)
class Point:
    """An estimate of the past: how long ago [s], its value and standard deviation, in the unit of the estimate."""

    ago_s: float
    value: float
    std: float


@dataclass(frozen=True, slots=True)
class EstimateView:
    """One estimate.

    Attributes:
        name: What is estimated.
        quantity: The value that is shown.
        unit: Its unit, '' for none.
        value: The value, NaN before the first message.
        std: Its standard deviation.
        details: Further values as text.
        status: Status, None before the first message.
        status_s: Time for which it has this status [s].
        is_longer: True if it had the status before it was first seen, for an unknown time.
        idle: Lifecycle state of its node if that is known and not active, else ''.
        silent_s: Time since the last message [s], infinite before the first.
        is_silent: True if messages should have come since then.
        is_published: True if a node publishes the topic.
        used: Samples used.
        rejected: Samples not used.
        reasons: Why, with their numbers, the most frequent first; empty before the first diagnostics.
        history: Past values, the oldest first.

    """

    name: str
    quantity: str
    unit: str
    value: float
    std: float
    details: str
    status: Status | None
    status_s: float
    is_longer: bool
    idle: str
    silent_s: float
    is_silent: bool
    is_published: bool
    used: int
    rejected: int
    reasons: tuple[tuple[str, int], ...]
    history: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class TrainView:
    """One train.

    Attributes:
        namespace: Namespace of its topics, '/' for the root.
        time: Time of day.
        speed_kmh: Speed [km/h], NaN if unknown.
        inputs: Its inputs.
        estimates: Its estimates.
        findings: What is wrong or in progress, the worst first.
        has_diagnostics: True if any of its nodes has reported.

    """

    namespace: str
    time: str
    speed_kmh: float
    inputs: tuple[InputView, ...]
    estimates: tuple[EstimateView, ...]
    findings: tuple[Finding, ...]
    has_diagnostics: bool


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
