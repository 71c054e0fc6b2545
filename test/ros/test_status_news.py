# SPDX-License-Identifier: Apache-2.0
"""Which news of an estimate is latched and logged."""

from __future__ import annotations

from typing import Any

import pytest

from trainid_ros.records import NS_PER_S
from trainid_ros.results import Status
from trainid_ros.ros.status_news import StatusNews, is_latched

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
def test_valid_estimates_and_the_news_that_they_are_not_kept_up_are_latched(
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
    news = StatusNews(log, lambda: 'no ato/speed for 0.8 s')
    day = [CONVERGING, VALID, HOLDING, VALID, STALE, STALE, HOLDING, CONVERGING, FAULT, CONVERGING]
    for second, status in enumerate(day):
        news.see(status, (100 + second) * NS_PER_S)
    assert log.lines == [
        ('info', 'VALID: the estimate is fit to use'),
        ('warning', 'STALE, the last estimate stands: no ato/speed for 0.8 s'),
        ('info', 'HOLDING: inputs are back after 2.0 s'),
        ('warning', 'CONVERGING: the estimate is not fit to use any more'),
        ('info', 'CONVERGING: the estimator works again'),
    ]
    assert news.since_ns == 109 * NS_PER_S
