# SPDX-License-Identifier: Apache-2.0
"""The simulated drives obey the force balance, the interface and the selected unknowns."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.worlds import CLEAN, FIELD, UNKNOWNS, WORLDS, Drive, Rates, drive
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, Record, SpeedRecord
from trainid_ros.interface.scalars import find_fault
from trainid_ros.train.train_file import dump_train_file, parse_train_file

G = 9.80665
TOPICS: tuple[type[Record], ...] = (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord, MassRecord)
# Greatest distance of a stop from its stopping point [m].
ROOM = {'freight': 90.0, 'high_speed': 40.0, 'emu': 20.0, 'metro': 12.0, 'tram': 8.0}
# Which topics an unknown of the sensors may change; the others change the motion itself.
TOUCHED: dict[str, set[type[Record]]] = {
    'mass': {MassRecord, ForceRecord},
    'force_gain': {ForceRecord},
    'force_delay': {ForceRecord},
    'curve': set(),
    'map': {GradientRecord},
    'wheels': {SpeedRecord},
    'quantum': {SpeedRecord},
}


@cache
def made(world: str) -> Drive:
    return drive(world, 3, CLEAN, duration=1200.0)


@cache
def short(*unknowns: str) -> Drive:
    return drive('emu', 3, CLEAN | set(unknowns), duration=500.0)


def of(records: tuple[Record, ...], kind: type[Record]) -> list[Record]:
    return [record for record in records if type(record) is kind]


def column(run: Drive, kind: type[Record], name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows = of(run.records, kind)
    start = int(run.truth.time_ns[0])
    return np.array([(r.stamp_ns - start) * 1e-9 for r in rows]), np.array([getattr(r, name) for r in rows])


def balance(run: Drive, window: float = 10.0) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the residual of the force balance [N/kN], averaged over windows, and which windows include braking.

    Computed from records except for Davis coefficients, masses and brake rate: speed changes against mean forces.
    """
    truth, train = run.truth, run.train_file.train
    grid = (truth.time_ns - truth.time_ns[0]) * 1e-9
    speed = np.interp(grid, *column(run, SpeedRecord, 'speed'))
    gradient = np.interp(grid, *column(run, GradientRecord, 'gradient'))
    at, radius = column(run, GradientRecord, 'curve_radius')
    bend = np.interp(grid, at, np.where(radius > 0.0, 1.0 / np.maximum(radius, 1.0), 0.0))
    force = np.interp(grid, *column(run, ForceRecord, 'force'))
    force = np.where(force < -0.001 * truth.mass * G, force * truth.brake_rate, force * truth.force_scale)
    coefficient = dict(run.train_file.effects[0].parameters)['coefficient']
    w = truth.a + truth.b * speed + truth.c * speed**2 + gradient + coefficient * bend
    residual = 1000.0 * force / (truth.mass * G) - w
    n = round(window / 0.2)
    out, braked = [], []
    for i in range(0, grid.size - n - 1, n):
        if truth.moving[i : i + n + 1].all():
            change = 1000.0 * (1.0 + train.rotary_mass) * (speed[i + n] - speed[i]) / window / G
            out.append(0.5 * (residual[i : i + n].mean() + residual[i + 1 : i + n + 1].mean()) - change)
            braked.append(bool(truth.braking[i : i + n + 1].any()))
    return np.array(out), np.array(braked)


@pytest.mark.parametrize('world', WORLDS)
def test_records_and_truth_satisfy_the_force_balance(world: str) -> None:
    residual, braked = balance(made(world))
    assert residual[~braked].size > 20
    assert abs(residual[~braked].mean()) < 0.03
    assert np.std(residual[~braked]) < 0.25
    assert abs(residual[braked].mean()) < 0.2
    assert np.std(residual[braked]) < 0.35


@pytest.mark.parametrize('world', WORLDS)
def test_reported_brake_effort_follows_the_command_with_dead_time_and_lag(world: str) -> None:
    run = made(world)
    brake, train, step = run.train_file.brake, run.train_file.train, 0.01
    at, command = column(run, BrakeRecord, 'target_acceleration')
    grid = np.arange(0.0, at[-1], step)
    late = command[np.clip(np.searchsorted(at, grid - brake.delay, side='right') - 1, 0, None)]
    keep = float(np.exp(-step / brake.time_constant))
    response = lfilter([1.0 - keep], [1.0, -keep], late)
    effort = np.interp(grid, *column(run, ForceRecord, 'force'))
    truth_at = np.minimum((grid / 0.2).astype(np.int64), run.truth.mass.size - 1)
    braking = run.truth.braking[truth_at]
    gap = effort / (run.truth.mass[truth_at] * (1.0 + train.rotary_mass)) - response
    assert np.count_nonzero(braking) * step > 30.0
    assert abs(gap[braking].mean()) < 0.01
    assert np.std(gap[braking]) < 0.03


@pytest.mark.parametrize('world', WORLDS)
def test_all_records_are_valid_and_in_order(world: str) -> None:
    run = made(world)
    stamps = [record.stamp_ns for record in run.records]
    assert stamps == sorted(stamps)
    assert not [record for record in run.records if find_fault(*record.row()[:4])]
    assert {type(record) for record in run.records} >= set(TOPICS[:4])
    at, speed = column(run, SpeedRecord, 'speed')
    index = np.round(at / 0.2).astype(np.int64)
    moving = np.pad(run.truth.moving, 2)
    standing = ~(moving[index + 1] | moving[index + 2] | moving[index + 3])
    assert np.all(speed[standing] == 0.0)


@pytest.mark.parametrize('world', WORLDS)
def test_stops_are_near_the_stopping_points(world: str) -> None:
    assert all(abs(error) < ROOM[world] for error in made(world).truth.stop_errors)


@pytest.mark.parametrize('world', WORLDS)
def test_speed_limits_are_obeyed(world: str) -> None:
    run = made(world)
    limits = np.array(run.train_file.line.speed_limit)
    at, position = column(run, SpeedRecord, 'position')
    speed = np.interp(at, (run.truth.time_ns - run.truth.time_ns[0]) * 1e-9, run.truth.speed)
    limit = limits[np.clip(np.searchsorted(limits[:, 0], position, side='right') - 1, 0, None), 1]
    over = speed - limit
    assert np.mean(over > 0.5) < 0.01
    assert over.max() < 4.0


def test_train_file_survives_a_round_trip() -> None:
    file = made('tram').train_file
    assert parse_train_file(dump_train_file(file), 'text') == file


def test_equal_seeds_give_equal_drives_and_other_seeds_others() -> None:
    again = drive('emu', 3, CLEAN, duration=500.0)
    assert again.records == short().records
    assert drive('emu', 4, CLEAN, duration=10.0).records[:100] != short().records[:100]


@pytest.mark.parametrize('name', list(TOUCHED))
def test_sensor_error_changes_no_other_topic(name: str) -> None:
    clean, run = short(), short(name)
    assert np.array_equal(clean.truth.speed, run.truth.speed)
    changed = {kind for kind in TOPICS if of(clean.records, kind) != of(run.records, kind)}
    assert changed == TOUCHED[name]


@pytest.mark.parametrize(
    ('name', 'part'), [('mass', 'train'), ('curve', 'effects'), ('map', 'line'), ('brake', 'brake')]
)
def test_error_changes_only_its_part_of_the_train_file(name: str, part: str) -> None:
    clean, run = short().train_file, short(name).train_file
    assert getattr(clean, part) != getattr(run, part)
    assert replace(clean, **{part: getattr(run, part)}) == run


@pytest.mark.parametrize('name', ['gusts', 'brake'])
def test_error_of_the_motion_does_not_change_resistance(name: str) -> None:
    clean, run = short(), short(name)
    assert not np.array_equal(clean.truth.speed[:2500], run.truth.speed[:2500])
    assert clean.truth.changes == run.truth.changes
    assert all(getattr(clean.truth, name)[0] == getattr(run.truth, name)[0] for name in 'abc')


def test_changes_occur_at_the_times_in_the_truth() -> None:
    truth = made('metro').truth
    steps = np.flatnonzero(np.diff(truth.a) + np.diff(truth.b) + np.diff(truth.c)) + 1
    assert np.allclose(steps * 0.2, truth.changes, atol=0.2)
    assert truth.brake_changes
    still = drive('metro', 3, (), duration=100.0).truth
    assert still.changes == still.brake_changes == ()
    assert np.ptp(still.a) == np.ptp(still.brake_rate) == 0.0


def test_force_scale_is_true_over_reported_effort() -> None:
    run = short('mass', 'force_gain')
    truth = run.truth
    grid = (truth.time_ns - truth.time_ns[0]) * 1e-9
    reported = np.interp(grid, *column(run, ForceRecord, 'force'))
    weighed = np.interp(grid, *column(run, MassRecord, 'mass'))
    change = np.abs(np.gradient(truth.traction))
    steady = truth.moving & (truth.traction > 0.4 * truth.traction.max()) & (change < 0.01 * truth.traction)
    ratio = truth.traction[steady] / reported[steady] * weighed[steady] / truth.mass[steady]
    assert abs(np.median(ratio / truth.force_scale[steady]) - 1.0) < 1e-3
    assert abs(np.median(truth.force_scale) - 1.0) > 1e-3


def test_field_values_lie_in_their_ranges() -> None:
    truth = drive('metro', 5, FIELD, duration=600.0).truth
    assert 0.0 <= truth.force_delay <= 0.3
    assert abs(truth.brake_delay_error) <= 0.3
    assert abs(truth.wheel_ratio - 1.0) <= 0.005
    assert 0.1 <= truth.gust_std <= 0.4
    assert 3.0 <= truth.gust_time <= 12.0
    assert 0.1 <= truth.map_std <= 0.5
    assert 100.0 <= truth.map_length <= 500.0
    assert 0.5 < truth.brake_rate[truth.braking].min() < truth.brake_rate[truth.braking].max() < 1.5


def test_topics_have_their_own_rates() -> None:
    run = drive('tram', 3, CLEAN, Rates(speed=10.0, brake=2.0), duration=100.0)
    counts = [len(of(run.records, kind)) for kind in TOPICS]
    assert counts[0] == pytest.approx(2 * counts[1], abs=2)
    assert counts[3] == pytest.approx(counts[1] / 2.5, abs=2)


def test_unknown_names_are_rejected() -> None:
    with pytest.raises(ValueError, match='unknowns must be of'):
        drive('metro', 1, {'moon'})
    with pytest.raises(ValueError, match='world must be one of'):
        drive('ship', 1)
    assert frozenset(UNKNOWNS) == FIELD


@pytest.mark.slow
@pytest.mark.parametrize('world', WORLDS)
@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.long)])
def test_field_drives_are_valid_and_long_enough(world: str, seed: int) -> None:
    run = drive(world, seed)
    assert not [record for record in run.records if find_fault(*record.row()[:4])]
    assert all(abs(error) < ROOM[world] for error in run.truth.stop_errors)
    assert run.truth.time_ns.size * 0.2 > 50 * 60
    assert np.count_nonzero(run.truth.moving) * 0.2 > 40 * 60
