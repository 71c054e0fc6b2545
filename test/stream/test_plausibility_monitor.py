# SPDX-License-Identifier: Apache-2.0
"""The monitor sample by sample: brake command, standstill, and gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest

from trainid_ros.interface.results import Rejection
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.plausibility import PlausibilityMonitor
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Line, TrainFile

Make = Callable[..., Sample]
Journey = Callable[..., list[Sample]]


def scaled(samples: Sequence[Sample], factor: float) -> list[Sample]:
    """Return samples with another brake command."""
    return [
        replace(
            sample,
            brake_command=factor * sample.brake_command,
            brake_changes=tuple(
                BrakeCommandChange(change.stamp_ns, factor * change.target_acceleration)
                for change in sample.brake_changes
            ),
        )
        for sample in samples
    ]


def followed(monitor: PlausibilityMonitor, samples: Sequence[Sample]) -> list[Rejection | None]:
    return [monitor.follow(sample) for sample in samples]


def pulses(t: float) -> float:
    """Return a command [m/s^2] whose brakings are too short to be steady, one in ten seconds."""
    return -0.6 if t % 10.0 < 0.8 else -0.3 if t % 10.0 < 1.6 else 0.0


def test_a_command_that_is_half_is_suspected_in_the_first_second_of_braking_and_what_was_learned_is_undone(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(100.0, brake=pulses, traction=lambda t: 20.0 * (t % 10.0 > 4.0), noise=0.0)
    monitor = PlausibilityMonitor(KnownForce(train_file))
    followed(monitor, samples[:300])
    assert not monitor.has_changed
    suspected: list[bool] = []
    for sample in scaled(samples[300:310], 0.5):
        monitor.follow(sample)
        suspected.append(monitor.has_changed)
    assert suspected.index(True) <= 8
    assert not monitor.is_trusted
    braking = journey(12.0, brake=lambda t: -0.5 if t > 1.0 else 0.0, noise=0.0)
    followed(monitor, braking)
    assert not monitor.has_changed
    assert monitor.was_false_alarm


def test_a_command_that_is_double_is_suspected_after_one_short_braking_until_another_fits(
    train_file: TrainFile, journey: Journey
) -> None:
    def brake(t: float) -> float:
        return -0.6 if 10.0 < t % 40.0 < 12.0 else 0.0

    samples = journey(80.0, brake=brake, traction=lambda t: 20.0 * (t % 40.0 < 8.0), noise=0.0)
    monitor = PlausibilityMonitor(KnownForce(train_file))
    followed(monitor, scaled(samples[:110], 2.0))  # until the braking has certainly ended
    assert monitor.has_changed
    assert not monitor.is_trusted
    followed(monitor, samples[110:])
    assert not monitor.has_changed
    assert monitor.was_false_alarm


def test_a_weak_command_after_a_strong_one_is_no_contradiction(train_file: TrainFile, journey: Journey) -> None:
    def brake(t: float) -> float:
        return 0.0 if t % 20.0 < 14.0 else -1.0 if t % 20.0 < 17.0 else -0.05

    monitor = PlausibilityMonitor(KnownForce(train_file))
    for sample in journey(100.0, brake=brake, traction=lambda t: 35.0 * (t % 20.0 < 13.0), noise=0.0):
        monitor.follow(sample)
        assert not monitor.has_changed


def test_after_commands_that_were_not_seen_the_force_may_be_that_of_a_stronger_one(
    train_file: TrainFile, journey: Journey
) -> None:
    samples = journey(20.0, brake=lambda t: -1.0 if t > 5.0 else 0.0, noise=0.0)
    seen, unseen = PlausibilityMonitor(KnownForce(train_file)), PlausibilityMonitor(KnownForce(train_file))
    for sample in scaled(samples[:35], 0.1):
        seen.follow(sample)
        unseen.follow(replace(sample, brake_gap=True))
    assert seen.has_changed
    assert not unseen.has_changed


@pytest.mark.parametrize(('step', 'steady'), [(0.0, True), (0.04, True), (0.1, False)])
def test_a_command_is_steady_until_it_has_changed_by_a_tenth(
    train_file: TrainFile, sample: Make, step: float, steady: bool
) -> None:
    monitor = PlausibilityMonitor(KnownForce(train_file))
    for k in range(50):
        target = -0.6 - (step if k >= 25 else 0.0)
        changes = (BrakeCommandChange(k + 1, target),) if k in (0, 25) else ()
        monitor.follow(sample(k, brake_command=target, brake_changes=changes))
    assert monitor.state.steady_s == pytest.approx(0.2 * (49 if steady else 24))


def test_a_command_that_changes_slowly_is_not_steady(train_file: TrainFile, sample: Make) -> None:
    monitor, longest = PlausibilityMonitor(KnownForce(train_file)), 0.0
    for k in range(100):
        target = -0.2 - 0.01 * k
        monitor.follow(sample(k, brake_command=target, brake_changes=(BrakeCommandChange(k + 1, target),)))
        longest = max(longest, monitor.state.steady_s)
    assert longest < 3.0


@pytest.mark.parametrize(('command', 'rejected'), [(-0.6, True), (0.0, False)])
def test_a_speed_that_rises_from_a_standstill_under_the_brake_is_rejected(
    train_file: TrainFile, sample: Make, command: float, rejected: bool
) -> None:
    changes = (BrakeCommandChange(1, command),)
    stopped = [sample(k, speed=0.0, brake_command=command, brake_changes=changes if k == 0 else ()) for k in range(50)]
    drifting = [sample(50 + k, speed=0.01 * k, brake_command=command) for k in range(80)]
    found = followed(PlausibilityMonitor(KnownForce(train_file)), [*stopped, *drifting])
    assert not any(found[:70])
    assert any(found[70:100]) is rejected


@pytest.mark.parametrize('width', [1, 3])
def test_gradients_within_a_spike_are_not_compared_with_the_line(
    train_file: TrainFile, sample: Make, width: int
) -> None:
    level = replace(train_file, line=Line(gradient=((0.0, 0.0), (1e5, 0.0)), gradient_std=0.1))
    monitor = PlausibilityMonitor(KnownForce(level))
    for k in range(400):
        monitor.follow(sample(k, gradient=40.0 if k > 200 and k % 50 < width else 0.0))
        assert monitor.state.line.lately == 0.0
    assert monitor.state.line.count > 50.0
    assert math.isfinite(monitor.state.line.spread)


def test_gradients_beyond_the_end_of_the_line_are_not_compared_with_it(train_file: TrainFile, sample: Make) -> None:
    line = Line(stops=(0.0, 1900.0), gradient=((0.0, 0.0), (1900.0, -2.0)), gradient_std=0.1)
    ends, endless = (
        PlausibilityMonitor(KnownForce(replace(train_file, line=line)))
        for line in (line, replace(line, stops=()))
    )  # fmt: skip
    for k in range(1500):
        for monitor in (ends, endless):
            monitor.follow(sample(k, gradient=0.0))
    assert endless.state.line.finding == 'ato/gradient is suddenly +2.0 per mille off the line'
    assert ends.state.line.finding == ''
    assert ends.state.line.count > 60.0
