# SPDX-License-Identifier: Apache-2.0
"""Charts in characters."""

from __future__ import annotations

import math

from trainid_ros.monitor.screen import ASCII, chart
from trainid_ros.monitor.view import Point


def test_one_line_rises_with_the_values() -> None:
    points = [Point(7.5 - k, float(k), 0.0) for k in range(8)]
    assert chart(points, 8, 1, 8.0).lines == ('▁▂▃▄▅▆▇█',)


def test_times_without_values_are_empty() -> None:
    points = [Point(9.5, 1.0, 0.0), Point(0.5, 2.0, 0.0)]
    (line,) = chart(points, 10, 1, 10.0).lines
    assert (line[0], line[-1]) == ('▁', '█')
    assert line[1:-1] == ' ' * 8


def test_several_lines_show_the_band_around_the_value() -> None:
    points = [Point(0.5, 10.0, 1.0), Point(1.5, 10.0, 0.5)]
    drawn = chart(points, 2, 5, 2.0, ASCII)
    assert drawn.lines == (' :', '::', 'oo', '::', ' :')
    assert (drawn.high, drawn.low) == (12.0, 8.0)


def test_a_band_that_was_wide_does_not_hide_the_present() -> None:
    points = [Point(9.0, 10.0, 1000.0), Point(1.0, 10.1, 0.1), Point(0.5, 10.0, 0.1)]
    drawn = chart(points, 10, 5, 10.0)
    assert drawn.high - drawn.low < 2.0


def test_a_constant_is_drawn() -> None:
    assert set(chart([Point(0.5, 3.0, 0.0), Point(1.5, 3.0, 0.0)], 2, 1, 2.0).lines[0]) == {'▅'}


def test_without_values_nothing_is_drawn() -> None:
    drawn = chart([Point(0.5, math.nan, 0.1)], 4, 3, 2.0)
    assert drawn.lines == ('    ',) * 3
    assert math.isnan(drawn.high)
