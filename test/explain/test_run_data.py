# SPDX-License-Identifier: Apache-2.0
"""Runs: where they begin and end, and their brake forces and positions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.explain.dataset import LONGEST_S, Run, RunCollector
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange, specific_inertia
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

START = 1_700_000_000 * NS_PER_S
FILE = TrainFile(Train(200e3), Davis(1.5, 0.02, 0.003), Brake(0.9, 0.4, 0.6))
PLAIN = Sample(START, 0.2, 0.0, 0.0, 1, 0.0, 0.0, 2.0, 2.0, 0.0, False, math.nan, 0.0, (), False, False)


def samples(speeds: Sequence[float], changes: dict[int, dict[str, Any]] | None = None) -> list[Sample]:
    """Return samples at 5 Hz with these speeds [m/s], with changed fields by index of the sample."""
    made, position = [], 100.0
    for k, speed in enumerate(speeds):
        position += 0.2 * speed
        fields = {
            'stamp_ns': START + k * NS_PER_S // 5, 'dt': math.nan if k == 0 else 0.2, 'speed': speed,
            'position': position, **(changes or {}).get(k, {}),
        }  # fmt: skip
        made.append(replace(PLAIN, **fields))
    return made


def collect(made: Iterable[Sample]) -> list[Run]:
    collector = RunCollector(FILE)
    for sample in made:
        collector.add(sample)
    collector.end_run()
    return collector.runs


def test_a_run_is_from_standstill_to_standstill() -> None:
    first, second = collect(samples([0.0] * 5 + [10.0] * 100 + [0.0] * 5 + [8.0] * 90 + [0.0]))
    assert (first.time.size, second.time.size) == (100, 90)
    assert first.time[0] == pytest.approx(1.0)
    assert first.stops == pytest.approx((100.0, 300.0))
    assert second.stops[0] == pytest.approx(300.0)
    assert first.travelled == pytest.approx(200.0, abs=3.0)
    assert (first.direction, first.dt[0], first.dt[1]) == (1, 0.0, 0.2)
    assert first.positioned


def test_a_gap_ends_a_run() -> None:
    first, second = collect(samples([10.0] * 200, {100: {'dt': math.nan}}))
    assert (first.time.size, second.time.size) == (100, 100)
    assert all(math.isnan(stop) for run in (first, second) for stop in run.stops)


@pytest.mark.parametrize(
    'field', [{'emergency': True}, {'force_mean': math.nan}, {'gradient_mean': math.nan}, {'brake_command': math.nan}]
)
def test_unusable_sample_ends_a_run(field: dict[str, Any]) -> None:
    first, second = collect(samples([10.0] * 201, {100: field}))
    assert (first.time.size, second.time.size) == (100, 100)


def test_short_runs_are_discarded_and_long_ones_split() -> None:
    assert collect(samples([10.0] * 70)) == []
    runs = collect(samples([10.0] * round(2.5 * LONGEST_S * 5)))
    assert len(runs) == 3
    assert all(run.time[-1] - run.time[0] <= LONGEST_S + 0.3 for run in runs)


def test_unknown_position_is_replaced_by_distance() -> None:
    fields = {k: {'position': math.nan} for k in range(101)}
    (run,) = collect(samples([10.0] * 101, fields))
    assert not run.positioned
    assert np.isfinite(run.position).all()
    assert run.position[-1] - run.position[0] == pytest.approx(200.0)
    assert run.direction == 1


def test_falling_positions_give_the_negative_direction() -> None:
    fields = {k: {'position': 500.0 - 2.0 * k} for k in range(101)}
    (run,) = collect(samples([10.0] * 101, fields))
    assert run.direction == -1


def test_mass_is_measured_or_from_the_train_file() -> None:
    loaded = {k: {'mass': 250e3, 'force_mean': 50e3} for k in range(101)}
    (run,) = collect(samples([10.0] * 101, loaded))
    assert run.weighed
    assert run.traction[5] == pytest.approx(1000.0 * 50e3 / (250e3 * 9.80665))
    (run,) = collect(samples([10.0] * 101, {k: {'force_mean': 50e3} for k in range(101)}))
    assert not run.weighed
    assert run.traction[5] == pytest.approx(1000.0 * 50e3 / (200e3 * 9.80665))


def test_brake_force_follows_the_command() -> None:
    """While the brake acts, a measured force is used only if it is still traction."""
    at, back = START + 50 * NS_PER_S // 5, START + 75 * NS_PER_S // 5
    changes: dict[int, dict[str, Any]] = {k: {'force_mean': -90e3} for k in range(50, 120)}
    changes[50]['brake_changes'] = (BrakeCommandChange(at, -0.8),)
    changes[75]['brake_changes'] = (BrakeCommandChange(back, 0.0),)
    (run,) = collect(samples([15.0] * 120, changes))
    inertia = specific_inertia(1.0, FILE.train.rotary_mass)
    assert not run.brake[:53].any()  # dead time of 0.6 s
    assert run.brake[74] == pytest.approx(-0.9 * 0.8 * inertia, rel=0.01)
    assert 0.0 > run.brake[54] > -0.9 * 0.8 * inertia
    assert not run.traction[56:76].any()
    assert run.since_release[74] == 0.0
    assert run.since_release[-1] > 4.0
    assert math.isinf(run.since_release[10])
    assert run.heat[10] == 0.0
    assert run.heat[80] == pytest.approx(0.9 * 0.8 * 15.0 * 5.0, rel=0.1)


def test_traction_against_the_brake_is_the_difference() -> None:
    changes: dict[int, dict[str, Any]] = {k: {'force_mean': 40e3} for k in range(120)}
    changes[50]['brake_changes'] = (BrakeCommandChange(START + 10 * NS_PER_S, -0.5),)
    (run,) = collect(samples([15.0] * 120, changes))
    np.testing.assert_allclose(run.traction + run.brake, run.traction[0])


def test_run_starts_after_the_brake_is_released() -> None:
    changes: dict[int, dict[str, Any]] = {
        1: {'brake_changes': (BrakeCommandChange(START, -0.8),)},
        20: {'brake_changes': (BrakeCommandChange(START + 4 * NS_PER_S, 0.0),)},
    }
    (run,) = collect(samples([0.0] * 10 + [5.0] * 150, changes))
    assert run.time[0] > 5.0
    assert not run.brake.any()


def test_gaps_in_positions_are_bridged_by_the_distance() -> None:
    speeds = [0.0] * 5 + [10.0] * 100 + [0.0]
    (complete,) = collect(samples(speeds))
    (interrupted,) = collect(samples(speeds, {k: {'position': math.nan} for k in range(30, 60)}))
    assert interrupted.positioned
    np.testing.assert_allclose(interrupted.position, complete.position, atol=1e-6)
    (none,) = collect(samples(speeds, {k: {'position': math.nan} for k in range(10, 106)}))
    assert not none.positioned
    np.testing.assert_array_equal(none.position, none.distance_run)
