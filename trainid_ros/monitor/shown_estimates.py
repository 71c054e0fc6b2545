# SPDX-License-Identifier: Apache-2.0
"""Which value of each estimate is shown, with its standard deviation, and what beside it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from trainid_ros.interface.records import BRAKE_RATE_TOPIC, KM_H, RESISTANCE_TOPIC, SPEED_MODEL_TOPIC
from trainid_ros.interface.results import Status, deviations
from trainid_ros.resistance.davis_posterior import resistance_std

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.interface.records import OutputTopic

_STEP_KMH: Final = 5.0
_USUAL_KMH: Final = 50.0
# Larger speeds [m/s] and covariances count as unknown: messages may hold any number.
_MAX_SPEED: Final = 1000.0
_LARGEST: Final = 1e280
# Place of the variance of b1 in the covariance of (a1, a2, b1, d0), row by row.
_B1: Final = 10


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
    spread = math.sqrt(max(float(message.covariance[_B1]), 0.0)) / message.b1 if message.b1 > 0.0 else math.nan
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
        SPEED_MODEL_TOPIC,
        'speed model',
        '',
        lambda _: 'mass factor',
        lambda message, _: mass_factor(message),
        _model_details,
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
