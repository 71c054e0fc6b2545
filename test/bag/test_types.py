# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.bag.types import (
    digest,
    estimate_message,
    full_type,
    message_from_record,
    split_stamp,
    typestore,
)
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    SPEED_TOPIC,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
    record_from_message,
)
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Estimate,
    Output,
    Reason,
    Rejection,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)

TOPICS = {topic.message: topic for topic in INPUT_TOPICS}
STAMP = 1_700_000_000_123_456_789
RECORDS: list[tuple[str, Record]] = [
    ('AtoSpeed', SpeedRecord(STAMP, 12.5, 1450.25)),
    ('AtoForce', ForceRecord(STAMP, -1.5e5)),
    ('TrackGradient', GradientRecord(STAMP, -12.5, 400.0, tunnel=True)),
    ('BrakeCommand', BrakeRecord(STAMP, -0.75, emergency=True)),
    ('TrainMass', MassRecord(STAMP, 194e3)),
]


@pytest.mark.parametrize(('name', 'record'), RECORDS)
def test_record_survives_serialisation(name: str, record: Record) -> None:
    store, kind = typestore(), full_type(name)
    message = store.deserialize_cdr(store.serialize_cdr(message_from_record(record), kind), kind)
    assert record_from_message(TOPICS[name], message) == record


def test_values_that_are_not_finite_are_passed_on() -> None:
    message = message_from_record(SpeedRecord(STAMP, math.inf, math.nan))
    back = record_from_message(SPEED_TOPIC, message)
    assert isinstance(back, SpeedRecord)
    assert back.speed == math.inf
    assert math.isnan(back.position)


def test_numpy_scalars_become_plain_numbers() -> None:
    message = message_from_record(ForceRecord(STAMP, np.float32(1.5)))  # type: ignore[arg-type]
    assert type(message.force) is float


def numbered(kind: type[Estimate], width: int) -> Estimate:
    """Return an estimate in which each field has a different value."""
    values: dict[str, object] = {item.name: float(i) for i, item in enumerate(fields(kind), 1)}
    if width:
        values['covariance'] = tuple(float(i) for i in range(width))
    if kind is BrakeRateEstimate:
        values['observable'] = True
    return kind(**values)  # type: ignore[arg-type]


@pytest.mark.parametrize(('kind', 'width'), [(ResistanceEstimate, 9), (SpeedModelEstimate, 16), (BrakeRateEstimate, 0)])
def test_estimate_fills_every_field_of_its_message(kind: type[Estimate], width: int) -> None:
    estimate = numbered(kind, width)
    rejection = Rejection(STAMP, Reason.OUTLIER, 9.0, 4.0)
    output = Output(STAMP, estimate, Status.HOLDING, 7, 3, rejection)
    store, name = typestore(), full_type(kind.__name__)
    message = store.deserialize_cdr(store.serialize_cdr(estimate_message(output), name), name)
    for item in fields(kind):
        expected = getattr(estimate, item.name)
        actual = getattr(message, item.name)
        assert (tuple(actual) if isinstance(expected, tuple) else actual) == expected, item.name
    assert (message.status, message.used, message.rejected) == (3, 7, 3)  # type: ignore[attr-defined]
    assert message.last_reject_reason == Reason.OUTLIER.value  # type: ignore[attr-defined]
    assert message.last_reject_text == str(rejection)  # type: ignore[attr-defined]


def test_an_output_without_rejection_has_reason_zero() -> None:
    message = estimate_message(Output(STAMP, numbered(BrakeRateEstimate, 0), Status.VALID, 1, 0, None))
    assert (message.last_reject_reason, message.last_reject_text) == (0, '')


@pytest.mark.parametrize('stamp', [-1, 2**31 * 10**9])
def test_a_stamp_outside_ros_time_is_rejected(stamp: int) -> None:
    with pytest.raises(InputError, match=str(stamp)):
        split_stamp(stamp)


def test_stamp_is_split_exactly() -> None:
    assert split_stamp(STAMP) == (1_700_000_000, 123_456_789)


def test_every_definition_is_packaged() -> None:
    root = Path(__file__).parents[2] / 'msg_defs' / 'msg'
    names = [path.stem for path in root.glob('*.msg')]
    assert len(names) >= 8
    assert len({digest(name) for name in names if name != 'RejectReason'}) == len(names) - 1


def test_reject_reasons_have_the_numbers_of_the_core() -> None:
    kind = typestore().types[full_type('RejectReason')]
    assert {reason.name: reason.value for reason in Reason} == {
        name: getattr(kind, name) for name in dir(kind) if name.isupper()
    }


def test_status_has_the_numbers_of_the_core() -> None:
    for name in ('ResistanceEstimate', 'SpeedModelEstimate', 'BrakeRateEstimate'):
        kind = typestore().types[full_type(name)]
        assert {status.name: getattr(kind, status.name) for status in Status} == {s.name: s.value for s in Status}
