# SPDX-License-Identifier: Apache-2.0
"""The example that stops a train by the estimates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import stops
from ato.days import CONTROLLERS, DayPlan, Drive, plan_day
from ato.knowledge import TrueValues
from ato.stop_report import Day, actual_rates, brake_changes, comparison, stop_lines, stop_page
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.sim.plant import Plant, StopEvent
from trainid_ros.train.line import LineProfile


def drive(*errors: float) -> Drive:
    arrivals = tuple(StopEvent(100.0 * k, 1000.0 * k, error) for k, error in enumerate(errors, 1))
    begins = tuple(arrival.time_s - 20.0 for arrival in arrivals)
    return Drive(arrivals, begins, 100.0 * len(errors), 12.0, 0.1, 1.0, 0.6, 0.0, 0.5, ())


def plan_with(*events_s: float) -> DayPlan:
    return replace(plan_day('metro', 2, np.random.default_rng(1)), events_s=events_s)


def day(*events_s: float, **drives: Drive) -> Day:
    return Day(plan_with(*events_s), drives)


def test_stops_of_all_days_are_described_by_the_values_used() -> None:
    days = [day(nominal=drive(1.0, -0.2), live=drive(0.1, -0.1)), day(nominal=drive(0.6, -0.2), live=drive(0.1, -0.1))]
    nominal, live = (' '.join(line.split()) for line in stop_lines(days))
    assert nominal == 'train file mean 0.50 m, 95 % within 0.94 m, largest 1.00 m, within 0.30 m 50%'
    assert live == 'live estimates mean 0.10 m, 95 % within 0.10 m, largest 0.10 m, within 0.30 m 100%'


def test_the_comparison_names_what_is_better_and_what_is_not() -> None:
    one = day(nominal=drive(1.0, -0.2), fast=drive(0.0, 0.05), live=drive(0.1, -0.1), truth=drive(0.1, 0.1))
    assert comparison([one]) == [
        'with live estimates the train stops 0.100 m off on average',
        'that is better than with: train file (0.600 m)',
        'that is not better than with: train file, strong feedback (0.025 m); true values (0.100 m)',
    ]


def test_stops_with_a_change_during_the_braking_are_named_and_circled() -> None:
    drives = {'nominal': drive(1.0, -0.2), 'live': drive(0.1, -0.51)}
    lines = brake_changes([day(**drives), day(150.0, **drives), day(190.0, **drives)])
    assert lines[0] == 'day 1: no sudden change'
    assert lines[1].endswith('at 2.5 min, but never in a braking to a stop')
    assert lines[2].endswith('braked to stop 2 with train file (-0.20 m); stop 2 with live estimates (-0.51 m)')
    elsewhere = replace(drives['nominal'], brakings_s=(70.0, 195.0))
    (other,) = brake_changes([day(190.0, **{**drives, 'nominal': elsewhere})])
    assert other.endswith('at 3.2 min, while the train braked to stop 2 with live estimates (-0.51 m)')
    page = stop_page([day(190.0, **drives)])
    assert lines[2].replace('day 3', 'day 1') in page
    assert len(page) > len(stop_page([day(150.0, **drives)]))


@pytest.mark.parametrize('heat', [0.0, 1e6])
def test_the_brake_rate_shown_is_the_true_one_of_a_cold_and_a_hot_brake(heat: float) -> None:
    plan = plan_day('metro', 4, np.random.default_rng(2017))
    true = plan.case.scenario.train_file
    assert {'mass_error', 'brake_fade'} <= {effect.name for effect in true.effects}
    plant = Plant(true, LineProfile(true.line, true.train.length), NS_PER_S, 0.8)
    plant.heat, shown = heat, actual_rates(plan)[int(heat > 0.0)]
    for change, rate in zip(plan.case.scenario.changes, shown, strict=True):
        plant.brake_rate = change.brake_rate or 0.0
        assert rate == pytest.approx(TrueValues(true, plant).values().brake.rate)


@pytest.mark.parametrize(('live', 'worked'), [(0.1, True), (-3.0, False)])
def test_it_worked_if_the_estimates_made_the_stops_better(live: float, worked: bool) -> None:
    case = stops.StopCase((day(nominal=drive(1.0), live=drive(live)),), Path('report.html'))
    assert case.worked is worked


def test_the_brake_changes_at_once_on_all_days_driven() -> None:
    days = stops.changing_days(1, 4)
    assert all(plan.events_s for _, plan in days)
    assert [seed for seed, _ in days] == sorted({seed for seed, _ in days})


def test_short_days_are_driven_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops, '_RUNS', 2)
    monkeypatch.setattr(stops, '_WORLD', 'tram')
    said: list[str] = []
    case = stops.play_stops(tmp_path / 'stops.html', 1, 1, said.append)
    assert len(said) == 1
    (driven,) = case.days
    assert [len(one.errors) for one in driven.drives.values()] == [2] * len(CONTROLLERS)
    page = case.report.read_text(encoding='utf-8')
    assert page.count('<svg') == 2
    assert 'within 0.30 m' in page
    assert all(line in page for line in comparison(case.days))
    assert 'live estimates' in stops.describe_stops(case)
    (told,) = stops.stops_to_json(case)['days']
    assert set(told) == set(CONTROLLERS)
    assert told['live']['errors'] == driven.drives['live'].errors.tolist()
