# SPDX-License-Identifier: Apache-2.0
"""The drive history against a simulated train, whose state is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.interface.state import encode, restore
from trainid_ros.sim.plant import Plant
from trainid_ros.stream.sample_stream import DriveHistory
from trainid_ros.stream.samples import NO_HISTORY, Motion, Sample
from trainid_ros.train.effects import BRAKE_APPLIED
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.line import LineProfile
from trainid_ros.train.train_file import Line, TrainFile

Make = Callable[..., Sample]
START = 1_700_000_000 * 10**9
BRAKING = {0: 0.0, 40: -0.3, 55: -0.9, 90: -0.2, 120: 0.0, 200: -0.6, 230: 0.0}


def test_time_distance_heat_and_brake_are_those_of_the_train(train_file: TrainFile, sample: Make) -> None:
    file = replace(train_file, line=Line(stops=(0.0, 1e5)))
    train = Plant(file, LineProfile(file.line, 100.0), START, 1.0)
    train.speed = 22.0
    tracker = DriveHistory(file)
    released = math.inf
    for i in range(300):
        changes: tuple[BrakeCommandChange, ...] = ()
        if i in BRAKING:
            train.command(BRAKING[i])
            changes = (BrakeCommandChange(train.now_ns, BRAKING[i]),)
        released = 0.0 if train.brake < BRAKE_APPLIED else released + 0.2
        motion = tracker.follow(sample(i, speed=train.speed, brake_changes=changes))
        assert motion.time_s == pytest.approx(0.2 * i)
        assert motion.distance_run == pytest.approx(train.distance_run, abs=0.2)
        assert motion.heat == pytest.approx(train.heat, rel=0.01, abs=0.02)
        assert motion.brake == pytest.approx(train.brake, abs=1e-9)
        assert motion.since_release == pytest.approx(released, abs=0.25)
        for _ in range(10):
            train.step(0.0)
    assert train.heat > 100.0


def test_a_train_that_stands_at_first_was_held_by_its_brake(train_file: TrainFile, sample: Make) -> None:
    moving, standing = (DriveHistory(train_file) for _ in range(2))
    assert math.isinf(moving.follow(sample(0, speed=5.0)).since_release)
    assert standing.follow(sample(0, speed=0.0, force=0.0)).since_release == 0.0
    assert standing.follow(sample(1, speed=0.0, force=0.0)).since_release == pytest.approx(0.2)
    held = DriveHistory(train_file)
    assert held.follow(sample(0, speed=0.0, force=-0.4 * train_file.train.mass)).brake < BRAKE_APPLIED


def test_a_restored_state_continues_to_the_bit(train_file: TrainFile, sample: Make) -> None:
    first, second = DriveHistory(train_file), DriveHistory(train_file)
    for i in range(20):
        first.follow(sample(i, brake_changes=(BrakeCommandChange(START + i * 10**8, -0.01 * i),)))
    restore(second, encode(first))
    for i in range(20, 30):
        assert first.follow(sample(i)) == second.follow(sample(i))
    assert encode(first) == encode(second)


def test_a_night_in_the_depot_cools_the_brake_and_adds_no_distance(train_file: TrainFile, sample: Make) -> None:
    tracker = DriveHistory(train_file)
    for i in range(50):
        tracker.follow(sample(i, brake_changes=(BrakeCommandChange(START, -0.5),) if i == 0 else ()))
    before = tracker.motion
    assert before.heat > 10.0
    tracker.follow(sample(50, brake_changes=(BrakeCommandChange(START + 50 * 10**9 // 5, 0.0),)))
    after = tracker.follow(sample(5 * 36_000))
    assert after.distance_run == pytest.approx(before.distance_run + 3.0, abs=1e-6)
    assert after.time_s == pytest.approx(36_000.0)
    assert after.heat == pytest.approx(0.0, abs=1e-6)


def test_another_time_base_keeps_the_motion_and_forgets_commands(train_file: TrainFile, sample: Make) -> None:
    tracker = DriveHistory(train_file)
    for i in range(100, 110):
        tracker.follow(sample(i, brake_changes=(BrakeCommandChange(START + i * 2 * 10**8, -0.5),)))
    before = tracker.motion
    after = tracker.follow(sample(3))
    assert (after.time_s, after.distance_run, after.heat) == (before.time_s, before.distance_run, before.heat)
    assert not tracker._actuator.commands.changes
    tracker.reset()
    assert tracker.follow(sample(4)) == Motion(time_s=0.0, distance_run=0.0, run=1)


def test_without_drive_history_effects_have_set_in_and_bearings_are_warm(sample: Make) -> None:
    assert sample(0).motion is NO_HISTORY
    assert (NO_HISTORY.time_s, NO_HISTORY.distance_run, NO_HISTORY.heat) == (math.inf, math.inf, 0.0)
