# SPDX-License-Identifier: Apache-2.0
"""Which changes of the status are latched and logged, and when inputs count as missing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status
from trainid_ros.ros.estimator_node import StatusChanges, Watchdog, is_latched

CONVERGING, VALID, HOLDING, STALE, FAULT = list(Status)[1:]


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
    sent: list[Status] = []
    for status in statuses:
        if is_latched(status, sent[-1] if sent else None):
            sent.append(status)
    assert sent == expected


class Log:
    """Collects log lines with their level, as the context of a node whose inputs are missing."""

    def __init__(self, missing: str) -> None:
        self.lines: list[tuple[str, str]] = []
        self.since_ns = 0
        self.node = SimpleNamespace(get_logger=lambda: self)
        self.missing_inputs = lambda: missing

    def __getattr__(self, level: str) -> Any:
        return lambda text, **_: self.lines.append((level, text))


def test_each_change_that_matters_is_logged_once_with_its_duration() -> None:
    log: Any = Log('no ato/speed for 0.8 s')
    changes = StatusChanges(log)
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
    assert log.since_ns == 109 * NS_PER_S


def test_inputs_that_come_for_the_first_time_are_not_back() -> None:
    log: Any = Log('no ato/speed')
    changes = StatusChanges(log)
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
    log: Any = Log('no ato/speed')
    changes = StatusChanges(log)
    for second, status in enumerate([CONVERGING, STALE]):
        changes.follow(status, (100 + second) * NS_PER_S)
    if not back_ns:  # it has passed the time of the last change again
        log.since_ns = 0
    changes.follow(CONVERGING, 110 * NS_PER_S - back_ns)
    assert log.lines[-1] == ('info', 'CONVERGING: inputs are back')


LIMIT = 8 * NS_PER_S // 10


def at(seconds: float) -> int:
    return round(seconds * NS_PER_S)


@pytest.mark.parametrize(
    'steps',
    [
        # The same stamp again is not new input.
        [(1, 10, 10, None), (0, 10.7, 10.7, False), (0, 10.9, 10.9, True), (1, 10.95, 10.95, None), (0, 12, 12, True)],
        [(1, 10, 10, None), (2, 12, 12, None), (0, 12.1, 12.1, False)],
        # Input that never came is missing from the first check on.
        [(0, 100, 100, False), (0, 100.7, 100.7, False), (0, 100.9, 100.9, True)],
        # 20 times real time, with 0.1 s of stall; then a longer one.
        [(1, 10, 10, None), (0, 12, 10.1, False), (0, 16, 10.3, True)],
        # A slow replay, while its clock moves.
        [(1, 10, 10, None), *((0, 10 + 0.01 * tenth, 10 + 0.1 * tenth, False) for tenth in range(1, 20))],
        # A clock that has stopped, or never started.
        [(1, 10, 10, None), (0, 10, 10.5, False), (0, 10, 11.4, True)],
        [(1, 0, 10, None), (0, 0, 10.9, True)],
    ],
)
def test_input_is_missing_after_the_limit(steps: list[tuple[int, float, float, bool | None]]) -> None:
    """Each step is a stamp that arrives, or a check with what it finds, at a time of both clocks."""
    watchdog = Watchdog(LIMIT)
    for stamp, now_s, steady_s, missing in steps:
        if missing is None:
            watchdog.saw(stamp, at(now_s), at(steady_s))
        else:
            assert watchdog.is_missing(at(now_s), at(steady_s)) == missing


def test_after_a_restart_the_old_stamp_counts_as_new() -> None:
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(101), at(101))
    watchdog.restart()
    assert not watchdog.is_missing(at(200), at(200))
    watchdog.saw(1, at(200), at(200))
    assert watchdog.is_missing(at(201), at(201))


def test_the_next_check_is_due_when_the_limit_can_be_exceeded_and_not_before() -> None:
    watchdog = Watchdog(LIMIT)
    assert LIMIT < watchdog.pause_ns(at(5), simulated=False) < LIMIT + at(0.1)
    watchdog.saw(1, at(10), at(10))
    pause = watchdog.pause_ns(at(10.3), simulated=False)
    assert not watchdog.is_missing(at(10.3) + pause - at(0.02), at(10.3) + pause - at(0.02))
    assert watchdog.is_missing(at(10.3) + pause, at(10.3) + pause)
    # Once it is missing there is no hurry.
    assert watchdog.pause_ns(at(50), simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    # Simulated time may run fast, so it is polled often.
    assert watchdog.pause_ns(at(10.3), simulated=True) == at(0.1)


def test_a_longer_limit_applies_from_the_next_check_on() -> None:
    """The rate of slow topics is learned while the node runs."""
    watchdog = Watchdog(LIMIT)
    watchdog.saw(1, at(10), at(10))
    watchdog.limit_ns = 3 * LIMIT
    assert not watchdog.is_missing(at(10) + 2 * LIMIT, at(10) + 2 * LIMIT)
    assert watchdog.pause_ns(at(10) + 2 * LIMIT, simulated=False) == pytest.approx(LIMIT, abs=at(0.1))
    assert watchdog.is_missing(at(10.1) + 3 * LIMIT, at(10.1) + 3 * LIMIT)
