# SPDX-License-Identifier: Apache-2.0
"""Conversion of measured trips to records, on a synthetic trip and on the real trips if available."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.explain import runs_of
from benchmarks.measured_car import (
    FOLDER,
    MASS,
    WANTED,
    gradient,
    identify,
    load_trip,
    records,
    regress,
    stated_car,
    trip_names,
    wheel_force,
)
from trainid_ros.explain.workflow import explain
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, SpeedRecord
from trainid_ros.train.forces import G, davis

EFFECTIVE = 1550.0
GRADE = 12.0
STEPS = {'t': 0.1, 'speed_kmh': 0.01, 'elevation_m': 0.01, 'throttle': 0.01, 'motor_torque_nm': 0.01, 'acc_long': 0.01}


def write_trip(folder: Path, name: str, seconds: float = 600.0) -> None:
    """Write a trip up a slope of 12 per mille; the pedal is released in the last fifth of each minute."""
    t = np.arange(0.0, seconds, 0.1)
    v = 18.0 + 8.0 * np.sin(t / 15.0)
    rate = np.gradient(v, 0.1)
    resistance = 150.0 + 2.0 * v + 0.35 * v**2
    force = EFFECTIVE * (rate + G * GRADE / 1000.0) + resistance
    columns = {
        't': t,
        'speed_kmh': 3.6 * v,
        'elevation_m': 500.0 + np.cumsum(v) * 0.1 * GRADE / 1000.0,
        'throttle': np.where(t % 60.0 < 48.0, 20.0, 0.0),
        'motor_torque_nm': force * 0.3397 / 9.665,
        'acc_long': rate + G * GRADE / 1000.0 + 0.3,  # offset of the accelerometer
    }
    stored = {key: np.diff(np.round(columns[key] / step).astype(np.int64), prepend=0) for key, step in STEPS.items()}
    np.savez(folder / f'{name}.npz', names=list(STEPS), steps=list(STEPS.values()), **stored)  # type: ignore[arg-type]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / 'trips.csv').write_text(
        'trip,start,load_kg\nTripB05,2019_12_09_07-58-11,0\nTripB02,2019-12-07_17-49-35,0\nTripA02,2019-06-25_14-05-31,0\n'
    )
    write_trip(tmp_path, 'TripB02')
    return tmp_path


def test_trips_of_a_season_are_sorted_by_date(folder: Path) -> None:
    assert trip_names(folder, 'B') == ('TripB02', 'TripB05')
    assert trip_names(folder, 'A') == ('TripA02',)


def test_stated_car_has_the_coast_down_resistance() -> None:
    car = stated_car()
    force = MASS * G / 1000.0 * davis(car.resistance, 20.0)
    assert force == pytest.approx(101.9 + 3.443 * 20.0 + 0.3619 * 400.0)
    assert car.train.mass == MASS
    assert (car.train.mass_std, car.train.force_std, car.line.gradient_std) == (0.1, 0.1, 5.0)


def test_gradient_does_not_contain_the_accelerometer_offset(folder: Path) -> None:
    slope = gradient(load_trip(folder, 'TripB02'))
    # At the ends the low-pass has data on one side only.
    assert slope[1500:-1500] == pytest.approx(GRADE, abs=2.0)
    assert slope[1500:-1500].mean() == pytest.approx(GRADE, abs=0.5)


def test_records_contain_speed_force_gradient_and_a_brake_command_while_the_pedal_is_released(folder: Path) -> None:
    trip = load_trip(folder, 'TripB02')
    found = list(records(trip))
    assert len(found) == 4 * trip.speed.size
    speeds = [record for record in found if isinstance(record, SpeedRecord)]
    assert speeds[10].speed == pytest.approx(18.0 + 8.0 * np.sin(1.0 / 15.0), abs=0.01)
    assert speeds[10].stamp_ns - speeds[0].stamp_ns == NS_PER_S
    forces = [record.force for record in found if isinstance(record, ForceRecord)]
    assert forces[0] == pytest.approx(wheel_force(np.array([trip.force[0] * 0.3397 / 9.665]))[0])
    commands = [record for record in found if isinstance(record, BrakeRecord)]
    brakes = np.array([record.target_acceleration for record in commands])
    assert np.array_equal(brakes < 0.0, ~trip.pedal)
    assert all(
        record.emergency == (record.target_acceleration < 0.0) for record in found if isinstance(record, BrakeRecord)
    )
    assert 0.15 < np.mean(brakes < 0.0) < 0.25
    assert sum(isinstance(record, GradientRecord) for record in found) == trip.speed.size


def test_regression_recovers_resistance_and_mass(folder: Path) -> None:
    found = regress([load_trip(folder, 'TripB02')])
    assert found.force == pytest.approx(150.0 + 40.0 + 140.0, abs=15.0)
    assert found.masses['TripB02'] == pytest.approx(EFFECTIVE, rel=0.03)
    assert found.windows > 50


@pytest.mark.slow
@pytest.mark.parametrize(('season', 'reference'), [('A', 312.0), ('B', 421.0)])
def test_the_estimate_of_a_season_is_that_of_the_regression(season: str, reference: float) -> None:
    if not (FOLDER / 'trips.csv').is_file():
        pytest.skip(f'the measured trips are not in {FOLDER}: they are not part of the repository')
    trips = [load_trip(FOLDER, name) for name in trip_names(FOLDER, season)]
    found = identify(trips, 'filter-bank', **WANTED)
    # The estimate after any one trip has a standard deviation of 20-60 N: all trips together are judged.
    assert found.mean == pytest.approx(reference, rel=0.1)
    assert found.rms_error(reference) < 1.5
    assert found.to_valid < 30.0


@pytest.mark.parametrize(('season', 'reference'), [('A', 312.0), ('B', 421.0)])
def test_regression_on_the_real_trips_matches_the_reference(season: str, reference: float) -> None:
    if not (FOLDER / 'trips.csv').is_file():
        pytest.skip(f'the measured trips are not in {FOLDER}: they are not part of the repository')
    found = regress([load_trip(FOLDER, name) for name in trip_names(FOLDER, season)])
    assert found.force == pytest.approx(reference, abs=10.0)


@pytest.mark.slow
@pytest.mark.parametrize(('trip', 'is_loaded'), [('TripB33', True), ('TripB24', True), ('TripB26', False)])
def test_explain_names_the_load_of_a_trip(trip: str, is_loaded: bool) -> None:
    if not (FOLDER / 'trips.csv').is_file():
        pytest.skip('the measured trips are not part of the repository')
    found = explain(runs_of([list(records(load_trip(FOLDER, trip)))], stated_car()), stated_car())
    names = {effect.name for effect in found.effects} | {twin.name for effect in found.effects for twin in effect.twins}
    assert ('mass_error' in names) == is_loaded
    assert found.gap is not None
    assert not is_loaded or found.gap.after < 0.6 * found.gap.before
