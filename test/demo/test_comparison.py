# SPDX-License-Identifier: Apache-2.0
"""Live against replay: every kind of difference is reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainid_ros.bag.types import estimate_message
from trainid_ros.demo.comparison import (
    Fingerprint,
    compare,
    describe_comparison,
    fingerprint_of_message,
    fingerprint_of_output,
)
from trainid_ros.interface.results import BrakeRateEstimate, Output, Reason, Rejection, ResistanceEstimate, Status

ESTIMATE = ResistanceEstimate(
    a=1.6, b=0.02, c=0.001, covariance=(0.04, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-8), resistance=1.9,
    resistance_std=0.2, speed=10.0, innovation=0.1, innovation_variance=0.04, test_ratio=0.02, speed_min=2.0,
    speed_max=20.0, resistance_std_max=0.3,
)  # fmt: skip
NAMES = tuple(ESTIMATE.__dataclass_fields__)
REJECTION = Rejection(7, Reason.OUTLIER, 1.0, 0.5)
OUTPUT = Output(1_700_000_000_200_000_000, ESTIMATE, Status.VALID, 10, 3, REJECTION)


def prints(*stamps: int, estimate: bytes = b'e', status: Status = Status.VALID) -> list[Fingerprint]:
    return [Fingerprint(stamp, estimate, b'h', int(status)) for stamp in stamps]


@pytest.mark.parametrize('output', [OUTPUT, Output(OUTPUT.stamp_ns, ESTIMATE, Status.VALID, 10, 3, None)])
def test_message_of_an_output_has_its_fingerprint(output: Any) -> None:
    message = estimate_message(output)
    assert fingerprint_of_message(message, output.stamp_ns, NAMES) == fingerprint_of_output(output)


def test_nan_equals_nan_and_bool_is_kept() -> None:
    estimate = BrakeRateEstimate(1.0, 0.1, float('nan'), 3.0, -0.1, -0.2, 50.0, True, 0.0, 1.0, 0.0)
    output = Output(5, estimate, Status.VALID, 1, 0, None)
    message = estimate_message(output)
    names = tuple(estimate.__dataclass_fields__)
    assert fingerprint_of_message(message, 5, names) == fingerprint_of_output(output)


@pytest.mark.parametrize(
    ('change', 'differs'),
    [
        ({'a': np.nextafter(1.6, 2.0)}, 'estimate'),
        ({'covariance': np.array(ESTIMATE.covariance) * (1.0 + 1e-15)}, 'estimate'),
        ({'status': 3}, 'health'),
        ({'used': 11}, 'health'),
        ({'last_reject_text': 'other'}, 'health'),
    ],
)
def test_the_last_bit_counts(change: dict[str, Any], differs: str) -> None:
    message = estimate_message(OUTPUT)
    names = (*NAMES, 'status', 'used', 'rejected', 'last_reject_reason', 'last_reject_text')
    values = {name: getattr(message, name) for name in names} | change
    found = fingerprint_of_message(SimpleNamespace(**values), OUTPUT.stamp_ns, NAMES)
    expected = fingerprint_of_output(OUTPUT)
    assert (found.estimate == expected.estimate) == (differs != 'estimate')
    assert (found.health == expected.health) == (differs != 'health')


def test_same_messages_are_exact() -> None:
    result = compare(prints(1, 2, 3), prints(1, 2, 3))
    assert result.exact
    assert (result.equal, result.equal_health, result.missing, result.extra) == (3, 3, 0, 0)
    assert 'to the bit: all 3 messages' in describe_comparison('w', result)


def test_missing_and_different_messages_are_not_exact() -> None:
    result = compare([*prints(1), *prints(3, estimate=b'x')], prints(1, 2, 3))
    assert not result.exact
    assert (result.equal, result.missing, result.extra) == (1, 1, 0)
    text = describe_comparison('w', result)
    assert '1 of 3' in text
    assert '1 were missed' in text


def test_stale_message_by_the_clock_is_not_a_difference() -> None:
    result = compare([*prints(1, 2), *prints(2, status=Status.STALE)], prints(1, 2))
    assert result.exact
    assert result.reported_stale == 1


def test_unexpected_message_is_a_difference() -> None:
    result = compare(prints(1, 2), prints(1))
    assert not result.exact
    assert result.extra == 1


def test_messages_with_one_stamp_are_compared_in_their_order() -> None:
    expected = [*prints(1, estimate=b'first'), *prints(1, estimate=b'second')]
    assert compare(expected, expected).exact
    assert compare(reversed(expected), expected).equal == 0


def test_different_counters_are_reported_but_leave_the_estimates_exact() -> None:
    live = [Fingerprint(1, b'e', b'other', int(Status.VALID))]
    result = compare(live, prints(1))
    assert result.exact
    assert '1 differ in status or counters' in describe_comparison('w', result)
