# SPDX-License-Identifier: Apache-2.0
"""Which changes of the status of an estimate are latched and logged."""

from __future__ import annotations

from typing import Any

import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status
from trainid_ros.ros.estimate_publisher import StatusChanges, is_latched

CONVERGING, VALID, HOLDING, STALE, FAULT = list(Status)[1:]


def latched(statuses: list[Status]) -> list[Status]:
    """Return which of these estimates go to the latched topic."""
    sent: list[Status] = []
    for status in statuses:
        if is_latched(status, sent[-1] if sent else None):
            sent.append(status)
    return sent


@pytest.mark.parametrize(
    ('statuses', 'expected'),
    [
        ([Status.UNINITIALIZED, CONVERGING, STALE, FAULT, HOLDING], []),
        ([CONVERGING, VALID, VALID, HOLDING, HOLDING, VALID], [VALID, VALID, VALID]),
        ([VALID, STALE, STALE, STALE, CONVERGING, VALID], [VALID, STALE, CONVERGING, VALID]),
        ([VALID, STALE, HOLDING, HOLDING], [VALID, STALE, HOLDING]),
        ([VALID, HOLDING, FAULT, FAULT, CONVERGING], [VALID, FAULT, CONVERGING]),
        ([VALID, HOLDING, CONVERGING, CONVERGING, HOLDING], [VALID, CONVERGING, HOLDING]),
        ([VALID, STALE, FAULT, STALE], [VALID, STALE, FAULT, STALE]),
    ],
)
def test_valid_estimates_and_the_first_that_does_not_keep_them_up_are_latched(
    statuses: list[Status], expected: list[Status]
) -> None:
    assert latched(statuses) == expected


class Log:
    """Collects log lines with their level."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def __getattr__(self, level: str) -> Any:
        return lambda text, **_: self.lines.append((level, text))


def test_each_change_that_matters_is_logged_once_with_its_duration() -> None:
    log = Log()
    changes = StatusChanges(log, lambda: 'no ato/speed for 0.8 s')
    day = [CONVERGING, VALID, HOLDING, VALID, STALE, STALE, HOLDING, CONVERGING, FAULT, CONVERGING]
    for second, status in enumerate(day):
        changes.follow(status, (100 + second) * NS_PER_S)
    assert log.lines == [
        ('info', 'VALID: the estimate is fit to use'),
        ('warning', 'STALE, the last estimate stands: no ato/speed for 0.8 s'),
        ('info', 'HOLDING: inputs are back, 2.0 s after STALE'),
        ('warning', 'CONVERGING: the estimate is not fit to use any more'),
        ('info', 'CONVERGING: the estimator works again'),
    ]
    assert changes.since_ns == 109 * NS_PER_S


def test_inputs_that_come_for_the_first_time_are_not_back() -> None:
    log = Log()
    changes = StatusChanges(log, lambda: 'no ato/speed')
    changes.follow(STALE, 0)  # /clock has not started
    start_ns = 1_700_000_000 * NS_PER_S
    for second, status in enumerate([CONVERGING, STALE, CONVERGING]):
        changes.follow(status, start_ns + second * NS_PER_S)
    assert [text for level, text in log.lines if level == 'info'] == [
        'CONVERGING: inputs have come',
        'CONVERGING: inputs are back, 1.0 s after STALE',
    ]


@pytest.mark.parametrize('back_ns', [50 * NS_PER_S, 0])
def test_after_a_jump_of_the_clock_nothing_is_said_of_how_long_inputs_were_missing(back_ns: int) -> None:
    log = Log()
    changes = StatusChanges(log, lambda: 'no ato/speed')
    for second, status in enumerate([CONVERGING, STALE]):
        changes.follow(status, (100 + second) * NS_PER_S)
    if not back_ns:  # it has passed the time of the last change again
        changes.forget_time()
    changes.follow(CONVERGING, 110 * NS_PER_S - back_ns)
    assert log.lines[-1] == ('info', 'CONVERGING: inputs are back')
