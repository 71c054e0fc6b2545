# SPDX-License-Identifier: Apache-2.0
"""What a person is shown of a train at one moment: plain values, and which value of each estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.interface.records import BRAKE_RATE_TOPIC, KM_H, RESISTANCE_TOPIC, SPEED_MODEL_TOPIC
from trainid_ros.interface.results import Status, deviations
from trainid_ros.resistance.davis_posterior import resistance_std

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.interface.records import OutputTopic


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
    return f'{value:.{digits}f}' if abs(value) < 1e9 else f'{value:.{digits}e}'


def with_band(estimate: EstimateView) -> str:
    """Return value, standard deviation and unit of an estimate."""
    return f'{number(estimate.value)} ± {number(estimate.std)} {estimate.unit}'.rstrip()


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


_STEP_KMH: Final = 5.0
_USUAL_KMH: Final = 50.0
# Larger speeds [m/s] and covariances count as unknown: messages may hold any number.
_MAX_SPEED: Final = 1000.0
_LARGEST: Final = 1e280


class ShownEstimate(NamedTuple):
    """How one estimate is shown."""

    topic: OutputTopic  # Its topic
    name: str  # What is estimated
    unit: str  # Unit of the value shown, '' for none
    quantity: Callable[[Any], str]  # Names the value shown, given the newest message
    # Value and standard deviation of a message, given the newest message
    value: Callable[[Any, Any], tuple[float, float]]
    details: Callable[[Any], str]  # Further values of a message as text


def reference_speed(message: Any) -> float:
    """Return the speed at which a resistance is shown [m/s]: the middle of those learned from, in steps of 5 km/h.

    The present speed changes all the time, and w with it: a change of the estimate would not be seen.
    """
    if not 0.0 <= message.speed_min <= message.speed_max < _MAX_SPEED or message.speed_max == 0.0:
        return _USUAL_KMH / KM_H
    middle = 0.5 * KM_H * float(message.speed_min + message.speed_max)
    return max(round(middle / _STEP_KMH), 1) * _STEP_KMH / KM_H


def resistance_at(message: Any, speed: float) -> tuple[float, float]:
    """Return w and its standard deviation [N/kN] at a speed [m/s]."""
    w = message.a + message.b * speed + message.c * speed * speed
    is_known = all(abs(item) < _LARGEST for item in message.covariance)
    return float(w), resistance_std(message.covariance, speed) if is_known else math.nan


def _resistance_details(message: Any) -> str:
    a, b, c = deviations(message.covariance)
    text = f'a {message.a:.2f} ± {a:.2f}  b {message.b:.4f} ± {b:.4f}  c {message.c:.5f} ± {c:.5f}'
    if not message.speed_max > 0.0:
        return f'{text}  nothing learned yet'
    return f'{text}  seen {KM_H * message.speed_min:.0f} to {KM_H * message.speed_max:.0f} km/h'


def mass_factor(message: Any) -> tuple[float, float]:
    """Return the mass factor and its standard deviation [1]; it is inversely proportional to b1."""
    variance = float(message.covariance[10])  # of b1, in that of (a1, a2, b1, d0)
    spread = math.sqrt(max(variance, 0.0)) / message.b1 if message.b1 > 0.0 else math.nan
    return float(message.mass_factor), float(message.mass_factor) * spread


def _model_details(message: Any) -> str:
    stated = math.sqrt(max(message.prediction_variance, 0.0))
    known = f' (stated ± {stated:.3f})' if stated > 0.0 else ''
    return f'prediction error {message.prediction_error:+.3f} m/s{known}  a1 {message.a1:.3g}  a2 {message.a2:.5f}'


def _brake_details(message: Any) -> str:
    is_current = message.status not in (Status.STALE, Status.FAULT)
    seen = 'braking now' if message.observable and is_current else 'seen only while braking'
    return f'{seen}  brake acts with {-message.control_acceleration:.2f} m/s²'


SHOWN: Final = (
    ShownEstimate(
        RESISTANCE_TOPIC,
        'resistance',
        'N/kN',
        lambda newest: f'w at {KM_H * reference_speed(newest):.0f} km/h',
        lambda message, newest: resistance_at(message, reference_speed(newest)),
        _resistance_details,
    ),
    ShownEstimate(
        SPEED_MODEL_TOPIC, 'speed model', '', lambda _: 'mass factor', lambda m, _: mass_factor(m), _model_details
    ),
    ShownEstimate(
        BRAKE_RATE_TOPIC,
        'brake rate',
        '',
        lambda _: '1 = nominal',
        lambda message, _: (float(message.brake_rate), float(message.brake_rate_std)),
        _brake_details,
    ),
)


def value_text(values: Sequence[tuple[float, str, int]]) -> str:
    """Return the values of an input, each given with its unit and decimals; those that are not known are left out."""
    return '  '.join(f'{value:.{digits}f} {unit}' for value, unit, digits in values if math.isfinite(value))
