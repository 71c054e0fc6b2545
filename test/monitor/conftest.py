# SPDX-License-Identifier: Apache-2.0
"""Messages of a train that coasts from 72 km/h, and a train that has received them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import pytest

from trainid_ros.interface.records import (
    BRAKE_RATE_TOPIC,
    BRAKE_TOPIC,
    FORCE_TOPIC,
    GRADIENT_TOPIC,
    NS_PER_S,
    RESISTANCE_TOPIC,
    SPEED_MODEL_TOPIC,
    SPEED_TOPIC,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    SpeedRecord,
    output_values,
)
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.monitor.trains import Level, Report, Train, Trains

START_NS = 1_700_000_000 * NS_PER_S
VARIANCES = (0.04, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-6)
RESISTANCE = ResistanceEstimate(1.6, 0.02, 0.001, VARIANCES, 1.9, 0.2, 10.0, 0.1, 0.04, 0.02, 5.0, 20.0, 0.3)
MODEL_VARIANCES = tuple(1e-8 if i == 10 else 0.0 for i in range(16))
MODEL = SpeedModelEstimate(-1e-5, 0.999, 0.002, -0.01, MODEL_VARIANCES, 1.0, 10.0, 0.01, 1.6, 0.02, 0.001, 1.08, 4e-4)
BRAKE = BrakeRateEstimate(0.91, 0.05, 0.0, 10.0, -0.4, 0.0, 100.0, True, 0.01, 0.001, 0.01)
ESTIMATES = ((RESISTANCE_TOPIC, RESISTANCE), (SPEED_MODEL_TOPIC, MODEL), (BRAKE_RATE_TOPIC, BRAKE))


def feed(
    train: Train, begin_s: float, end_s: float, status: int = Status.VALID, *, replaced: float | None = None
) -> None:
    """Hand a train its messages at 5 Hz, each 50 ms old as it arrives; ``replaced`` stands for all its numbers."""
    for k in range(round(5.0 * begin_s), round(5.0 * end_s)):
        time_s = k / 5.0
        stamp = START_NS + round((time_s - 0.05) * NS_PER_S)
        for topic, record in (
            (SPEED_TOPIC, SpeedRecord(stamp, 20.0 - 0.1 * time_s, 20.0 * time_s)),
            (FORCE_TOPIC, ForceRecord(stamp, 50e3)),
            (GRADIENT_TOPIC, GradientRecord(stamp, -4.0, 0.0, True)),
            (BRAKE_TOPIC, BrakeRecord(stamp, -0.5, False)),
        ):
            train.on_input(topic, record if replaced is None else _all_numbers(record, replaced), time_s)
        for output, estimate in ESTIMATES:
            given = estimate if replaced is None else _all_numbers(estimate, replaced)
            values = {**output_values(Output(stamp, given, Status.VALID, 12, 8, None)), 'status': int(status)}
            train.on_estimate(output, SimpleNamespace(**values), time_s, START_NS + round(time_s * NS_PER_S))


def _all_numbers(item: Any, value: float) -> Any:
    """Return a record or an estimate with a value for each of its numbers but the stamp."""
    numbers = {name: x for name, x in ((y.name, getattr(item, y.name)) for y in fields(item)) if name != 'stamp_ns'}
    found = {name: (value,) * len(x) if isinstance(x, tuple) else value for name, x in numbers.items() if x is not True}
    return replace(item, **found)


@pytest.fixture
def driven() -> Callable[..., Trains]:
    """Return a factory of trains that have driven for ten seconds, with what their nodes report."""

    def make(*namespaces: str) -> Trains:
        trains = Trains()
        for namespace in namespaces or ('/',):
            train = trains.add(namespace)
            feed(train, 0.0, 10.0)
            train.on_publishers({topic.name: ('/ato',) for topic in (SPEED_TOPIC, RESISTANCE_TOPIC)})
            counts = {'rejected.BRAKING': '3', 'rejected.STANDSTILL': '5', 'used': '12', 'state': 'active'}
            trains.on_diagnostics(
                f'{namespace.strip("/")}/resistance_estimator: estimator'.lstrip('/'),
                Report(Level.OK, 'VALID: fit to use', counts, 9.5),
            )
        return trains

    return make
