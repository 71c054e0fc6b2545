# SPDX-License-Identifier: Apache-2.0
"""A stuck speed; two publishers and a controller that toggles; a mass in tonnes; spikes, and short cuts of traction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_ros.stream.known_force import SpeedNoise
from trainid_ros.stream.message_check import (
    CommandCheck,
    EmergencyCheck,
    ExcursionCheck,
    MassCheck,
    ReleaseCheck,
    RepeatCheck,
    SpikeCheck,
)
from trainid_ros.train.forces import BrakeCommandChange

if TYPE_CHECKING:
    from collections.abc import Sequence

PERIOD_S = 0.2
WIDTH_S = 0.2
STD = 4.0


def stuck(speeds: Sequence[float]) -> list[bool]:
    """Return after which of some speeds [m/s] the sensor counts as stuck."""
    check, noise, found = RepeatCheck(), SpeedNoise.declared(0.025), []
    for speed in speeds:
        check.add(speed, noise)
        noise.add(speed, PERIOD_S)
        found.append(check.is_stuck)
    return found


def cruise(std: float, quantum: float, count: int = 200) -> list[float]:
    """Return speeds of a cruise at 12 m/s with noise and steps of the speed [m/s]."""
    speeds = 12.0 + std * np.random.default_rng(1).standard_normal(count)
    return [float(round(v / quantum) * quantum) for v in speeds]


@pytest.mark.parametrize(('quantum', 'most'), [(1e-6, 5), (0.01, 9)])
def test_a_noisy_speed_that_repeats_is_stuck_until_it_changes(quantum: float, most: int) -> None:
    found = stuck([*cruise(0.03, quantum), *[12.0] * 40, 11.9])
    assert most - 3 <= found.index(True) - 200 <= most + 6
    assert found[200 + most + 6 : 240] == [True] * (34 - most)
    assert not found[-1]


@pytest.mark.parametrize(('std', 'quantum'), [(0.03, 0.1), (0.0, 0.05), (0.1, 0.2), (0.02, 1.0 / 3.6)])
def test_a_speed_in_coarse_steps_may_repeat(std: float, quantum: float) -> None:
    assert not any(stuck([*cruise(std, quantum, 1000), *[12.0] * 100]))


def test_a_train_at_rest_is_not_stuck() -> None:
    assert not any(stuck([*cruise(0.03, 1e-6), *[0.0] * 500]))


def toggled(changes_per_s: float, seconds: float = 20.0) -> CommandCheck:
    """Return the check after a command that toggles between two values."""
    check, due, count = CommandCheck(), 0.0, 0
    for k in range(round(seconds / PERIOD_S)):
        changes = []
        while due < (k + 1) * PERIOD_S:
            changes.append(BrakeCommandChange(round(1e9 * due) + 1, -0.6 * (count % 2)))
            due, count = due + 1.0 / changes_per_s, count + 1
        check.add(tuple(changes), PERIOD_S)
    return check


@pytest.mark.parametrize('mass', [60e3, 199e3, 640e3, math.nan])
def test_a_mass_may_be_that_of_an_empty_or_a_loaded_train(mass: float) -> None:
    check = MassCheck()
    check.add(mass, 200e3, is_overdue=False)
    assert check.finding == ''


def test_a_mass_in_tonnes_or_of_another_train_is_named_until_it_fits() -> None:
    check = MassCheck()
    check.add(185.0, 200e3, is_overdue=False)
    assert check.finding == 'ato/mass is 185, the train file says 200000 kg: it looks like tonnes'
    check.add(1.5e6, 200e3, is_overdue=False)
    assert check.finding == 'ato/mass is 1.5e+06, the train file says 200000 kg'
    check.add(185e3, 200e3, is_overdue=False)
    assert check.finding == ''


def test_a_load_that_is_not_weighed_any_more_is_named_until_it_is() -> None:
    check = MassCheck()
    check.add(190e3, 200e3, is_overdue=True)
    assert check.finding == 'ato/mass is missing since the last stop: the load may have changed'
    assert check.misread == ''  # it was right before
    check.add(190.0, 200e3, is_overdue=True)
    assert check.misread == 'ato/mass is 190, the train file says 200000 kg: it looks like tonnes'
    check.add(190e3, 200e3, is_overdue=False)
    assert check.finding == ''


@pytest.mark.parametrize('hertz', [1.0, 2.0])
def test_a_controller_may_toggle_its_command(hertz: float) -> None:
    assert toggled(2.0 * hertz).finding == ''


def test_a_command_that_changes_with_every_message_is_named_until_it_is_quiet() -> None:
    assert toggled(10.0, 0.8).finding == ''
    check = toggled(10.0, 1.4)
    assert 'alternates' in check.finding
    for _ in range(10):
        check.add((), PERIOD_S)
    assert check.finding == ''


def test_a_stepped_command_does_not_alternate() -> None:
    check = CommandCheck()
    for k in range(50):
        check.add((BrakeCommandChange(k + 1, -0.2 * (k % 5)),), PERIOD_S)
    assert check.finding == ''


@pytest.mark.parametrize(
    ('force', 'seconds', 'is_found'),
    [(40.0, 6.0, True), (40.0, 4.0, False), (-40.0, 60.0, False), (math.nan, 6.0, False)],
)
def test_a_train_that_pulls_under_an_emergency_command_is_named_until_it_ends(
    force: float, seconds: float, is_found: bool
) -> None:
    check = EmergencyCheck()
    for _ in range(round(seconds / PERIOD_S)):
        check.add(force, PERIOD_S, emergency=True)
    assert ('says emergency' in check.finding) is is_found
    check.add(force, PERIOD_S, emergency=False)
    assert check.finding == ''


def reported(height: float, specific_impulse: float, count: int = 8) -> SpikeCheck:
    """Return the check after reports that stand out, to a share of which the speed answers [1]."""
    check = SpikeCheck(topic='ato/force')
    for k in range(10 * count):
        excess = height if k % 10 == 5 else 0.0
        # A report stands for half of the intervals before and after it.
        mean = 40.0 + 0.5 * (excess if k % 10 == 5 else height if k % 10 == 6 else 0.0)
        check.add(40.0 + excess, mean, (40.0 + specific_impulse * (mean - 40.0)) * PERIOD_S, STD, PERIOD_S)
    return check


def test_a_cut_of_traction_is_answered_by_the_speed_and_a_spike_towards_zero_is_not() -> None:
    assert reported(-40.0, specific_impulse=0.0).finding == 'ato/force has spikes'
    assert reported(-40.0, specific_impulse=1.0).finding == ''
    assert not reported(-40.0, specific_impulse=1.0).suspicion


@pytest.mark.parametrize('height', [30.0, -100.0])
def test_reports_beyond_their_neighbours_are_spikes_where_the_speed_shows_nothing(height: float) -> None:
    assert reported(height, specific_impulse=math.nan, count=2).suspicion
    assert reported(height, specific_impulse=math.nan, count=6).finding == 'ato/force has spikes'


def test_pulses_of_traction_that_the_speed_answers_are_no_spikes() -> None:
    assert reported(30.0, specific_impulse=0.0).finding == 'ato/force has spikes'
    assert reported(30.0, specific_impulse=1.0).finding == ''


def test_spikes_towards_zero_that_the_noise_of_the_speed_hides_or_while_a_brake_acts_are_no_evidence() -> None:
    assert reported(-16.0, specific_impulse=0.0, count=3).finding == ''
    assert reported(-40.0, specific_impulse=math.nan).finding == ''


def test_pulses_of_traction_rise_and_fall_in_more_than_one_report() -> None:
    check = SpikeCheck(topic='ato/force')
    for k in range(80):
        force = (0.0, 48.0, 80.0, 50.0)[k % 8] if k % 8 < 4 else 0.0
        check.add(force, force, math.nan, STD, PERIOD_S)
    assert check.finding == ''
    assert not check.suspicion


@pytest.mark.parametrize(
    'swing', [(26.0, 35.0, 79.0, 80.0, 41.0, 43.0, 84.0, 83.0, 42.0), (2.5, 9.3, 33.9, 21.5, 13.1, 7.8, 4.6)]
)
def test_a_controller_that_hunts_sends_no_spikes(swing: tuple[float, ...]) -> None:
    """Forces as reported by a tram, and by a metro with a relay and a lag."""
    check = SpikeCheck(topic='ato/force')
    for force in swing * 20:
        check.add(force, force, math.nan, STD, PERIOD_S)
        assert not check.suspicion


def test_a_spike_is_counted_once() -> None:
    check = SpikeCheck(topic='ato/force')
    for force in (40.0, 40.0, 40.0, 40.0, 100.0, 40.0, 40.0, 40.0, 40.0):
        check.add(force, 40.0, 8.0, STD, PERIOD_S)
    assert 0.9 < check.spikes <= 1.0


def test_reports_that_toggle_every_second_time_are_not_compared_with_each_other() -> None:
    check = SpikeCheck(topic='ato/force')
    for k in range(20):
        check.add(40.0 + 60.0 * (k % 2), 70.0, math.nan, STD, PERIOD_S)
    assert check.spikes < 7.0


def test_a_missing_force_is_no_spike() -> None:
    check = SpikeCheck(topic='ato/force')
    for k in range(100):
        check.add(math.nan if k % 10 == 0 else 40.0, 40.0, 8.0, STD, PERIOD_S)
    assert check.finding == ''
    assert math.isfinite(check.last)


def test_named_spikes_are_over_after_a_while() -> None:
    check = reported(60.0, specific_impulse=0.0)
    for _ in range(500):
        check.add(40.0, 40.0, 8.0, STD, PERIOD_S)
    assert check.finding == ''


def followed(
    values: Sequence[float], *, calm_s: float = 0.0, direction: float = 0.0, dt: float = 0.2
) -> ExcursionCheck:
    """Return the check after some values."""
    check = ExcursionCheck(topic='ato/gradient', height=5.0, longest_s=0.65, calm_s=calm_s, direction=direction)
    for value in values:
        check.add(value, dt)
    return check


@pytest.mark.parametrize('width', [1, 2, 3])
def test_values_that_leave_their_level_for_a_moment_are_spikes(width: int) -> None:
    spike = [2.0] * 15 + [32.0] * width
    assert not followed(spike * 2 + [2.0]).finding
    assert followed(spike * 2 + [2.0]).suspicion
    assert followed(spike * 4 + [2.0]).finding == 'ato/gradient has spikes'


@pytest.mark.parametrize(('direction', 'up', 'down'), [(0.0, 4.0, 4.0), (-1.0, 0.0, 4.0), (1.0, 4.0, 0.0)])
def test_spikes_may_be_on_one_side_only(direction: float, up: float, down: float) -> None:
    base = [0.0] * 15
    assert followed([*base, 20.0] * 4 + [0.0], direction=direction).spikes == pytest.approx(up, abs=0.8)
    assert followed([*base, -20.0] * 4 + [0.0], direction=direction).spikes == pytest.approx(down, abs=0.8)


@pytest.mark.parametrize('values', [[0.0] * 10 + [20.0] * 10, [0.0, 4.0], [0.0] * 10 + [6.0, 12.0, 18.0, 24.0]])
def test_steps_small_changes_and_ramps_are_no_spikes(values: list[float]) -> None:
    assert followed(values * 20).spikes == 0.0


def test_a_value_that_alternates_has_no_level_to_leave() -> None:
    toggling = [0.0, 0.0, 8.0] * 30
    assert followed(toggling).finding
    assert followed(toggling, calm_s=1.0).spikes <= 1.0


def test_missing_values_are_no_spikes() -> None:
    assert followed([0.0, math.nan, 0.0] * 20).spikes == 0.0
    assert followed([math.nan] * 5).spikes == 0.0


def test_spikes_are_over_after_a_while() -> None:
    check = followed(([2.0] * 15 + [32.0]) * 4 + [2.0])
    for _ in range(300):
        check.add(2.0, 0.2)
    assert not check.finding


FOLLOWED_S = 1.6


def dropped(follows: float, width: int = 1, drops: int = 4, force: float = -60.0) -> ReleaseCheck:
    """Return the check after a command that is released for some samples, and a force that follows it to a share."""
    check = ReleaseCheck(topic='ato/brake_command')
    for _ in range(drops):
        for k in range(25):
            released = 10 <= k < 10 + width
            # The force of a brake with a lag falls less, but for longer.
            falls = 10 <= k < 10 + 4 * width
            check.add(0.0 if released else -0.6, force * (1.0 - 0.25 * follows * falls), FOLLOWED_S, PERIOD_S)
    return check


def test_commands_that_drop_to_released_are_spikes_where_the_force_does_not_follow() -> None:
    assert dropped(0.0, drops=1).spikes > 0.9
    assert dropped(0.0, drops=2).suspicion
    assert dropped(0.0).finding == 'ato/brake_command has spikes'


@pytest.mark.parametrize('check', [dropped(1.0), dropped(0.5), dropped(0.0, force=-5.0), dropped(0.0, force=math.nan)])
def test_drops_that_the_force_follows_or_that_it_says_nothing_about_are_no_spikes(check: ReleaseCheck) -> None:
    assert check.spikes == 0.0


def test_a_release_for_good_is_no_spike() -> None:
    check = ReleaseCheck(topic='ato/brake_command')
    for k in range(400):
        check.add(-0.6 if k % 40 < 20 else 0.0, -60.0 if k % 40 < 20 else 0.0, FOLLOWED_S, PERIOD_S)
        assert check.spikes == 0.0


def test_drops_that_the_force_follows_count_against_those_before() -> None:
    check = dropped(0.0, drops=2)
    for k in range(75):
        released = k % 25 == 10
        falls = 10 <= k % 25 < 14
        check.add(0.0 if released else -0.6, -45.0 if falls else -60.0, FOLLOWED_S, PERIOD_S)
    assert check.spikes == 0.0


def test_a_command_that_has_not_held_until_the_brake_followed_it_has_no_drops() -> None:
    check = ReleaseCheck(topic='ato/brake_command')
    for k in range(120):
        check.add(0.0 if k % 6 == 5 else -0.6, -60.0, FOLLOWED_S, PERIOD_S)
    assert check.spikes == 0.0
