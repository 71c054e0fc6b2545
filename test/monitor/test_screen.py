# SPDX-License-Identifier: Apache-2.0
"""The screen of a terminal, that of the documents, lines for terminals that cannot draw, and charts in characters."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import TextIO

import pytest
from rich.console import Console

from test.monitor.conftest import START_NS, feed
from tools.documents import DOCS, ROOT
from tools.monitor_picture import pictures
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Status
from trainid_ros.monitor.screen import ASCII, Lines, Screen, chart
from trainid_ros.monitor.trains import Level, Point, Report, Trains

Driven = Callable[..., Trains]
LONG = 'no message for 3.0 s, no publisher, since 2023-11-14 22:13:27 UTC: start the node that publishes it'


def drawn(trains: Trains, width: int, height: int, now_s: float = 9.9, file: TextIO | None = None) -> list[str]:
    console = Console(file=file or io.StringIO(), width=width, height=height)
    views = trains.views(now_s, START_NS + round(now_s * NS_PER_S))
    with console.capture() as capture:
        console.print(Screen(views, 'Nothing is published yet.'))
    return capture.get().splitlines()


def faulty(trains: Trains) -> Trains:
    trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.STALE, LONG, {}, 9.8))
    return trains


@pytest.mark.parametrize(('width', 'height'), [(40, 20), (60, 24), (80, 24), (100, 30), (120, 50), (200, 60)])
def test_everything_fits_in_the_terminal(driven: Driven, width: int, height: int) -> None:
    lines = drawn(faulty(driven()), width, height)
    assert len(lines) < height  # the cursor is in the last line
    assert max(map(len, lines)) <= width
    text = '\n'.join(lines)
    for wanted in ('ato/brake_command', '5.0 Hz', '0.15 s', '2.006 ± 0.283', 'brake rate', 'STALE ato/force'):
        assert wanted in text


def test_values_bands_status_rejections_and_findings_are_shown(driven: Driven) -> None:
    text = '\n'.join(drawn(faulty(driven()), 100, 50))
    for wanted in (
        '68.5 km/h', '3 of 3 estimates', '50.0 kN', '2.006 ± 0.283 N/kN', 'VALID ≥ 9 s', 'w at 45 km/h',
        '0.910 ± 0.050', 'used 12, rejected 8: standstill 5, braking 3', 'b 0.0200 ± 0.0100', 'seen 18 to 72 km/h',
        'braking now', '●', '░',
    ):  # fmt: skip
        assert wanted in text
    assert LONG in ' '.join(text.split())


@pytest.mark.parametrize(('width', 'height'), [(30, 8), (40, 20), (50, 12), (60, 24)])
def test_the_status_is_not_cut_on_a_small_terminal(driven: Driven, width: int, height: int) -> None:
    trains = driven()
    feed(trains.by_namespace['/'], 10.0, 20.0, Status.STALE)
    text = '\n'.join(drawn(trains, width, height, now_s=19.9))
    assert text.count('STALE 9 s') == 3
    assert 'braking now' not in text
    assert 'seen only while braking' in '\n'.join(drawn(trains, 100, 50, now_s=19.9))


@pytest.mark.parametrize(('width', 'height'), [(80, 24), (80, 18), (60, 15), (30, 8)])
def test_the_worst_finding_and_how_many_more_are_on_every_screen(driven: Driven, width: int, height: int) -> None:
    trains = driven()
    values = {'rate [Hz]': '5.0', 'age [s]': '0.05', 'time since last message [s]': '0.1', 'count': '9'}
    for k in range(7):  # of a mapping
        report = Report(Level.WARN, f'{k} {LONG}', values, 9.8)
        trains.on_diagnostics(f'resistance_estimator: input /topic{k}', report)
    trains.on_diagnostics('brake_rate_estimator: estimator', Report(Level.ERROR, 'BRAKE ON FIRE', {}, 9.8))
    lines = drawn(trains, width, height)
    assert len(lines) < height
    text = '\n'.join(lines)
    assert text.count('VALID') == 3
    assert 'ERROR brake_rate_estimator' in text
    assert 'more' in lines[-1]


def test_many_trains_are_cut_with_the_worst_first(driven: Driven) -> None:
    trains = driven(*(f'/t{k:02d}' for k in range(30)))
    for k in range(30):
        level = Level.ERROR if k == 29 else Level.WARN
        trains.on_diagnostics(f't{k:02d}/brake_rate_estimator: estimator', Report(level, LONG, {}, 9.8))
    for height in (24, 8):
        lines = drawn(trains, 80, height)
        assert len(lines) < height
        assert lines[2].startswith('/t29 ')
        assert sum(line.startswith('… and ') for line in lines) == 2
        assert any(line.startswith('/t29 ERROR brake_rate_estimator') for line in lines)


@pytest.mark.parametrize('width', [30, 40, 80])
def test_the_overview_shows_names_and_each_status(driven: Driven, width: int) -> None:
    trains = driven('/a', '/depot/north/train_12')
    feed(trains.by_namespace['/a'], 10.0, 10.2, Status.STALE)
    feed(trains.by_namespace['/depot/north/train_12'], 10.0, 10.2, Status.STALE)
    lines = drawn(trains, width, 24, 10.1)[2:4]
    assert all(line.count('ST') == 3 for line in lines)
    assert lines[1].startswith('/depot/north')


def test_a_node_that_is_not_active_or_ended_is_shown(driven: Driven) -> None:
    trains = driven()
    text = '\n'.join(drawn(trains, 80, 24, now_s=9.8 + 1.6))
    assert all(wanted in text for wanted in ('SILENT 1.6 s', '0 of 3 estimates', 'none for 1 s'))
    report = Report(Level.WARN, 'inactive, inputs are ignored: activate it', {'state': 'inactive'}, 12.0)
    trains.on_diagnostics('resistance_estimator: estimator', report)
    assert 'resistance   INACTIVE 2.3 s' in '\n'.join(drawn(trains, 80, 24, 12.1))


def test_without_diagnostics_nothing_is_said_to_be_in_order(driven: Driven) -> None:
    assert 'diagnostics: nothing to report' in '\n'.join(drawn(driven(), 80, 24))
    trains = Trains()
    feed(trains.add('/'), 0.0, 10.0)
    assert 'diagnostics: none have arrived' in '\n'.join(drawn(trains, 80, 24))


def test_columns_of_a_chart_are_filled_at_one_estimate_a_second() -> None:
    trains = Trains()
    for k in range(30):
        feed(trains.add('/'), k, k + 0.2)
    (line,) = [line for line in drawn(trains, 80, 24, 29.1) if line.endswith(' 1.081')]
    assert len(line.split()) == 2


def test_terminals_without_unicode_get_ascii(driven: Driven) -> None:
    plain = io.TextIOWrapper(io.BytesIO(), encoding='ascii')
    several = driven('/train_1', '/depot/north/train_2')
    cases = [(driven(), 40, 24), (driven(), 90, 50), (driven('/a', '/b'), 120, 24)]
    for trains, width, height in cases:
        assert '2.006' in '\n'.join(drawn(faulty(trains), width, height, file=plain))
    cases += [(trains, width, 24) for trains in (driven(), several) for width in (1, 5, 10, 20, 40)]
    for trains, width, height in cases:
        text = '\n'.join(drawn(trains, width, height, file=plain))
        assert text.isascii(), {char for char in text if not char.isascii()}
    assert '0.910 +- 0.050' in '\n'.join(drawn(driven(), 90, 50, file=plain))


def test_what_is_missing_is_said() -> None:
    assert drawn(Trains(), 80, 24) == ['Nothing is published yet.']
    trains = Trains()
    trains.add('/')
    text = '\n'.join(drawn(trains, 80, 24))
    assert text.count('no node') == 3
    assert text.count('never') == 4  # the mass is optional


def test_several_trains_have_a_line_each(driven: Driven) -> None:
    trains = driven('/a', '/b')
    trains.on_diagnostics('b/brake_rate_estimator: input ato/force', Report(Level.STALE, LONG, {}, 9.8))
    head, _, first, second, finding = drawn(trains, 160, 24)
    assert '2 trains' in head
    assert '--namespace' in head
    assert first.startswith('/b ')  # the worst first
    assert second.startswith('/a ')
    assert second.count('VALID') == 3
    assert second.count('2.006 ± 0.283') == 1
    for width in (60, 80):
        lines = drawn(driven('/depot/train_12', '/line'), width, 24)[2:4]
        assert [line.split()[0] for line in lines] == ['/depot/train_12', '/line']
        assert all('68.5 km/h' in line for line in lines)
    assert finding.startswith('/b STALE ato/force: no message')


def test_control_characters_of_others_do_not_reach_the_terminal(driven: Driven) -> None:
    trains = driven()
    bad = Report(Level.ERROR, 'red \x1b[31m and bell \x07', {}, 9.8)
    trains.on_diagnostics('resistance_estimator: input ato/force', bad)
    assert r'red \x1b[31m and bell \x07' in '\n'.join(drawn(trains, 100, 50))
    trains.on_diagnostics('resistance_estimator: input ato/force', Report(Level.WARN, 'two\nlines', {}, 9.8))
    assert Lines().of(trains.views(*NOW), '')[1:] == ['/ WARN ato/force: two lines']


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e308, -1e308, -1.0, 1e-300])
@pytest.mark.parametrize(('width', 'height'), [(40, 10), (80, 24), (120, 50)])
def test_messages_with_any_numbers_are_shown(driven: Driven, value: float, width: int, height: int) -> None:
    trains = driven()
    feed(trains.by_namespace['/'], 10.0, 14.0, replaced=value)
    lines = drawn(trains, width, height, 14.0)
    assert max(map(len, lines)) <= width
    assert 'VALID' in '\n'.join(lines)
    assert Lines().of(trains.views(14.0, START_NS), '')


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


def test_the_findings_of_a_train_that_is_no_longer_shown_are_not_called_cleared(driven: Callable[..., Trains]) -> None:
    trains, lines = driven('/a', '/b'), Lines()
    trains.on_diagnostics('b/resistance_estimator: input ato/force', Report(Level.STALE, 'no message', {}, 9.8))
    lines.of(trains.views(*NOW), '')
    del trains.by_namespace['/b']
    assert len(lines.of(trains.views(*NOW), '')) == 1


def test_a_single_line_shows_the_values_alone() -> None:
    points = [Point(7.5 - k, float(k), 0.0) for k in range(8)]
    assert chart(points, 8, 1, 8.0).lines == ('▁▂▃▄▅▆▇█',)
    points = [Point(9.5, 1.0, 0.0), Point(0.5, 2.0, 0.0)]
    assert chart(points, 10, 1, 10.0).lines == (f'▁{" " * 8}█',)  # times without values are empty
    assert set(chart([Point(0.5, 3.0, 0.0), Point(1.5, 3.0, 0.0)], 2, 1, 2.0).lines[0]) == {'▅'}
    nothing = chart([Point(0.5, math.nan, 0.1)], 4, 3, 2.0)
    assert nothing.lines == ('    ',) * 3
    assert math.isnan(nothing.high)


def test_several_lines_show_the_band_around_the_value() -> None:
    points = [Point(0.5, 10.0, 1.0), Point(1.5, 10.0, 0.5)]
    drawn = chart(points, 2, 5, 2.0, ASCII)
    assert drawn.lines == (' :', '::', 'oo', '::', ' :')
    assert (drawn.high, drawn.low) == (12.0, 8.0)
    # A band that was wide does not hide the present.
    points = [Point(9.0, 10.0, 1000.0), Point(1.0, 10.1, 0.1), Point(0.5, 10.0, 0.1)]
    drawn = chart(points, 10, 5, 10.0)
    assert drawn.high - drawn.low < 2.0


def test_the_pictures_of_the_documents_are_up_to_date() -> None:
    for name, drawn in pictures().items():
        assert drawn == (ROOT / DOCS / name).read_text(encoding='utf-8'), f'{name}: make golden draws it anew'
        assert 'http' not in drawn.replace('http://www.w3.org', '').replace('https://www.textualize.io', '')
