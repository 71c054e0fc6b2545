# SPDX-License-Identifier: Apache-2.0
"""Scores of resistance estimates on real trains: small hand-made cases and one short drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import rates, unknowns
from benchmarks.days import samples_of
from benchmarks.real_train_informed import InformedFilter, information_of
from benchmarks.real_train_scores import (
    Answers,
    Course,
    Score,
    course_of,
    first_valid,
    motion_since_change,
    motion_time,
    score,
)
from benchmarks.real_train_tables import (
    RATES,
    cost_tables,
    costs,
    first_cell,
    paired_table,
    rate_tables,
    spread,
    world_tables,
)
from benchmarks.real_train_trials import ALL, INFORMED, PAIRS, Trial, run
from benchmarks.real_trains import trials_of
from benchmarks.worlds import CLEAN, FIELD, WORLDS, Rates, drive
from trainid_ros.resistance.speed_states import A, B, C

N = 4
# Speed 2 m/s: the error of w is 1 + 2 * 0.5 + 4 * 0.25 = 3 in the last two samples.
COURSE = Course(
    speed=np.full(N, 2.0),
    davis=np.tile((1.0, 0.5, 0.25), (N, 1)),
    moving=np.array([False, True, True, True]),
    motion_s=np.array([0.0, 60.0, 120.0, 180.0]),
    settled=np.array([False, False, True, True]),
)
ANSWERS = Answers(
    davis=np.array([(1.0, 0.5, 0.25)] * 2 + [(2.0, 1.0, 0.5)] * 2),
    std=np.array([1.0, 1.0, 0.9, 1.6]),
    used=np.array([True, True, True, False]),
    valid=np.array([False, False, True, False]),
)


def test_error_and_coverage_use_settled_samples_only() -> None:
    found = score(ANSWERS, COURSE)
    assert found.error == pytest.approx(3.0)
    # 3 lies within 1.96 * 1.6, but not within 1.96 * 0.9.
    assert found.cover == 0.5


def test_status_is_scored_over_the_time_in_motion() -> None:
    found = score(ANSWERS, COURSE)
    assert found.valid == pytest.approx(1.0 / 3.0)
    assert found.first_valid_min == 2.0
    # Two samples in motion were used; one is VALID with an error of 3 > 3 * 0.9.
    assert found.wrong == 0.5
    assert score(replace(ANSWERS, std=np.full(N, 1.1)), COURSE).wrong == 0.0


def test_error_is_nan_without_settled_samples() -> None:
    found = score(ANSWERS, replace(COURSE, settled=np.zeros(N, bool)))
    assert math.isnan(found.error)
    assert math.isnan(found.cover)


def test_time_to_first_valid_is_infinite_if_never_valid() -> None:
    assert first_valid(COURSE.motion_s, np.zeros(N, bool)) == math.inf


def test_time_in_motion_counts_from_the_last_change() -> None:
    time_s = np.arange(1.0, 9.0)
    moving = np.array([0, 1, 1, 0, 0, 1, 1, 1], bool)
    motion_s = motion_time(time_s, moving)
    assert motion_s.tolist() == [0, 1, 2, 2, 2, 3, 4, 5]
    assert motion_since_change(time_s, motion_s, ()).tolist() == motion_s.tolist()
    assert motion_since_change(time_s, motion_s, (3.0, 6.0)).tolist() == [0, 1, 0, 0, 0, 0, 1, 2]


def test_settling_counts_time_in_motion_not_elapsed_time() -> None:
    truth = drive('metro', 21, CLEAN, duration=900.0).truth
    course = course_of(truth, truth.time_ns)
    assert course.motion_s[-1] == pytest.approx(0.2 * np.count_nonzero(truth.speed >= 1.0), rel=0.01)
    since = course.motion_s - np.interp(truth.changes[-1], 0.2 * np.arange(len(truth.speed)), course.motion_s)
    after = 0.2 * np.arange(len(truth.speed)) > truth.changes[-1]
    assert np.array_equal(course.settled[after], (course.moving & (since >= 300.0))[after])
    assert np.array_equal(course.davis[-1], (truth.a[-1], truth.b[-1], truth.c[-1]))


def test_all_algorithms_are_scored_on_a_short_drive() -> None:
    found = run(Trial('metro', 21, FIELD - {'changes'}, duration=600.0))
    assert tuple(found) == ALL
    # The train file itself has an error of .31 N/kN; two-window and speed-EKF take its mass and force as exact.
    assert max(found[name].error for name in (*PAIRS[0], INFORMED)) < 0.25
    assert max(one.error for one in found.values()) < 0.8
    assert all(0.0 <= one.valid < 1.0 and 0.0 <= one.cover <= 1.0 for one in found.values())


def test_informed_filter_adds_variance_to_a_and_c_at_a_change() -> None:
    made = drive('metro', 21, FIELD, duration=60.0)
    known = replace(information_of(made.truth), changes_ns=())
    assert (known.gust_std, known.map_std) == (made.truth.gust_std, made.truth.map_std)
    sample = samples_of(made.records)[0]
    quiet = InformedFilter(made.train_file, known)
    informed = InformedFilter(made.train_file, replace(known, changes_ns=(sample.stamp_ns,)))
    quiet.step(sample)
    informed.step(sample)
    before, after = (np.array(item.estimate(10.0).covariance).reshape(3, 3) for item in (quiet, informed))
    grown = np.diag(after - before)
    assert grown[A - 1] > 0.0
    assert grown[C - 1] > 0.0
    assert grown[B - 1] == 0.0


def test_information_contains_the_stamps_of_the_changes() -> None:
    truth = drive('metro', 21, CLEAN, duration=300.0).truth
    known = information_of(truth)
    assert known.changes_ns
    for stamp_ns, change in zip(known.changes_ns, truth.changes, strict=True):
        assert (stamp_ns - int(truth.time_ns[0])) * 1e-9 == pytest.approx(change)


def test_means_leave_out_values_that_are_not_finite() -> None:
    assert spread(np.array([1.0, 3.0, math.nan])) == '2.000 ± 1.000'
    assert spread(np.array([math.nan])) == '-'
    assert spread(np.array([1.0]), sign='+') == '+1.000'


def test_first_valid_cell_counts_drives_that_never_become_valid() -> None:
    scores = [Score(0.1, 0.9, 0.5, minutes, 0.0) for minutes in (4.0, 20.0, math.inf)]
    assert first_cell(scores) == '20.0, 33%'
    assert first_cell(scores[2:]) == 'never, 0%'


def test_each_drive_is_simulated_once_and_every_cell_has_its_drives() -> None:
    seeds, fewer = range(1, 4), range(1, 3)
    parts = (rates.trials_of(fewer), unknowns.trials_of(fewer), trials_of(seeds))
    # The drives of rates and of real_trains have all algorithms.
    trials = {trial: trial for part in (parts[1], parts[0], parts[2]) for trial in part}.values()
    for part in parts:
        assert len(set(part)) == len(part)
    assert Trial('metro', 1, rates=Rates(50.0, 50.0, 50.0, 50.0)) in trials
    results = {
        trial: {name: Score(0.1 * k, 0.9, 0.5, 3.0, 0.0) for k, name in enumerate(trial.algorithms)} for trial in trials
    }
    worlds = world_tables(results, seeds)
    assert [len(table.rows) for table in worlds] == [len(ALL)] * 7
    paired = paired_table(
        results, seeds, PAIRS[0], [{'V-MILS': 0.1, 'filter-bank': 0.3}, {'V-MILS': 0.2, 'filter-bank': 0.2}]
    )
    assert paired.rows[-1] == ('Yizhuang days', '0.150 ± 0.050', '0.250 ± 0.050', '+0.100 ± 0.100', '0%')
    assert len(paired.rows) == 2 * len(WORLDS) + 1
    costly = cost_tables(results, fewer)
    assert [len(table.rows) for table in costly] == [len(costs())] * len(PAIRS[0])
    assert [len(table.rows) for table in rate_tables(results, fewer)] == [len(RATES)] * 3
