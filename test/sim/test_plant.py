# SPDX-License-Identifier: Apache-2.0
"""The plant satisfies the specific balance, follows its brake actuator and never rolls back; its driver alone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.sim.plant import MAX_DELAY_S, STEP_NS, DelayLine, Driver, DriverModel, Gust, GustModel, Phase, Plant
from trainid_ros.train.forces import G, required_force, specific_force, specific_inertia
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile

DAVIS = Davis(1.5, 0.03, 0.004)
NO_RESISTANCE = Davis(0.0, 0.0, 0.0)
FILE = TrainFile(Train(200e3, 0.08, 100.0), DAVIS, Brake(0.9, 0.4, 0.6), Line(stops=(0.0, 9000.0)))
STEP_S = 0.02


def plant(file: TrainFile = FILE, *, speed: float = 0.0, jerk: float = 1e9) -> Plant:
    out = Plant(file, LineProfile(file.line, file.train.length), 10**9, jerk)
    out.speed = speed
    return out


def effects(name: str, **parameters: float) -> TrainFile:
    return replace(FILE, resistance=NO_RESISTANCE, effects=(Effect(name, tuple(parameters.items())),))


def braked(file: TrainFile, speed: float, command: float) -> Plant:
    train = plant(file, speed=speed)
    train.command(command)
    return train


def run(train: Plant, seconds: float, traction: float = 0.0) -> None:
    for _ in range(round(seconds / STEP_S)):
        train.step(traction)


def test_the_specific_balance_holds_over_a_step() -> None:
    file = replace(FILE, line=Line(stops=(0.0, 9000.0), gradient=((0.0, 5.0),)))
    train = plant(file, speed=15.0)
    train.gust = 0.2
    run(train, 0.1, 100e3)
    train.step(100e3)
    middle = train.speed - 0.5 * STEP_S * train.acceleration
    w = DAVIS.a + DAVIS.b * middle + DAVIS.c * middle**2
    seen = specific_force(train.reported_force, 200e3) - specific_inertia(train.acceleration, 0.08)
    assert seen == pytest.approx(w + 5.0 + 0.2, abs=1e-6)


def test_coasting_without_resistance_conserves_mechanical_energy() -> None:
    # Without a, b, c the balance conserves mechanical energy: (1 + gamma) v^2 / 2 + g h is constant.
    line = Line(stops=(0.0, 9000.0), gradient=((0.0, 0.0), (500.0, 8.0), (900.0, -12.0)))
    train = plant(replace(FILE, resistance=NO_RESISTANCE, line=line), speed=20.0)
    run(train, 60.0)
    profile = LineProfile(line, 100.0)
    # Mean height of the train: the integral of the length-averaged gradient, in 0.1 m steps.
    steps = round(train.position / 0.1)
    height = sum(profile.gradient((i + 0.5) * train.position / steps, 1) for i in range(steps))
    height *= train.position / steps / 1000.0
    energy = 0.54 * train.speed**2 + G * height
    # The error of the midpoint rule is about 1e-8 of the energy after 3000 steps.
    assert energy == pytest.approx(0.54 * 400.0, rel=1e-6)


def test_coasting_against_c_follows_the_closed_form() -> None:
    # dv/dt = -k v^2 has the solution v = v0 / (1 + k v0 t).
    train = plant(replace(FILE, resistance=Davis(0.0, 0.0, 0.02)), speed=20.0)
    run(train, 100.0)
    k = 0.02 * G / 1080.0
    assert train.speed == pytest.approx(20.0 / (1.0 + k * 20.0 * 100.0), rel=1e-7)
    assert train.position == pytest.approx(math.log(1.0 + k * 20.0 * 100.0) / k, rel=1e-7)


def test_the_air_drag_of_a_loaded_train_is_that_of_its_body() -> None:
    # As above, with the same force C v^2 on 1.3 times the mass.
    file = replace(FILE, resistance=Davis(0.0, 0.0, 0.02), train=replace(FILE.train, c_by_weight=1.0))
    train = plant(file, speed=20.0)
    train.mass *= 1.3
    run(train, 100.0)
    k = 0.02 / 1.3 * G / 1080.0
    assert train.speed == pytest.approx(20.0 / (1.0 + k * 20.0 * 100.0), rel=1e-7)


def test_delay_and_lag_of_the_brake_are_exact() -> None:
    train = braked(replace(FILE, resistance=NO_RESISTANCE), 20.0, -1.0)
    run(train, 0.6)
    assert train.speed == 20.0
    assert train.brake == 0.0
    run(train, 1.0)
    assert train.brake == pytest.approx(-(1.0 - math.exp(-1.0 / 0.4)), rel=1e-12)
    # The brake rate 0.9 multiplies the integral of the response, not the reported force.
    integral = 1.0 - 0.4 * (1.0 - math.exp(-1.0 / 0.4))
    assert train.speed == pytest.approx(20.0 - 0.9 * integral, rel=1e-12)
    assert train.reported_force == pytest.approx(1.08 * 200e3 * train.brake)
    between = braked(replace(FILE, brake=Brake(1.0, 0.4, 0.607)), 20.0, -1.0)  # the delay ends between two steps
    run(between, 1.6)
    assert between.brake == pytest.approx(-(1.0 - math.exp(-0.993 / 0.4)), rel=1e-12)


def test_the_work_of_the_traction_becomes_kinetic_energy_without_resistance() -> None:
    train = plant(replace(FILE, resistance=NO_RESISTANCE), jerk=0.8)
    run(train, 0.5, 180e3)
    assert train.traction == pytest.approx(0.8 * 200e3 * 0.5)  # limited by the jerk
    run(train, 8.8, 180e3)
    run(train, 3.0)
    assert train.traction == 0.0
    assert train.work == pytest.approx(0.5 * 1.08 * 200e3 * train.speed**2, rel=1e-9)


def test_a_braking_train_stops_and_remains_at_rest() -> None:
    train = braked(FILE, 3.0, -1.0)
    run(train, 10.0)
    stopped = train.position
    run(train, 5.0)
    assert (train.speed, train.position, train.now_ns) == (0.0, stopped, 16 * 10**9)


def test_a_train_does_not_roll_back_uphill_and_starts_with_sufficient_force() -> None:
    file = replace(FILE, line=Line(stops=(0.0, 9000.0), gradient=((0.0, 30.0),)))
    train = plant(file)
    holding = required_force(0.0, 200e3, 0.08, 30.0 + DAVIS.a)
    run(train, 2.0, 0.99 * holding)
    assert (train.speed, train.position) == (0.0, 0.0)
    run(train, 2.0, 1.01 * holding)
    assert train.speed > 0.0


@pytest.mark.parametrize(
    ('file', 'expected'),
    [(effects('mass_error', ratio=1.1), 100e3 / (1.1 * 216e3)), (effects('traction_scale', ratio=0.9), 90e3 / 216e3)],
)
def test_mass_and_traction_ratios_scale_the_acceleration(file: TrainFile, expected: float) -> None:
    train = plant(file)
    run(train, 1.0, 100e3)
    assert train.acceleration == pytest.approx(expected, rel=1e-9)
    assert train.reported_force == pytest.approx(100e3)


def test_brake_delay_delays_the_braking_but_not_the_reported_force() -> None:
    """The reported force is that of the assumed brake, so it is the same as without the effect."""
    nominal = braked(replace(FILE, resistance=NO_RESISTANCE), 20.0, -1.0)
    late = braked(effects('brake_delay', extra=0.4), 20.0, -1.0)
    for train in (nominal, late):
        run(train, 1.0)
    assert late.reported_force == nominal.reported_force < 0.0
    assert late.speed == pytest.approx(20.0, abs=1e-12)
    for train in (nominal, late):
        run(train, 1.0)
        train.command(-0.5)
    before = nominal.speed
    run(late, 0.4)
    # The same braking 0.4 s later.
    assert late.speed == pytest.approx(before, abs=1e-12)
    for train in (nominal, late):
        run(train, 2.0)
    assert late.speed == pytest.approx(nominal.speed, abs=1e-12)


def test_a_shifted_map_reports_a_hill_too_early() -> None:
    line = Line(stops=(0.0, 9000.0), gradient=((0.0, 0.0), (1000.0, 20.0)))
    train = plant(replace(effects('map_shift', distance=50.0), line=line), speed=20.0)
    train.position = 1040.0
    run(train, 0.1)
    assert train.speed == 20.0
    run(train, 0.5)
    assert train.speed < 20.0
    assert LineProfile(line, 100.0).gradient(1040.0, 1) == pytest.approx(8.0)


def test_a_hot_brake_fades_by_its_loss() -> None:
    train = braked(effects('brake_fade', loss=0.3, energy=50.0), 22.0, -1.0)
    run(train, 14.0)
    # 22 m/s is 242 J/kg; most of it is in the brake by now, so the fade has reached its full 30 %.
    assert train.acceleration == pytest.approx(-0.9 * 0.7, rel=1e-6)


def test_a_released_brake_drags_for_its_time() -> None:
    train = braked(effects('dragging_brake', permille=3.0, time=5.0), 20.0, -0.5)
    run(train, 2.0)
    train.command(0.0)
    run(train, 4.0)
    assert train.acceleration == pytest.approx(-3.0 * G / 1080.0, rel=0.01)  # the lag has nearly settled
    run(train, 8.0)
    assert train.acceleration == pytest.approx(0.0, abs=1e-6)


def test_the_brake_follows_its_table_over_speed() -> None:
    table = ((0.0, 1.1), (20.0, 0.9))
    train = braked(replace(FILE, resistance=NO_RESISTANCE, brake=Brake(0.9, 0.4, 0.6, table)), 18.0, -0.5)
    run(train, 8.0)
    before = train.speed
    train.step(0.0)
    assert train.acceleration == pytest.approx(-0.5 * 0.9 * (1.1 - 0.01 * before), rel=1e-3)


def test_a_history_is_interpolated_between_steps_zero_before_the_first_and_bounded() -> None:
    recent = DelayLine()
    assert recent.before(0.0) == 0.0
    recent.add(1, 5.0)
    assert (recent.before(0.0), recent.before(-1.0), recent.before(1e-6)) == (5.0, 5.0, 0.0)
    recent = DelayLine()
    for k in range(5000):
        recent.add(10**9 + k * STEP_NS, math.sin(0.02 * k))
        for seconds in (0.0, 0.013, 0.4, MAX_DELAY_S):
            if k * 0.02 >= seconds:
                assert recent.before(seconds) == pytest.approx(math.sin(0.02 * k - seconds), abs=1e-4)
    assert len(recent._stamps) <= 2 * MAX_DELAY_S / 0.02 + 2


def test_gust_has_its_std_and_its_correlation_time() -> None:
    gust = Gust(GustModel(std=0.1, time_constant=5.0), 0.2, np.random.default_rng(3))
    path = np.array([gust.step() for _ in range(100_000)])
    # 20 000 s hold about 2000 independent values of 10 s: the std is known to 1.6 %, so 6 % is 4 sigma.
    assert path.std() == pytest.approx(0.1, rel=0.06)
    correlation = float(np.corrcoef(path[:-25], path[25:])[0, 1])
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.08)


DRIVEN = TrainFile(Train(200e3), Davis(1.5, 0.03, 0.004), Brake(), Line(stops=(0.0, 2000.0)))
DRIVEN_LINE = LineProfile(DRIVEN.line, DRIVEN.train.length)


def driven(speed: float = 0.0, position: float = 0.0, **settings: float) -> tuple[Driver, Plant]:
    """Return a driver on the way to 2000 m, and its train."""
    ato = Driver(replace(DriverModel(), **settings), DRIVEN, DRIVEN_LINE, np.random.default_rng(1))
    train = Plant(DRIVEN, DRIVEN_LINE, 1, 0.8)
    if position:
        ato.depart(2000.0)
    train.speed, train.position = speed, position
    return ato, train


def test_the_train_is_held_until_the_dwell_is_over() -> None:
    ato, train = driven(dwell_low=20.0, dwell_high=20.0)
    decision = ato.decide(0.0, train)
    assert (decision.traction, decision.brake) == (0.0, -0.6)
    assert not ato.may_depart(9.9)
    assert ato.may_depart(10.0)


def test_traction_stays_within_force_and_power() -> None:
    ato, train = driven(18.0, 300.0)
    decision = ato.decide(20.0, train)
    assert ato.phase is Phase.POWER
    assert decision.traction == pytest.approx(3.1e6 / 18.0)
    train.speed = 1.0
    # At low speed 0.9 m/s^2 on 216 t and the resistance need less than the available 310 kN.
    assert ato.decide(20.2, train).traction == pytest.approx(0.9 * 216e3 + 1.534 * 200 * 9.80665)


@pytest.mark.parametrize(
    ('speed', 'position', 'window', 'phase'),
    [
        # Braking from 15 m/s at 0.65 m/s^2 takes 173 m, plus 15 m for dead time and lag.
        (15.0, 1800.0, 1.0, Phase.POWER),
        (15.0, 1820.0, 1.0, Phase.BRAKE),
        # A stationary train within the stop window has arrived.
        (0.0, 1997.0, 1.0, Phase.POWER),
        (0.0, 1997.0, 4.0, Phase.DWELL),
    ],
)
def test_the_phase_before_a_stop(speed: float, position: float, window: float, phase: Phase) -> None:
    ato, train = driven(speed, position, stop_window=window)
    ato.decide(100.0, train)
    assert ato.phase is phase
