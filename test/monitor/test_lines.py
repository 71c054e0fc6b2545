# SPDX-License-Identifier: Apache-2.0
"""Lines for terminals that cannot draw."""

from __future__ import annotations

from collections.abc import Callable

from test.monitor.conftest import START_NS
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.monitor.screen import Lines
from trainid_ros.monitor.trains import Report, Trains
from trainid_ros.monitor.view import Level

NOW = (9.9, START_NS + round(9.9 * NS_PER_S))


def test_a_line_has_time_estimates_and_inputs(driven: Callable[..., Trains]) -> None:
    (line,) = Lines().of(driven('/a').views(*NOW), '')
    for wanted in (
        '22:13:29 UTC /a  68.5 km/h',
        'resistance 2.006 ± 0.283 N/kN VALID ≥ 9 s',
        'brake rate 0.910 ± 0.050 VALID ≥ 9 s',
        'ato/force 5.0 Hz 0.1 s',
    ):
        assert wanted in line
    assert 'ato/mass' not in line


def test_findings_are_printed_when_they_come_and_go(driven: Callable[..., Trains]) -> None:
    trains, lines = driven(), Lines()
    trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.STALE, 'no message', {}, 9.8))
    printed = [lines.of(trains.views(*NOW), '')[1:] for _ in range(2)]
    trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.OK, '5.0 Hz', {}, 9.85))
    printed.append(lines.of(trains.views(*NOW), '')[1:])
    assert printed == [['/ STALE ato/force: no message'], [], ['/ STALE ato/force cleared']]


def test_the_notice_is_printed_once() -> None:
    lines = Lines()
    assert [lines.of((), 'nothing yet') for _ in range(2)] == [['nothing yet'], []]


def test_a_finding_that_says_something_else_is_printed_but_not_one_with_other_numbers(
    driven: Callable[..., Trains],
) -> None:
    trains, lines, printed = driven(), Lines(), []
    for text in ('error 0.1, since 3 s', 'error -2e-05, since 4 s', 'the brake acts 2.5 s later'):
        trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.WARN, text, {}, 9.8))
        printed.append([line for line in lines.of(trains.views(*NOW), '')[1:] if 'cleared' not in line])
    assert [len(found) for found in printed] == [1, 0, 1]
    assert printed[2][0].endswith('the brake acts 2.5 s later')


def test_a_message_of_several_lines_is_one_line(driven: Callable[..., Trains]) -> None:
    trains = driven()
    trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.WARN, 'two\nlines', {}, 9.8))
    assert Lines().of(trains.views(*NOW), '')[1:] == ['/ WARN ato/force: two lines']


def test_the_findings_of_a_train_that_is_no_longer_shown_are_not_called_cleared(driven: Callable[..., Trains]) -> None:
    trains, lines = driven('/a', '/b'), Lines()
    trains.on_diagnostics('b/resistance_estimator: input ato/force', Report(Level.STALE, 'no message', {}, 9.8))
    lines.of(trains.views(*NOW), '')
    del trains.by_namespace['/b']
    assert len(lines.of(trains.views(*NOW), '')) == 1
