# SPDX-License-Identifier: Apache-2.0
"""A complete simulation: stops, records, true values, determinism, and a fit of them; its sensors."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import BrakeRecord, ForceRecord, GradientRecord, MassRecord, SpeedRecord
from trainid_ros.sim.plant import DriverModel, GustModel
from trainid_ros.sim.scenario import MAX_JITTER_NS, Change, Scenario, SensorModel, Sensors, Simulation, simulate
from trainid_ros.train.effects import effect_value
from trainid_ros.train.forces import G, davis, specific_force, specific_inertia
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile

LINE = Line(
    stops=(0.0, 1500.0, 3200.0),
    gradient=((0.0, -3.0), (400.0, 12.0), (900.0, -20.0), (1400.0, 0.0), (2000.0, 8.0), (2600.0, -9.0)),
    speed_limit=((0.0, 15.0), (200.0, 21.0), (2400.0, 14.0), (2700.0, 21.0)),
)
FILE = TrainFile(Train(200e3, 0.08, 100.0), Davis(1.5, 0.03, 0.004), Brake(), LINE)
QUICK = DriverModel(dwell_low=5.0, dwell_high=8.0)
Floats = NDArray[np.float64]
NOISE = 'speed_noise speed_quantum force_noise force_noise_relative position_drift map_error mass_noise stamp_jitter'
EXACT = SensorModel(**dict.fromkeys(NOISE.split(), 0.0))
SCENARIO = Scenario(FILE, runs=4, driver=QUICK)
QUIET = replace(SCENARIO, sensors=EXACT, gust=GustModel(std=0.0))


def drive(scenario: Scenario, seed: int = 1) -> Simulation:
    return simulate(scenario, np.random.default_rng(seed))


Kind = TypeVar('Kind', SpeedRecord, ForceRecord, GradientRecord, BrakeRecord, MassRecord)


def of(kind: type[Kind], simulation: Simulation) -> list[Kind]:
    return [record for record in simulation.records if type(record) is kind]


@pytest.fixture(scope='module')
def day() -> Simulation:
    return drive(SCENARIO)


@pytest.fixture(scope='module')
def quiet() -> Simulation:
    return drive(QUIET)


@pytest.mark.parametrize('rate', [0.7, 0.85, 1.0, 1.1])
def test_the_train_stops_in_place_with_weak_and_strong_brakes(rate: float) -> None:
    arrivals = drive(replace(SCENARIO, train_file=replace(FILE, brake=Brake(rate)))).arrivals
    assert [arrival.stop for arrival in arrivals] == [1500.0, 3200.0, 1500.0, 0.0]
    assert max(abs(arrival.error) for arrival in arrivals) < 1.0


def test_speed_limits_are_kept_in_both_directions(quiet: Simulation) -> None:
    for record in of(SpeedRecord, quiet):
        in_slow_part = 2400.0 < record.position < 2700.0
        assert record.speed <= (14.0 if in_slow_part else 21.0)


def test_records_come_in_order_with_their_own_stamps(day: Simulation) -> None:
    stamps = [record.stamp_ns for record in day.records]
    assert all(before <= after for before, after in pairwise(stamps))
    assert stamps[0] == SCENARIO.start_ns
    ticks = round(day.duration_s / 0.2)
    for kind in (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord):
        assert sum(isinstance(record, kind) for record in day.records) == ticks
    assert len(of(MassRecord, day)) == pytest.approx(day.duration_s, abs=1.0)


def test_force_is_measured_20_ms_before_speed(quiet: Simulation) -> None:
    pairs = zip(of(ForceRecord, quiet), of(SpeedRecord, quiet), strict=True)
    assert {speed.stamp_ns - force.stamp_ns for force, speed in pairs} == {20_000_000}


def test_records_repeat_with_the_seed_and_differ_with_another(day: Simulation) -> None:
    assert drive(SCENARIO) == day
    assert drive(replace(SCENARIO, runs=1), seed=2).records[:5000] != day.records[:5000]


def test_other_sensors_do_not_change_the_driving(day: Simulation) -> None:
    assert drive(replace(SCENARIO, sensors=EXACT)).arrivals == day.arrivals


def test_the_load_changes_at_stops_and_the_mass_is_reported(day: Simulation) -> None:
    masses = [record.mass for record in of(MassRecord, day)]
    assert sum(before != after for before, after in pairwise(masses)) == 4
    assert 200e3 * 0.98 < min(masses) < max(masses) < 230e3 * 1.02


def test_all_phases_of_driving_occur(day: Simulation) -> None:
    force = np.array([record.force for record in of(ForceRecord, day)])
    brake = np.array([record.target_acceleration for record in of(BrakeRecord, day)])
    speed = np.array([record.speed for record in of(SpeedRecord, day)])
    moving = speed > 2.0
    coasting = moving & (np.abs(force) < 3e3) & (brake == 0.0)
    assert np.mean(force[moving] > 2e4) > 0.1
    assert np.mean(coasting[moving]) > 0.05
    assert np.mean(brake[moving] < -0.1) > 0.1
    assert brake.max() <= 0.0
    # The command has steps of 0.01 m/s^2 and respects the jerk limit of 0.8 m/s^3.
    assert np.abs(np.diff(brake)).max() <= 0.16 + 1e-9


class Balance(NamedTuple):
    """Residual of the specific balance with traction, curvature and speed, shapes (n,)."""

    residual: Floats
    traction: Floats
    curvature: Floats
    speed: Floats


def balance(simulation: Simulation, stated: TrainFile) -> Balance:
    """Evaluate the specific balance with the stated train file, without braking and at steady force."""
    speeds, forces, tracks = of(SpeedRecord, simulation), of(ForceRecord, simulation), of(GradientRecord, simulation)
    brakes, masses = of(BrakeRecord, simulation), [record.mass for record in of(MassRecord, simulation)]
    coefficient = effect_value(stated.effects, 'curve_resistance', 'coefficient', 0.0)
    rows, idle = [], 0
    for i in range(1, len(speeds) - 1):
        idle = 0 if brakes[i].target_acceleration < 0.0 else idle + 1
        force, mass = forces[i].force, masses[i // 5]
        if idle < 20 or abs(forces[i + 1].force - forces[i - 1].force) > 500.0 or speeds[i - 1].speed < 2.0:
            continue
        a = (speeds[i + 1].speed - speeds[i - 1].speed) / 0.4
        curvature = 1.0 / tracks[i].curve_radius if tracks[i].curve_radius > 0.0 else 0.0
        known = davis(stated.resistance, speeds[i].speed) + tracks[i].gradient + coefficient * curvature
        residual = specific_force(force, mass) - specific_inertia(a, stated.train.rotary_mass) - known
        rows.append((residual, specific_force(force, mass), curvature, speeds[i].speed))
    return Balance(*np.array(rows).T)


def test_a_fit_of_exact_records_recovers_the_true_resistance(quiet: Simulation) -> None:
    found = balance(quiet, FILE)
    v, w = found.speed, found.residual + davis(FILE.resistance, found.speed)
    design = np.stack([np.ones_like(v), v, v * v], axis=1)
    a, b, c = np.linalg.lstsq(design, w, rcond=None)[0]
    at = np.linspace(v.min(), v.max(), 20)
    error = (a - 1.5) + (b - 0.03) * at + (c - 0.004) * at**2
    # Central differences and the 20 ms between force and speed leave errors of a few 0.01 N/kN on slopes.
    assert len(v) > 300
    assert np.abs(error).max() < 0.05


def test_changes_are_applied_and_recorded_in_the_truth() -> None:
    changes = (Change(30.05, resistance=Davis(2.5, 0.03, 0.004)), Change(40.0, brake_rate=0.8))
    truth = drive(replace(SCENARIO, runs=1, changes=changes)).truth
    # Changes take effect at the next 5 Hz tick.
    assert truth.resistance == ((0.0, 1.5, 0.03, 0.004), (30.2, 2.5, 0.03, 0.004))
    assert truth.brake_rate == ((0.0, 1.0), (40.0, 0.8))
    assert truth.start_ns == SCENARIO.start_ns


def test_effects_on_resistance_and_brake_rate_are_part_of_the_truth() -> None:
    effects = Effect('resistance_step', (('time', 50.0), ('a', 0.5))), Effect('brake_scale', (('ratio', 0.9),))
    changes = (Change(60.0, resistance=Davis(2.0, 0.03, 0.004)),)
    truth = drive(replace(SCENARIO, runs=1, train_file=replace(FILE, effects=effects), changes=changes)).truth
    assert [row[:2] for row in truth.resistance] == [(0.0, 1.5), (50.0, 2.0), (60.0, 2.5)]
    assert truth.brake_rate == ((0.0, 0.9),)


def test_wheel_diameter_scales_the_measured_speed(quiet: Simulation) -> None:
    worn = replace(FILE, effects=(Effect('wheel_diameter', (('ratio', 1.02),)),))
    true = of(SpeedRecord, quiet)
    measured = of(SpeedRecord, drive(replace(QUIET, train_file=worn)))
    ratios = [m.speed / t.speed for m, t in zip(measured, true, strict=True) if t.speed > 0.0]
    assert ratios == pytest.approx([1.02] * len(ratios), rel=1e-12)


def test_the_driver_uses_the_stated_train(day: Simulation) -> None:
    assert drive(replace(SCENARIO, stated=FILE)) == day
    quick = replace(FILE, brake=replace(FILE.brake, delay=0.1))
    run = replace(SCENARIO, runs=1)
    first = [
        next(i for i, r in enumerate(of(BrakeRecord, drive(s))) if i > 200 and r.target_acceleration < 0.0)
        for s in (run, replace(run, stated=quick))
    ]
    assert first[1] > first[0]


@pytest.mark.parametrize(
    ('scenario', 'message'),
    [
        (replace(SCENARIO, runs=0), 'runs = 0 must be >= 1'),
        (replace(SCENARIO, start_ns=0), 'start_ns = 0 must be > 0'),
        (replace(SCENARIO, passengers=-0.1), 'passengers = -0.1'),
        (replace(SCENARIO, train_file=replace(FILE, line=Line(stops=(0.0,)))), 'line.stops has 1 stops'),
        (replace(SCENARIO, changes=(Change(5.0), Change(4.0))), 'their times must increase'),
        (replace(SCENARIO, changes=(Change(5.0, brake_rate=0.0),)), 'brake rate = 0 at 5 s'),
        (replace(SCENARIO, train_file=replace(FILE, effects=(Effect('x'),))), 'effect x is not known'),
        (replace(SCENARIO, sensors=SensorModel(dropout=2.0)), 'dropout = 2 '),
        (replace(SCENARIO, driver=DriverModel(jerk=0.0)), 'jerk = 0 '),
        (replace(SCENARIO, gust=GustModel(time_constant=0.0)), 'time_constant = 0 s'),
    ],
)
def test_an_invalid_scenario_is_named(scenario: Scenario, message: str) -> None:
    with pytest.raises(InputError) as caught:
        drive(scenario)
    assert message in str(caught.value)


def test_a_train_too_heavy_to_move_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('trainid_ros.sim.scenario.MAX_RUN_S', 60.0)
    with pytest.raises(InputError, match='does not reach stop 1500 m within 60 s: check'):
        drive(replace(SCENARIO, train_file=replace(FILE, train=Train(2e8))))


COUNT = 20_000
PULL = 60.0  # N/kN


def sensors(settings: dict[str, float] | None = None, seed: int = 1, **more: float) -> Sensors:
    model = replace(EXACT, **(settings or {}) | more)
    return Sensors(model, 0.2, (0.0, 20_000.0), np.random.default_rng(seed))


def speeds(device: Sensors, true: float = 10.0) -> np.ndarray:
    records = (device.speed(10**9, true, 0.0, PULL) for _ in range(COUNT))
    return np.array([record.speed for record in records if record])


def test_sensors_without_errors_report_true_values() -> None:
    device = sensors()
    assert device.speed(7, 10.0, 500.0, 1.0) == SpeedRecord(7, 10.0, 500.0)
    assert device.force(7, -3e4, 2e5) == ForceRecord(7, -3e4)
    assert device.weigh(2e5) == 2e5
    track = device.gradient(7, 4.0, 500.0, 1, radius=300.0, tunnel=True)
    assert track == GradientRecord(7, 4.0, 300.0, tunnel=True)
    assert sensors(force_delay=0.4).force(7 * 10**8, -3e4, 2e5) == ForceRecord(11 * 10**8, -3e4)


def test_speed_noise_and_quantum() -> None:
    # The std of 20 000 values is known to 0.5 %: 2 % is 4 sigma; the mean to 0.02 / 141.
    measured = speeds(sensors(speed_noise=0.02))
    assert measured.std() == pytest.approx(0.02, rel=0.02)
    assert measured.mean() == pytest.approx(10.0, abs=4 * 0.02 / math.sqrt(COUNT))
    assert speeds(sensors(speed_noise=1.0), true=0.1).min() == 0.0
    quantum = 0.1 / 3.6
    steps = speeds(sensors(speed_noise=0.1, speed_quantum=quantum)) / quantum
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert len(np.unique(np.round(steps))) > 10


def test_the_wheel_scales_speed_and_odometry_and_a_stationary_train_has_its_exact_position() -> None:
    worn, noisy = sensors(wheel_ratio=1.125), sensors(speed_noise=0.5, position_drift=5.0)
    for device in (worn, noisy):
        device.speed(1, 10.0, 0.0, 1.0)
    assert worn.speed(2, 10.0, 100.0, 1.0) == SpeedRecord(2, 11.25, 112.5)
    assert noisy.speed(2, 0.0, 40.0, 0.0) == SpeedRecord(2, 0.0, 40.0)


def test_odometry_drifts_as_a_random_walk() -> None:
    ends = []
    for seed in range(400):
        device = sensors(seed=seed, position_drift=0.03)
        for _ in range(25):
            record = device.speed(1, 10.0, 0.0, 1.0)
        assert record is not None
        ends.append(record.position)
    # 5 s give 0.03 sqrt(5); the std of 400 values is known to 3.5 %: 15 % is 4 sigma.
    assert np.std(ends) == pytest.approx(0.03 * math.sqrt(5.0), rel=0.15)


@pytest.mark.parametrize(
    ('settings', 'force', 'expected'),
    [
        ({'force_noise': 0.3}, 0.0, 0.3 * 2e5 * G / 1000.0),
        ({'force_noise_relative': 0.003}, -2e5, 600.0),
    ],
)
def test_force_noise(settings: dict[str, float], force: float, expected: float) -> None:
    device = sensors(settings)
    measured = np.array([record.force for _ in range(COUNT) if (record := device.force(1, force, 2e5))])
    assert measured.std() == pytest.approx(expected, rel=0.02)
    assert measured.mean() == pytest.approx(force, abs=4 * expected / math.sqrt(COUNT))


def test_the_map_error_is_correlated_over_its_length_and_changes_sign_with_the_direction() -> None:
    device = sensors(map_error=0.5)
    there, back = (device.gradient(1, 0.0, 1234.0, way, radius=0.0, tunnel=False) for way in (1, -1))
    assert there is not None
    assert back is not None
    assert there.gradient == -back.gradient != 0.0
    device = Sensors(replace(EXACT, map_error=0.5), 0.2, (0.0, 2e6), np.random.default_rng(5))
    errors = np.array([device.map_error(x) for x in np.arange(0.0, 2e6, 100.0)])
    # 2000 km contain about 5000 independent values of 400 m.
    assert errors.std() == pytest.approx(0.5, rel=0.05)
    assert float(np.corrcoef(errors[:-2], errors[2:])[0, 1]) == pytest.approx(math.exp(-1.0), abs=0.06)
    assert device.map_error(-50.0) == device.map_error(0.0)


def test_dropout_loses_the_given_share_of_messages() -> None:
    device = sensors(dropout=0.1)
    lost = sum(device.brake(1, -0.5) is None for _ in range(COUNT))
    # Binomial: std 42 of 20 000.
    assert lost == pytest.approx(0.1 * COUNT, abs=4 * 42)


def test_stamp_jitter_is_clipped() -> None:
    device = sensors(stamp_jitter=0.002)
    records = (device.force(10**9, 0.0, 2e5) for _ in range(COUNT))
    stamps = np.array([record.stamp_ns for record in records if record]) - 10**9
    # Clipping a normal at two standard deviations reduces its std by 4 % (0.9594).
    assert stamps.std() == pytest.approx(0.9594 * 2e6, rel=0.02)
    assert np.abs(stamps).max() == MAX_JITTER_NS


def test_slip_has_the_given_share_and_the_sign_of_the_force() -> None:
    error = speeds(sensors(slip_share=0.05, slip_speed=3.0)) - 10.0
    # 4000 s contain about 150 bursts: the share is known to 10 %.
    assert np.mean(error != 0.0) == pytest.approx(0.05, rel=0.4)
    assert error.min() >= 0.0
    assert 2.0 < error.max() <= 3.0


def test_slip_needs_a_force_and_its_share_refers_to_the_entire_time() -> None:
    device = sensors(slip_share=0.1, slip_speed=3.0, seed=31)
    # 10 s each of traction, coasting and braking.
    pulls = np.tile(np.repeat([PULL, 0.5, -PULL], 50), 400)
    records = (device.speed(1, 10.0, 0.0, float(pull)) for pull in pulls)
    error = np.array([record.speed for record in records if record]) - 10.0
    assert np.all(error[np.abs(pulls) < 1.0] == 0.0)
    assert np.all(error * pulls >= 0.0)
    # 12 000 s contain about 900 bursts: the share is known to 4 %.
    assert np.mean(error != 0.0) == pytest.approx(0.1, rel=0.15)
