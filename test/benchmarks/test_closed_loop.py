# SPDX-License-Identifier: Apache-2.0
"""What the closed loop counts, on outcomes made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ato.days import CONTROLLERS, Bound, DayPlan, Drive, plan_day
from benchmarks.closed_loop import Outcome, _bounds, _rides, _stops, outcome_of
from benchmarks.tables import Table
from trainid_ros.sim.plant import StopEvent

WORLDS = ('metro', 'emu', 'tram')


def plan_with(*events_s: float) -> DayPlan:
    return replace(plan_day('metro', 2, np.random.default_rng(1)), events_s=events_s)


def drive_of(errors: Sequence[float], bounds: Sequence[Bound] = ()) -> Drive:
    """A drive with a stop every 100 s, each with 20 s of braking."""
    arrivals = tuple(StopEvent(100.0 * k, 1000.0 * k, error) for k, error in enumerate(errors, 1))
    begins = tuple(arrival.time_s - 20.0 for arrival in arrivals)
    return Drive(arrivals, begins, arrivals[-1].time_s, 12.0, 0.1, 2.5, 0.6, 0.1, 0.5, tuple(bounds))


def bound(time_s: float, *, holds: bool = True, live: bool = True) -> Bound:
    return Bound(time_s, 220.0, 200.0 if holds else 230.0, live)


def tables(**outcomes: Outcome) -> dict[tuple[str, str], list[Outcome]]:
    """Outcomes of all lines and controllers: the given ones on the metro, else good stops but with the train file."""
    rows = tuple(bound(100.0 * k - 20.0) for k in range(1, 4))
    other = outcome_of(plan_with(), drive_of((0.1, -0.1, 0.1), rows))
    bad = outcome_of(plan_with(), drive_of((1.0, 1.0, 1.0)))
    chosen = {(world, name): [bad if name == 'nominal' else other] for world in WORLDS for name in CONTROLLERS}
    return chosen | {('metro', name): [outcome] for name, outcome in outcomes.items()}


def cell(table: Table, column: str, *keys: str) -> str:
    (row,) = (row for row in table.rows if row[: len(keys)] == keys)
    return str(row[table.header.index(column)])


def test_the_first_three_errors_after_each_change_are_counted() -> None:
    drive = drive_of((0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    assert outcome_of(plan_with(150.0), drive).after == (0.2, 0.3, 0.4)
    # The train stops while it happens: this stop is not after it.
    assert outcome_of(plan_with(200.0), drive).after == (0.3, 0.4, 0.5)
    assert outcome_of(plan_with(150.0, 450.0), drive).after == (0.2, 0.3, 0.4, 0.5, 0.6)
    assert outcome_of(plan_with(), drive).after == ()


def test_a_brake_that_changed_since_the_last_stop_is_unknown() -> None:
    drive = drive_of((0.1, 0.1, 0.1), [bound(80.0), bound(180.0), bound(280.0)])
    assert outcome_of(plan_with(50.0), drive).unknown == (True, False, False)
    assert outcome_of(plan_with(150.0), drive).unknown == (False, True, False)
    # It changes while the train brakes to the second stop, which shows it to the third bound.
    assert outcome_of(plan_with(190.0), drive).unknown == (False, False, False)


def test_a_change_during_a_braking_is_a_surprise() -> None:
    drive = drive_of((0.1, 0.1, 0.1))
    assert outcome_of(plan_with(150.0, 290.0), drive).surprised == (False, False, True)


def test_shares_of_the_stops() -> None:
    plan = plan_with(190.0)
    table = _stops(
        tables(
            nominal=outcome_of(plan, drive_of((1.0, 1.0, 1.0, 1.0))),
            live=outcome_of(plan, drive_of((0.2, -0.6, 0.2, 0.4))),
            truth=outcome_of(plan, drive_of((0.0, 0.0, 0.0, 0.0))),
        )
    )
    live = {column: cell(table, column, 'metro', 'live') for column in table.header}
    assert (live['stops'], live['mean, m'], live['within .30 m']) == ('4', '+0.050', '50.0%')
    # The second stop, during whose braking the brake changed, is left out.
    assert live['brake steady'] == '66.7% of 3'
    # The 95 % quantile of the sizes is 0.57 m, of 1 m with the train file and 0 with the truth.
    assert (live['p95, m'], live['gap closed']) == ('0.570', '43%')
    assert live['after a change, m'] == '0.400'
    assert cell(table, 'after a change, m', 'tram', 'rate_fast') == '-'
    assert len(table.rows) == len(WORLDS) * len(CONTROLLERS)


def test_rides_are_compared_with_those_by_the_truth() -> None:
    drive = replace(drive_of((0.1,)), energy_kwh=18.0, jerk=0.2, jerk_p999=3.25, final_deceleration=0.65, overspeed=0.4)
    table = _rides(tables(live=outcome_of(plan_with(), drive)))
    live = {column: cell(table, column, 'metro', 'live') for column in table.header}
    assert (live['energy'], live['time'], live['rms jerk']) == ('+50.0%', '-66.7%', '+100.0%')
    assert (live['jerk 99.9 %, m/s^3'], live['final braking, m/s^2']) == ('3.25', '0.65')
    assert live['overspeed, m/s'] == '0.40'


@pytest.mark.parametrize('event_s', [150.0, 185.0])
def test_shares_of_the_bounds(event_s: float) -> None:
    rows = [bound(80.0, live=False), bound(180.0, holds=False), bound(280.0), bound(380.0)]
    table = _bounds(tables(live=outcome_of(plan_with(event_s), drive_of((0.1, 0.1, 0.1, 0.1), rows))))
    row = {column: cell(table, column, 'metro') for column in table.header}
    assert row['stopped within the 95 % bound'] == '75.0% of 4'
    assert (row['live'], row['train file']) == ('66.7% of 3', '100.0% of 1')
    known = (row['live, known brake'], row['live, changed brake'])
    assert known == (('100.0% of 2', '0.0% of 1') if event_s < 180.0 else ('66.7% of 3', '-'))
    assert row['median margin'] == '+10.0%'
