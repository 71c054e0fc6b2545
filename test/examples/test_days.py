# SPDX-License-Identifier: Apache-2.0
"""Random days, driven with different knowledge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ato import days
from ato.days import DayPlan, Drive, RideScore, drive_day, plan_day
from ato.knowledge import StopBias
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, ForceRecord, SpeedRecord
from trainid_ros.sim.plant import Plant, StopEvent
from trainid_ros.sim.scenario import Simulation, simulate
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Line, Train, TrainFile

TICK_STEPS = 10


def driven(controller: str, seed: int = 3, runs: int = 4) -> Drive:
    return drive_day(plan_day('tram', runs, np.random.default_rng(seed)), controller, seed)


def test_the_same_seed_gives_the_same_day() -> None:
    plan, other = (plan_day('metro', 4, np.random.default_rng(5)) for _ in range(2))
    assert plan == other
    assert plan != plan_day('metro', 4, np.random.default_rng(6))
    assert driven('live', runs=2) == driven('live', runs=2)


@pytest.fixture(scope='module')
def metro_days() -> list[DayPlan]:
    return [plan_day('metro', 26, np.random.default_rng(seed)) for seed in range(40)]


def test_sudden_changes_of_the_brake_are_in_the_scenario(metro_days: list[DayPlan]) -> None:
    assert 10 <= sum(len(plan.events_s) for plan in metro_days) <= 45
    for plan in metro_days:
        changes = plan.case.scenario.changes
        rates = [change.brake_rate for change in changes]
        assert all(rate is not None and 0.5 < rate < 1.15 for rate in rates)
        assert set(plan.events_s) <= {change.time_s for change in changes}


def test_brakes_wear_by_up_to_eight_percent(metro_days: list[DayPlan]) -> None:
    worn = []
    for plan in metro_days:
        if not plan.events_s:
            rates = rates_of(plan)
            assert (np.diff(rates) < 0.0).all()
            worn.append(1.0 - rates[-1] / rates[0])
    assert len(worn) > 5
    assert max(worn) < 0.08
    assert np.mean(worn) == pytest.approx(0.04, abs=0.02)


def test_an_isolated_brake_unit_takes_its_share_and_rain_wets_the_track(metro_days: list[DayPlan]) -> None:
    isolated: list[float] = []
    rainy: list[float] = []
    for plan in metro_days:
        changes, rates = plan.case.scenario.changes, rates_of(plan)
        for k in range(1, len(changes)):
            if changes[k].time_s in plan.events_s:
                rains = changes[k].resistance is not None and changes[k - 1].resistance is None
                (rainy if rains else isolated).append(rates[k] / rates[k - 1])
    assert min(len(isolated), len(rainy)) > 5
    cars = metro_days[0].case.stated.train.cars
    # Beside the event, the brake has worn since the change before.
    assert isolated == pytest.approx([1.0 - 1.0 / cars] * len(isolated), rel=0.005)
    assert all(0.84 < ratio < 0.95 for ratio in rainy)


def rates_of(plan: DayPlan) -> np.ndarray:
    return np.array([change.brake_rate for change in plan.case.scenario.changes])


def test_only_the_train_itself_has_a_rate_over_speed_that_is_not_stated() -> None:
    plain, shaped = (plan_day('metro', 4, np.random.default_rng(7), shaped=shaped) for shaped in (False, True))
    assert shaped.case.stated == plain.case.stated
    assert shaped.events_s == plain.events_s
    tables = [
        plan_day('emu', 2, np.random.default_rng(seed), shaped=True).case.scenario.train_file.brake.rate_table
        for seed in range(100)
    ]
    rates = np.array([[rate for _, rate in table] for table in tables])
    assert np.std(rates[:, -1] - rates[:, 0]) == pytest.approx(0.08, rel=0.2)
    assert np.std(rates[:, 1] - 0.5 * (rates[:, 0] + rates[:, 2])) == pytest.approx(0.06, rel=0.2)
    assert np.allclose(rates[:, 0] + rates[:, -1], 2.0)


@pytest.mark.parametrize(
    ('world', 'controller', 'error'),
    [('maglev', 'live', 'maglev'), ('tram', 'lvie', "'lvie' is not known; did you mean 'live'")],
)
def test_an_unknown_world_or_controller_is_named(world: str, controller: str, error: str) -> None:
    with pytest.raises(InputError, match=error):
        drive_day(plan_day(world, 2, np.random.default_rng(1)), controller, 1)


def test_a_drive_is_scored() -> None:
    drive = driven('truth')
    assert drive.errors.shape == (4,)
    assert 1.0 < drive.energy_kwh < 50.0
    # The quantile is that of the standstills, where the deceleration ends within a tick of 0.2 s.
    assert 0.05 < drive.jerk < 0.9 * drive.final_deceleration / 0.2 < drive.jerk_p999 < 7.0
    assert 0.5 < drive.final_deceleration < 1.2
    # Under traction the controller stays below the curves by up to its margin of 0.8 m/s.
    assert 0.05 < drive.tracking < 1.6
    assert drive.bounds == ()
    begins, ends = drive.brakings_s, [arrival.time_s for arrival in drive.arrivals]
    assert len(begins) == 4
    assert all(5.0 < end - begin < 60.0 for begin, end in zip(begins, ends, strict=True))


def test_energy_is_the_work_of_the_recorded_force(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Simulation] = []

    def keep(*arguments: object) -> Simulation:
        kept.append(simulate(*arguments))  # type: ignore[arg-type]
        return kept[-1]

    monkeypatch.setattr(days, 'simulate', keep)
    drive = driven('truth')
    records = kept[0].records
    speeds = [record for record in records if isinstance(record, SpeedRecord)]
    forces = [record for record in records if isinstance(record, ForceRecord)]
    at = np.array([record.stamp_ns for record in speeds]) / NS_PER_S
    force = np.interp(at, [f.stamp_ns / NS_PER_S for f in forces], [max(0.0, f.force) for f in forces])
    work = np.trapezoid(force * [record.speed for record in speeds], at)
    # Force and speed are measured with errors of some per cent and a delay.
    assert drive.energy_kwh == pytest.approx(work / 3.6e6, rel=0.1)


def test_a_braking_with_a_sudden_change_is_a_surprise() -> None:
    plan = plan_day('metro', 4, np.random.default_rng(5))
    plan = replace(plan, events_s=(95.0, 210.0, 300.0))
    drive = drive_of((80.0, 100.0), (180.0, 200.0), (280.0, 300.0), (380.0, 400.0))
    assert plan.surprised(drive) == (True, False, True, False)
    assert [plan.changes(*span) for span in ((94.0, 95.0), (95.0, 209.0), (209.0, 211.0))] == [True, False, True]


def drive_of(*brakings: tuple[float, float]) -> Drive:
    """A drive with brakings from and to times [s]."""
    arrivals = tuple(StopEvent(end_s, 100.0 * k, 0.1) for k, (_, end_s) in enumerate(brakings))
    begins = tuple(begin_s for begin_s, _ in brakings)
    return Drive(arrivals, begins, 400.0, 12.0, 0.1, 1.0, 0.6, 0.0, 0.5, ())


def test_the_peers_differ_in_what_they_learn_and_in_their_integral_action() -> None:
    drives = {name: driven(name, runs=2) for name in ('nominal', 'fast', 'rate', 'rate_fast')}
    errors = {name: tuple(drive.errors) for name, drive in drives.items()}
    assert len(set(errors.values())) == 4
    # Nothing is learned before the first stop.
    assert errors['rate_fast'][0] == errors['fast'][0] != errors['rate'][0]
    assert errors['rate'][0] == errors['nominal'][0]


def test_only_learning_takes_in_the_errors_of_its_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    learned: list[float] = []

    class Noted(StopBias):
        def learn(self, error: float) -> None:
            learned.append(error)
            super().learn(error)

    monkeypatch.setattr(days, 'StopBias', Noted)
    fast = driven('fast', seed=11)
    assert learned == []
    learning = driven('learning', seed=11)
    assert learned == learning.errors.tolist()
    assert learning.errors[0] == fast.errors[0]
    assert learning.errors[1] != fast.errors[1]


@pytest.mark.parametrize('aim', [-2.0, 2.0])
def test_the_train_stops_where_the_bias_aims(monkeypatch: pytest.MonkeyPatch, aim: float) -> None:
    monkeypatch.setattr(days, 'StopBias', lambda: StopBias(aim))
    assert driven('truth').errors == pytest.approx([aim] * 4, abs=0.5)


@pytest.mark.parametrize(('world', 'seed'), [('metro', 1), ('tram', 2)])
def test_limits_are_kept_with_a_brake_that_takes_time(world: str, seed: int) -> None:
    assert drive_day(plan_day(world, 4, np.random.default_rng(seed)), 'truth', seed).overspeed < 0.1


@pytest.mark.slow
def test_live_estimates_stop_the_train_better() -> None:
    drives = {name: [driven(name, seed) for seed in (3, 4)] for name in ('nominal', 'live')}
    nominal, live = (np.abs(np.concatenate([drive.errors for drive in some])) for some in drives.values())
    assert np.quantile(live, 0.95) < 0.5 * np.quantile(nominal, 0.95)
    rows = drives['live'][1].bounds
    assert len(rows) == 4
    assert all(0.8 * row.bound < row.distance < 1.2 * row.bound for row in rows)


@pytest.mark.slow
def test_bounds_are_live_once_the_estimates_are() -> None:
    rows = drive_day(plan_day('metro', 3, np.random.default_rng(4)), 'live', 4).bounds
    assert not rows[0].is_live
    assert rows[-1].is_live


def plant_of(*limits: tuple[float, float]) -> Plant:
    train = Train(mass=200e3, length=100.0)
    file = TrainFile(train, Davis(2.0, 0.0, 0.004), Brake(1.0, 0.4, 0.6), Line(stops=(0.0, 3000.0), speed_limit=limits))
    return Plant(file, LineProfile(file.line, train.length), NS_PER_S, 0.8)


def braked_to_rest(speed: float, command: float) -> tuple[Plant, RideScore]:
    plant, score = plant_of(), RideScore()
    plant.speed = speed
    plant.command(command)
    while plant.speed > 0.0:
        score.add(plant, None)
        for _ in range(TICK_STEPS):
            plant.step(0.0)
    score.add(plant, None)
    return plant, score


# The standstill is somewhere in a tick; at one of these speeds it is in its last step.
@pytest.mark.parametrize('speed', np.arange(9.0, 9.17, 0.015).tolist())
def test_the_jolt_at_standstill_counts(speed: float) -> None:
    _, score = braked_to_rest(speed, -0.8)
    # Beside the brake, the resistance of 2 N/kN decelerates.
    assert score.final_decelerations == [pytest.approx(0.82, abs=0.01)]
    assert score.jerks[-1] == pytest.approx(0.82 / 0.2, abs=0.05)


def test_overspeed_counts_where_the_limit_begins() -> None:
    plant, score = plant_of((0.0, 20.0), (151.0, 10.0)), RideScore()
    plant.position, plant.speed = 150.0, 12.0
    plant._actuator.output = -1.0
    plant.command(-1.0)
    score.skip(plant)
    at = 0.0
    for _ in range(TICK_STEPS):
        before = plant.speed
        plant.step(0.0)
        at = before if not at and plant.position > 151.0 else at
    score.add(plant, None)
    assert plant.speed < 11.9
    assert score.overspeed == pytest.approx(at - 10.0, abs=0.03)
    assert score.overspeed > plant.speed - 10.0 + 0.05


def test_only_counted_ticks_are_scored() -> None:
    plant, score = plant_of(), RideScore()
    plant.speed = 5.0
    score.skip(plant)
    assert (score.jerks, score.speed_errors) == ([], [])
    score.add(plant, 5.5)
    assert score.jerks == [0.0]
    assert score.speed_errors == [-0.5]
