# SPDX-License-Identifier: Apache-2.0
"""Single records: impossible values are rejected with value and limit, unusual ones are not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord
from trainid_ros.interface.results import Reason, Rejection
from trainid_ros.interface.scalars import find_fault

NS = 1_700_000_000_000_000_000
GOOD: tuple[Record, ...] = (
    SpeedRecord(NS, 20.0, 1000.0),
    SpeedRecord(NS, 0.0, math.nan),
    SpeedRecord(NS, 20.0, -5000.0),
    ForceRecord(NS, -3e5),
    GradientRecord(NS, -35.0, 0.0, tunnel=True),
    BrakeRecord(NS, 0.0, emergency=True),
    BrakeRecord(NS, -1.2, emergency=False),
    MassRecord(NS, 2e5),
)


def fault_of(record: Record) -> Rejection | None:
    return find_fault(*record.row()[:4])


@pytest.mark.parametrize('record', GOOD, ids=repr)
def test_possible_records_pass(record: Record) -> None:
    assert fault_of(record) is None


@pytest.mark.parametrize('record', GOOD, ids=repr)
@pytest.mark.parametrize('stamp_ns', [0, -1])
def test_a_record_without_a_stamp_is_rejected(record: Record, stamp_ns: int) -> None:
    fault = fault_of(replace(record, stamp_ns=stamp_ns))
    assert fault is not None
    assert fault.reason is Reason.ZERO_STAMP


@pytest.mark.parametrize(
    'record',
    [
        *(
            record
            for x in (math.nan, math.inf, -math.inf)
            for record in (
                SpeedRecord(NS, x, 0.0),
                ForceRecord(NS, x),
                GradientRecord(NS, x, 0.0, tunnel=False),
                BrakeRecord(NS, x, emergency=False),
                MassRecord(NS, x),
            )
        ),
        GradientRecord(NS, 1.0, math.nan, tunnel=False),
        # Only NaN means an unknown position; an infinity would set the direction of travel.
        SpeedRecord(NS, 10.0, math.inf),
        SpeedRecord(NS, 10.0, -math.inf),
    ],
    ids=repr,
)
def test_a_value_that_is_not_finite_is_rejected(record: Record) -> None:
    fault = fault_of(record)
    assert fault is not None
    assert fault.reason is Reason.NOT_FINITE


@pytest.mark.parametrize(
    ('record', 'value', 'limit'),
    [
        (SpeedRecord(NS, -0.01, 0.0), -0.01, 0.0),
        (SpeedRecord(NS, 201.0, 0.0), 201.0, 200.0),
        (SpeedRecord(NS, 20.0, 1.1e9), 1.1e9, 1e9),
        (SpeedRecord(NS, 20.0, -1.7e308), -1.7e308, -1e9),
        (ForceRecord(NS, 2e8), 2e8, 1e8),
        (GradientRecord(NS, -300.0, 0.0, tunnel=False), -300.0, -200.0),
        (GradientRecord(NS, 0.0, -400.0, tunnel=False), -400.0, 5.0),
        (GradientRecord(NS, 0.0, 0.001, tunnel=False), 0.001, 5.0),
        (BrakeRecord(NS, 0.1, emergency=False), 0.1, 0.0),
        (BrakeRecord(NS, -11.0, emergency=False), -11.0, -10.0),
        (MassRecord(NS, 0.0), 0.0, 100.0),
    ],
    ids=repr,
)
def test_an_impossible_value_is_rejected_with_the_limit_it_violates(record: Record, value: float, limit: float) -> None:
    assert fault_of(record) == Rejection(NS, Reason.OUT_OF_RANGE, value, limit)
