# SPDX-License-Identifier: Apache-2.0
"""Results match the messages: same numbers, names and sizes."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Reason,
    Rejection,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)

MESSAGES = Path(__file__).parents[2] / 'msg_defs' / 'msg'
ESTIMATES = (ResistanceEstimate, SpeedModelEstimate, BrakeRateEstimate)
# What drivers add to an estimate; see trainid_ros.interface.results.Output.
ADDED = {'header', 'status', 'used', 'rejected', 'last_reject_reason', 'last_reject_text'}
EstimateKind = type[ResistanceEstimate] | type[SpeedModelEstimate] | type[BrakeRateEstimate]


def lines_of(message: str) -> list[str]:
    text = (MESSAGES / f'{message}.msg').read_text(encoding='utf-8')
    stripped = (line.split('#')[0].strip() for line in text.splitlines())
    return [line for line in stripped if line]


def constants(message: str) -> dict[str, int]:
    found = (re.fullmatch(r'uint8 ([A-Z_]+)\s*=\s*(\d+)', line) for line in lines_of(message))
    return {match[1]: int(match[2]) for match in found if match}


def message_fields(message: str) -> dict[str, str]:
    split = (line.split() for line in lines_of(message) if '=' not in line)
    return {name: kind for kind, name in split}


def test_reasons_have_the_numbers_of_the_message() -> None:
    assert constants('RejectReason') == {reason.name: reason.value for reason in Reason}


@pytest.mark.parametrize('kind', ESTIMATES)
def test_statuses_have_the_numbers_of_the_message(kind: EstimateKind) -> None:
    assert constants(kind.__name__) == {status.name: status.value for status in Status}


@pytest.mark.parametrize('kind', ESTIMATES)
def test_estimates_have_the_fields_of_the_message(kind: EstimateKind) -> None:
    assert {item.name for item in fields(kind)} == set(message_fields(kind.__name__)) - ADDED
    assert set(message_fields(kind.__name__)) >= ADDED


@pytest.mark.parametrize(('kind', 'size'), [(ResistanceEstimate, 9), (SpeedModelEstimate, 16)])
def test_covariances_have_an_array_of_their_size(kind: EstimateKind, size: int) -> None:
    assert message_fields(kind.__name__)['covariance'] == f'float64[{size}]'


def test_numbers_fit_into_a_byte_of_the_message() -> None:
    assert max(Reason) < 256
    assert max(Status) < 256


def test_a_rejection_reads_as_reason_value_and_limit() -> None:
    assert str(Rejection(1, Reason.OUTLIER, 1.25, 0.5)) == 'OUTLIER (value 1.25, limit 0.5)'
