# SPDX-License-Identifier: Apache-2.0
"""A brake that acts later or sooner than the train file says."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.stream.brake_checks import BrakeDelayCheck, BrakeTiming
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange, lag_integral, lag_response
from trainid_ros.train.train_file import Brake, TrainFile

Make = Callable[..., Sample]

INERTIA = 110.0
DT = 0.2
# One braking each 100 s: command [m/s^2] and duration [s] of its steps.
STEPS = ((-0.4, 5.0), (-0.9, 12.0), (-0.5, 8.0))
PERIOD = 500
FIRST = 200


def command_at(index: int) -> float:
    within = (index % PERIOD - FIRST) * DT
    for command, duration in STEPS:
        if 0.0 <= within < duration:
            return command
        within -= duration
    return 0.0


def drive(sample: Make, brake: Brake, shift: float, brakings: int) -> Iterable[tuple[Sample, float]]:
    """Yield samples and the force of a brake that acts later by a shift [s], which brakes 0.8 times as much."""
    rng, before, lagged = np.random.default_rng(7), 0.0, 0.0
    late = round((brake.delay + shift) / DT)
    noise = INERTIA * rng.normal(0.0, 0.03, brakings * PERIOD + 1)
    for k in range(1, brakings * PERIOD + 1):
        target = 0.8 * command_at(k - 1 - late) if k > late else 0.0
        force = INERTIA * lag_integral(lagged, target, brake.time_constant, DT) + noise[k] - noise[k - 1]
        lagged = lag_response(lagged, target, brake.time_constant, DT)
        command = command_at(k)
        item = sample(k, brake_command=command)
        changes = (BrakeCommandChange(item.stamp_ns, command),) if command != before else ()
        before = command
        yield replace(item, brake_changes=changes), float(force)


def checked(train_file: TrainFile, items: Iterable[tuple[Sample, float]]) -> BrakeDelayCheck:
    check, timing = BrakeDelayCheck(), BrakeTiming(train_file)
    for item, force in items:
        check.follow(item, force, force / item.dt, INERTIA, timing)
    return check


@pytest.fixture
def file(train_file: TrainFile) -> TrainFile:
    return replace(train_file, brake=Brake(delay=3.0, time_constant=0.6))


@pytest.mark.parametrize('shift', [-2.4, -0.6, 0.0, 0.6, 1.4, 3.0, 7.0])
def test_the_shift_is_learned_and_named_where_it_matters(file: TrainFile, sample: Make, shift: float) -> None:
    check = checked(file, drive(sample, file.brake, shift, 4))
    assert check.count == pytest.approx(1.0 + 0.9 + 0.81 + 0.729)
    assert check.mean == pytest.approx(shift, abs=min(0.15, 3.0 * check.std))
    assert check.is_trusted == (abs(shift) < BrakeTiming(file).tolerance)
    sense = f'{abs(check.mean):.1f} s {"later" if shift > 0.0 else "sooner"}'
    assert check.warning == (
        f'the brake acts {sense} than brake.delay of the train file says' if check.is_wrong else ''
    )


def test_the_first_braking_contradicts_a_dead_time_before_it_is_over(file: TrainFile, sample: Make) -> None:
    start = FIRST + round(13.0 / DT)
    items = list(drive(sample, file.brake, 2.5, 1))
    check = checked(file, items[:start])
    assert check.is_odd
    assert not check.is_trusted
    assert check.warning == ''  # one braking that has not ended is no proof


@pytest.mark.parametrize('shift', [-1.2, 1.2, 2.5])
def test_no_moment_of_the_first_braking_is_trusted_with_a_wrong_dead_time(
    file: TrainFile, sample: Make, shift: float
) -> None:
    check, timing = BrakeDelayCheck(), BrakeTiming(file)
    for item, force in drive(sample, file.brake, shift, 1):
        check.follow(item, force, force / item.dt, INERTIA, timing)
        assert not check.is_trusted


def test_nothing_is_trusted_before_the_train_was_braked_for_some_seconds(file: TrainFile, sample: Make) -> None:
    items = list(drive(sample, file.brake, 0.0, 1))
    trusted = [checked(file, items[: FIRST + round(seconds / DT)]).is_trusted for seconds in (0.0, 4.0, 6.0)]
    assert trusted == [False, False, True]


def test_a_train_whose_brakings_cannot_be_compared_is_trusted(file: TrainFile, sample: Make) -> None:
    items = drive(sample, file.brake, 0.0, 1)
    check = checked(file, [(replace(item, brake_gap=bool(item.brake_changes)), force) for item, force in items])
    assert check.count == 0.0
    assert check.is_trusted


def test_a_stated_uncertainty_is_allowed_for(file: TrainFile, sample: Make) -> None:
    unsure = replace(file, brake=replace(file.brake, timing_std=0.5))
    assert BrakeTiming(unsure).tolerance > 1.4 > BrakeTiming(file).tolerance
    assert checked(unsure, drive(sample, file.brake, 1.4, 4)).warning == ''


def test_commands_to_a_standing_train_tell_nothing(file: TrainFile, sample: Make) -> None:
    standing = [(item, math.nan) for item, _ in drive(sample, file.brake, 2.5, 3)]
    check = checked(file, standing)
    assert (check.count, check.is_odd, check.has_braked) == (0.0, False, False)


@pytest.mark.parametrize(
    'gap', [{'dt': math.nan}, {'brake_gap': True}, {'emergency': True}, {'brake_command': math.nan}]
)
def test_a_braking_with_a_gap_ends_there_and_the_next_counts(
    file: TrainFile, sample: Make, gap: dict[str, object]
) -> None:
    items = list(drive(sample, file.brake, 0.0, 2))
    item, force = items[FIRST + 10]  # too early for the first braking to show anything
    items[FIRST + 10] = (replace(item, **gap), force)  # type: ignore[arg-type]
    check = checked(file, items)
    assert check.count == 1.0
    assert abs(check.mean) < 0.2


def test_the_history_is_bounded_however_long_a_braking_lasts(file: TrainFile, sample: Make) -> None:
    timing, check = BrakeTiming(file), BrakeDelayCheck()
    for k in range(5000):
        changes = (BrakeCommandChange(sample(k).stamp_ns, -0.5),) if k == 100 else ()
        item = sample(k, brake_command=-0.5 if k >= 100 else 0.0, brake_changes=changes)
        check.follow(item, -INERTIA * 0.1, 0.0, INERTIA, timing)
    assert check.is_observing
    assert len(check.lag.history) < 2 * 80


def test_a_brake_that_acts_later_than_the_grid_is_named_too(file: TrainFile, sample: Make) -> None:
    check = checked(file, drive(sample, file.brake, 12.0, 4))
    assert check.warning.startswith('the brake acts at least ')
