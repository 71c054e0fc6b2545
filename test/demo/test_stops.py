# SPDX-License-Identifier: Apache-2.0
"""The chapter of the demo that stops a train by the estimates."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.ato.days import Drive
from trainid_ros.demo import stops
from trainid_ros.report.stop_report import stop_lines
from trainid_ros.sim.driver import StopEvent


def drive(*errors: float) -> Drive:
    arrivals = tuple(StopEvent(100.0 * k, 1000.0 * k, error) for k, error in enumerate(errors, 1))
    begins = tuple(arrival.time_s - 20.0 for arrival in arrivals)
    return Drive(arrivals, begins, 100.0 * len(errors), 12.0, 0.1, 1.0, 0.0, 0.5, ())


def test_stops_are_described_by_the_values_used() -> None:
    lines = stop_lines({'nominal': drive(1.0, -0.2), 'live': drive(0.1, -0.1)})
    nominal, live = (' '.join(line.split()) for line in lines)
    assert nominal == 'nominal mean +0.40 m, sd 0.60 m, largest 1.00 m, within 0.30 m 50%'
    assert live == 'live mean +0.00 m, sd 0.10 m, largest 0.10 m, within 0.30 m 100%'


@pytest.mark.parametrize(('live', 'worked'), [(0.1, True), (-3.0, False)])
def test_it_worked_if_the_estimates_made_the_stops_better(live: float, worked: bool) -> None:
    case = stops.StopCase({'nominal': drive(1.0), 'live': drive(live)}, Path('report.html'))
    assert case.worked is worked


def test_a_short_day_is_driven_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops, '_RUNS', 2)
    monkeypatch.setattr(stops, '_WORLD', 'tram')
    said: list[str] = []
    case = stops.play_stops(tmp_path / 'stops', said.append)
    assert len(said) == 1
    assert [len(one.errors) for one in case.drives.values()] == [2] * 6
    page = case.report.read_text(encoding='utf-8')
    assert page.count('<svg') == 2
    assert 'within 0.30 m' in page
    assert stops.stops_to_json(case)['errors']['live'] == case.drives['live'].errors.tolist()
