# SPDX-License-Identifier: Apache-2.0
"""Fleets in which some trains break, in which all get wet, and in which one always differed."""

from __future__ import annotations

import numpy as np
import pytest

from test.fleet.surrogate import fleet_rows
from trainid_ros.fleet.analysis import analyse
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.report.fleet_report import summary

LIMIT = 20_000.0
DRAG, PADS = np.array([0.8, 0.0, 0.0, 0.0]), np.array([0.0, -0.08, 0.0, 0.0])


def test_broken_trains_are_found_within_three_days_and_no_others() -> None:
    view = analyse(fleet_rows(1, 20, 20, {4: (9, DRAG), 11: (12, PADS)}), LIMIT)
    assert {train.name for train in view.found} == {'T04', 'T11'}
    for train in view.found:
        onset, effect = {'T04': (9, 'dragging_brake'), 'T11': (12, 'brake_scale')}[train.name]
        (change,) = train.changes
        assert change.day == onset
        assert change.alarm <= onset + 2
        assert train.causes[0].effect == effect


@pytest.mark.parametrize('seed', [11, *(pytest.param(seed, marks=pytest.mark.long) for seed in (12, 13))])
def test_a_fault_of_three_days_in_a_small_fleet_is_found_and_named_by_its_onset(seed: int) -> None:
    """A third of the days of one train in five: the fault must not hide in the spread that it makes."""
    (train,) = analyse(fleet_rows(seed, 5, 6, {2: (2, 2.0 * DRAG)}, lasts=3), LIMIT).found
    assert train.name == 'T02'
    (departure,) = train.departures
    assert (departure.first, departure.end) == (2, None)  # one day is too little to see its end
    assert departure.alarm <= 4
    assert train.causes[0].effect == 'dragging_brake'


def test_a_fault_that_has_ended_keeps_its_cause() -> None:
    (train,) = analyse(fleet_rows(14, 5, 20, {3: (6, 2.0 * DRAG)}, lasts=7), LIMIT).found
    assert [change.day for change in train.changes] == [6, 13]
    assert (train.main and train.main.first, train.main and train.main.end) == (6, 13)
    assert train.causes[0].effect == 'dragging_brake'


@pytest.mark.parametrize('seed', [30, pytest.param(31, marks=pytest.mark.long)])
def test_few_healthy_trains_do_not_stand_out(seed: int) -> None:
    assert analyse(fleet_rows(seed, 5, 6), LIMIT).found == ()


@pytest.mark.parametrize(('lines', 'wet', 'drag', 'brake'), [(1, 'L0', 1.3, 0.9), (3, 'L1', 1.25, 1.0)])
def test_rain_on_a_line_is_no_change_of_its_trains(lines: int, wet: str, drag: float, brake: float) -> None:
    rows = fleet_rows(2, 24, 20, lines=lines)
    for row in rows:
        if row['day'] >= '2026-03-11' and row['line'] == wet:
            row |= {'w15': drag * row['w15'], 'brake_rate': brake * row['brake_rate']}
    assert analyse(rows, LIMIT).found == ()


def test_a_train_that_always_differed_is_an_outlier() -> None:
    (train,) = analyse(fleet_rows(4, 20, 12, {7: (0, 3.0 * PADS)}), LIMIT).found
    assert (train.name, train.changes) == ('T07', ())
    assert [outlier.channel.name for outlier in train.outliers] == ['brake_rate']
    assert train.causes[0].effect == 'brake_scale'


def test_runs_whose_inputs_contradict_each_other_are_named_and_left_out() -> None:
    rows = fleet_rows(5001, trains=5, days=8)
    for row in rows[3 * 8 + 4 : 4 * 8]:  # the last four days of T03
        row |= {'w15': 2.0 * row['w15'], 'contradiction': 'the acceleration is 0.5 times what ato/force and mass give'}
    view = analyse(rows, LIMIT)
    assert not view.found
    assert view.contradicted == (('T03', 4),)
    said = 'Runs left out as their inputs contradict each other, see the column contradiction: T03 (4).'
    assert said in summary(view)
    used = analyse([row | {'contradiction': None} for row in rows], LIMIT)
    assert [train.name for train in used.found] == ['T03']


def test_what_cannot_be_seen_yet_is_said_with_the_reason() -> None:
    rows = [row for row in fleet_rows(5, 6, 6) if row['train'] != 'T01' or row['day'] < '2026-03-03']
    rows = [row for row in rows if row['train'] != 'T02' or row['day'] < '2026-03-05']
    rows = [row | {'wheel_ratio': None} for row in rows]
    rows = [row | ({'status': None, 'error': 'no speed'} if row['train'] == 'T03' else {}) for row in rows]
    hidden = analyse(rows, LIMIT).hidden
    assert hidden == (
        'What began of T00, T04, T05 on 2026-03-06 or later: a change needs 2 days of data.',
        'What began of T02 on 2026-03-04 or later: a change needs 2 days of data.',
        'Changes of T01: there must be 3 days of data.',
        'Train T03: no run can be used (no speed).',
        'Changes of wheel ratio: fewer than 4 days of trains have a value.',
    )


def test_too_few_rows_are_no_answer() -> None:
    rows = fleet_rows(5, 3, 1)
    with pytest.raises(NoAnswerError, match=r'too few days of trains to compare: 3 rows, 3 with train, .*; 4 days'):
        analyse(rows, LIMIT)
    for row in rows:
        row['train'] = None
    with pytest.raises(NoAnswerError, match=r'too few days of trains to compare: 27 rows, 0 with train'):
        analyse(rows * 9, LIMIT)
