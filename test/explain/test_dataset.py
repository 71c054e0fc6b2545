# SPDX-License-Identifier: Apache-2.0
"""Grid points: the response to a resistance, means over one second, and outliers of the speed.

Runs: where they begin and end, and their brake forces and positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from test.explain.made_runs import TRAIN, Maker, disturbed
from trainid_ros.explain.dataset import MAX_RUN_S, Dataset, Run, RunCollector, assemble, find_outliers, numbered
from trainid_ros.explain.model import Model
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import (
    BRAKE_APPLIED,
    BrakeActuator,
    BrakeCommandChange,
    held_by,
    specific_force,
    specific_inertia,
)
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

START = 1_700_000_000 * NS_PER_S
FILE = TrainFile(Train(200e3), Davis(1.5, 0.02, 0.003), Brake(0.9, 0.4, 0.6))
PLAIN = Sample(START, 0.2, 0.0, 0.0, 1, 0.0, 0.0, 2.0, 2.0, 0.0, False, math.nan, 0.0, (), False, False)


APPLIED = BrakeCommandChange(START + 32 * NS_PER_S // 5, -1.0)
RELEASED = BrakeCommandChange(START + 72 * NS_PER_S // 5, 0.0)


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


def test_a_run_is_without_its_slowest_ends() -> None:
    """At 0.2 m/s the brake may hold the train already."""
    (run,) = collect(samples([0.0] * 5 + [0.2] * 5 + [10.0] * 100 + [0.2] * 5 + [0.0]))
    assert (run.time.size, run.speed.min()) == (100, 10.0)


@pytest.mark.parametrize('name', ['dt', 'emergency', 'force_mean', 'gradient_mean', 'brake_command'])
def test_a_gap_or_an_unusable_sample_ends_a_run(name: str) -> None:
    fields = {name: True if name == 'emergency' else math.nan}
    first, second = collect(samples([10.0] * (200 if name == 'dt' else 201), {100: fields}))
    assert (first.time.size, second.time.size) == (100, 100)
    assert all(math.isnan(stop) for run in (first, second) for stop in run.stops)


def test_short_runs_are_discarded_and_long_ones_split() -> None:
    assert collect(samples([10.0] * 70)) == []
    runs = collect(samples([10.0] * round(2.5 * MAX_RUN_S * 5)))
    assert len(runs) == 3
    assert all(run.time[-1] - run.time[0] <= MAX_RUN_S + 0.3 for run in runs)


def test_mass_is_measured_or_from_the_train_file() -> None:
    loaded = {k: {'mass': 250e3, 'force_mean': 50e3} for k in range(101)}
    unloaded = {k: {'force_mean': 50e3} for k in range(101)}
    for fields, weighed, mass in ((loaded, True, 250e3), (unloaded, False, 200e3)):
        (run,) = collect(samples([10.0] * 101, fields))
        assert run.weighed is weighed
        assert run.traction[5] == pytest.approx(1000.0 * 50e3 / (mass * 9.80665))


def test_the_drag_of_the_load_is_known_resistance() -> None:
    file = replace(FILE, train=replace(FILE.train, c_by_weight=1.0))
    collector = RunCollector(file)
    for one in samples([10.0] * 101, {k: {'mass': 250e3} for k in range(101)}):
        collector.add(one)
    collector.end_run()
    drag = -0.003 * 100.0 * 0.2  # c v^2 (200 / 250 - 1)
    assert collector.runs[0].load_drag == pytest.approx(np.full(101, drag))
    model, plain = (Model.of(collector.runs, train_file) for train_file in (file, FILE))
    inertia = specific_inertia(1.0, FILE.train.rotary_mass)
    faster = plain.dataset.gap[-1] - model.dataset.gap[-1]  # by the predicted speed after 20 s
    assert faster == pytest.approx(-drag * 20.0 / inertia, rel=0.02)


def test_mass_of_a_run_is_weighed_although_the_train_may_stand_at_its_end() -> None:
    fields = {k: {'mass': 250e3, 'stood_since_weighing': k > 95} for k in range(101)}
    first, second = collect(samples([10.0] * 101 + [0.0] + [10.0] * 100, fields))
    assert (first.weighed, second.weighed) == (True, False)


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
    assert not run.traction[56:75].any()
    assert run.since_release[74] == 0.0
    assert run.since_release[-1] > 4.0
    assert math.isinf(run.since_release[10])
    assert run.heat[10] == 0.0
    assert run.heat[80] == pytest.approx(0.9 * 0.8 * 15.0 * 5.0, rel=0.1)


def test_a_train_that_stands_as_its_record_begins_was_held_by_its_brake() -> None:
    held = {k: {'force': -60e3 * 0.8**k} for k in range(10)}
    (run,) = collect(samples([0.0] * 3 + [2.0 + 0.2 * k for k in range(100)], held))
    # What the force tells of the brake lets go with the lag of the train file.
    released_s = FILE.brake.time_constant * math.log(held_by(FILE.train, -60e3) / BRAKE_APPLIED)
    assert run.since_release[-1] == pytest.approx(run.time[-1] - released_s, abs=0.2)
    (moving,) = collect(samples([2.0 + 0.2 * k for k in range(100)]))
    assert math.isinf(moving.since_release[-1])


def test_traction_against_the_brake_is_the_difference() -> None:
    changes: dict[int, dict[str, Any]] = {k: {'force_mean': 40e3} for k in range(120)}
    changes[50]['brake_changes'] = (BrakeCommandChange(START + 10 * NS_PER_S, -0.5),)
    (run,) = collect(samples([15.0] * 120, changes))
    # The train file has a brake rate of 0.9, but the brake is reported as that of a rate of 1.
    np.testing.assert_allclose(run.traction + run.brake / 0.9, run.traction[0])


def test_traction_before_the_brake_is_released_counts() -> None:
    """A driver who pulls at the command to release: the sum of both forces is still a braking force."""
    actuator, nominal = BrakeActuator(FILE.brake), FILE.train.mass * (1.0 + FILE.train.rotary_mass)
    changes: dict[int, dict[str, Any]] = {}
    for k in range(135):
        stamp = START + k * NS_PER_S // 5
        changes[k] = {'brake_changes': tuple(c for c in (APPLIED, RELEASED) if 0 <= stamp - c.stamp_ns < NS_PER_S // 5)}
        for change in changes[k]['brake_changes']:
            actuator.commands.push(change)
        mean = actuator.advance(stamp - NS_PER_S // 5, stamp) / 0.2
        changes[k]['force_mean'] = nominal * mean + (100e3 if k > 72 else 0.0)
    (run,) = collect(samples([15.0] * 135, changes))
    pull = specific_force(100e3, FILE.train.mass)
    assert not run.traction[:72].any()  # braking, with the sum of the forces as far negative as after it
    np.testing.assert_allclose(run.traction[73:84], pull)


@pytest.mark.parametrize(('report', 'counts'), [(1.0, True), (0.97, True), (0.6, False), (1.2, False)])
def test_traction_beside_a_stronger_brake_counts_if_the_report_is_exact(report: float, counts: bool) -> None:
    """Traction of a sixth of the brake force, or an error of the report, as of motors without the friction brake."""
    actuator, mass = BrakeActuator(FILE.brake), FILE.train.mass
    actuator.commands.push(APPLIED)
    changes: dict[int, dict[str, Any]] = {}
    for k in range(135):
        stamp = START + k * NS_PER_S // 5
        nominal = mass * (1.0 + FILE.train.rotary_mass) * actuator.advance(stamp - NS_PER_S // 5, stamp) / 0.2
        changes[k] = {'force_mean': report * nominal + (36e3 if 50 < k < 70 else 0.0)}
    changes[32]['brake_changes'] = (APPLIED,)
    (run,) = collect(samples([15.0] * 135, changes))
    assert not run.traction[:50].any()
    assert not run.traction[75:].any()
    expected = specific_force(36e3, mass) if counts else 0.0
    np.testing.assert_allclose(run.traction[55:65], expected, atol=1.01 * abs(1.0 - report) * -run.brake[60] / 0.9)


def test_a_load_that_is_not_weighed_is_no_traction() -> None:
    """A train a fifth lighter than stated: its reported brake force lacks a fifth until the brake is released."""
    changes: dict[int, dict[str, Any]] = {32: {'brake_changes': (APPLIED,)}, 72: {'brake_changes': (RELEASED,)}}
    nominal = FILE.train.mass * (1.0 + FILE.train.rotary_mass)
    for k in range(36, 76):
        changes.setdefault(k, {})['force_mean'] = -0.8 * nominal
    (run,) = collect(samples([15.0] * 135, changes))
    assert run.brake[70] < -50.0
    assert not run.traction[36:76].any()


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
    for first in (0, 10):
        (none,) = collect(samples(speeds, {k: {'position': math.nan} for k in range(first, 106)}))
        assert (none.positioned, none.direction) == (False, 1)
        np.testing.assert_array_equal(none.position, none.distance_run)
        assert none.position[-1] - none.position[0] == pytest.approx(198.0)


def test_correct_model_leaves_only_noise(dataset: Dataset) -> None:
    assert 0.015 < dataset.gap.std() < 0.03
    assert dataset.point_count.sum() == (~dataset.outlier).sum()
    assert np.all(dataset.point_count <= 5.0)


def test_response_to_a_missing_resistance_is_its_gap() -> None:
    runs = Maker(noise=0.0).runs(2, 4, lambda *_: 0.5)
    found = assemble(runs, TRAIN)
    missing = found.column(np.full(found.dt.size, 0.5))
    initial = found.gap[found.starts][found.run_of]
    np.testing.assert_allclose(found.average(found.gap - initial), missing, atol=0.03)
    assert np.abs(missing).max() > 0.3
    known = assemble(runs, TRAIN, np.full(found.dt.size, 0.5))
    np.testing.assert_allclose(known.gap, initial, atol=0.03)


def test_single_outliers_are_detected() -> None:
    runs = Maker().runs(2, 6)
    spoiled, by = [20, 60, 61, 130, 250], [0.5, -0.6, -0.6, 1.0, -0.4]
    found = assemble([disturbed(runs[0], (spoiled, by)), runs[1]], TRAIN)
    assert found.outlier[spoiled].all()
    assert found.outlier.sum() <= len(spoiled) + 3
    np.testing.assert_allclose(found.deviation[spoiled], by, atol=0.1)
    clean = assemble(runs, TRAIN)
    np.testing.assert_allclose(found.speed, clean.speed, atol=0.1)


def outliers(gap: NDArray[np.float64], *starts: int) -> NDArray[np.intp]:
    return np.flatnonzero(find_outliers(gap, np.array([0, *starts])))


def test_permanent_step_is_no_outlier_nor_are_samples_of_short_runs() -> None:
    gap = 0.02 * np.random.default_rng(1).standard_normal(300)
    few = outliers(gap).size
    gap[120:] += 0.5
    assert outliers(gap).size <= few + 1
    assert few <= 1
    assert outliers(np.array([0.0, 5.0, 0.0, 9.0]), 1, 2).size == 0


def test_burst_is_an_outlier_with_its_flanks() -> None:
    gap = 0.01 * np.random.default_rng(3).standard_normal(200)
    # The flanks of a burst of slip are too small to be outliers by themselves.
    gap[100:107] += [0.1, 0.6, 1.2, 1.3, 1.2, 0.6, 0.1]
    assert set(range(100, 107)) <= set(outliers(gap).tolist()) <= set(range(99, 108))


def test_burst_cut_by_the_edge_of_a_run_is_an_outlier() -> None:
    gap = 0.01 * np.random.default_rng(4).standard_normal(200)
    gap[:12] += 1.1
    gap[50] += 3.0
    assert outliers(gap).tolist() == [*range(12), 50]
    assert sorted(199 - outliers(gap[::-1])) == [*range(12), 50]


def test_node_of_outliers_only_has_no_samples() -> None:
    (run,) = Maker().runs(1, 6)
    found = assemble([disturbed(run, (slice(100, 105), 3.0))], TRAIN)
    point = int(np.searchsorted(found.point_starts, 100, side='right')) - 1
    assert found.point_count[point] == 0.0
    assert found.time[100] <= found.point_time[point] <= found.time[104]
    assert np.isfinite(found.average(found.gap)).all()
    assert found.column(np.ones(found.dt.size))[point] == 0.0


def test_columns_are_means_of_integrated_kicks() -> None:
    runs = Maker().runs(2, 6)
    found = assemble([disturbed(runs[0], ([60, 61], 3.0)), runs[1]], TRAIN)
    resistance = np.random.default_rng(1).standard_normal(found.dt.size)
    kick = -resistance * found.dt / found.inertia
    response = np.concatenate([np.cumsum(kick[found.run_of == k]) for k in range(2)])
    np.testing.assert_allclose(found.column(resistance), found.average(response), atol=1e-14)
    # Columns are integrated independently, also in batches.
    many = np.random.default_rng(0).standard_normal((found.dt.size, 17))
    np.testing.assert_allclose(found.column(many)[:, 1::15], np.stack([found.column(many[:, k]) for k in (1, 16)], 1))


def test_direction_of_runs_and_samples(dataset: Dataset) -> None:
    (run,) = collect(samples([10.0] * 101, {k: {'position': 500.0 - 2.0 * k} for k in range(101)}))
    assert run.direction == -1
    assert dataset.direction.shape == dataset.time.shape
    assert [int(dataset.direction[start]) for start in dataset.starts] == [1, -1, 1]


def test_runs_are_numbered_on_from_bag_to_bag() -> None:
    numbers = ((0, 1), (0, 2), (0, 2), (1, 1), (1, 3), (1, 0))  # a run in two parts, one too short, one not counted
    runs = [replace(Maker().runs(1, 6)[0], bag=bag, number=number) for bag, number in numbers]
    assert [run.number for run in numbered(runs)] == [1, 2, 2, 3, 5, 6]
