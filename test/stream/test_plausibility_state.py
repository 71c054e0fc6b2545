# SPDX-License-Identifier: Apache-2.0
"""What of the checks withholds trust, what is found, and its numbers."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from trainid_ros.stream.balance_checks import BalanceCheck, ChangeCheck, LineCheck, ShiftCheck
from trainid_ros.stream.message_check import CommandCheck, ExcursionCheck, ReleaseCheck, SpikeCheck
from trainid_ros.stream.plausibility import PlausibilityState
from trainid_ros.stream.slope_checks import BRAKE_RANGE, TRACTION_RANGE, DistanceCheck, Effort, Slope

SUSPICIONS: dict[str, Callable[[], PlausibilityState]] = {
    'spikes of the force': lambda: PlausibilityState(spikes=SpikeCheck(spikes=2.0, evidence=1.0)),
    'spikes of the command': lambda: PlausibilityState(command_spikes=ExcursionCheck(spikes=2.0)),
    'drops of the command': lambda: PlausibilityState(releases=ReleaseCheck(spikes=2.0)),
    'spikes of the gradient': lambda: PlausibilityState(gradient_spikes=ExcursionCheck(spikes=2.0)),
    'slope of traction': lambda: PlausibilityState(traction=Slope(offset=4.0, excess=3.0)),
    'slope of the brake': lambda: PlausibilityState(brake=Slope(offset=8.0, excess=5.0)),
    'effort': lambda: PlausibilityState(effort=Effort(off=2)),
    'distance': lambda: PlausibilityState(distance=DistanceCheck(sudden=1)),
    'delay': lambda: PlausibilityState(shift=ShiftCheck(delay=0.5)),
    'line': lambda: PlausibilityState(line=LineCheck(off=2)),
    'sudden residual': lambda: PlausibilityState(balance=BalanceCheck(residual=20.0, limit=10.0)),
    'change': lambda: PlausibilityState(change=ChangeCheck(is_suspected=True)),
}


def test_nothing_is_suspected_at_the_start() -> None:
    assert not PlausibilityState().is_suspected
    assert PlausibilityState().finding == ''


@pytest.mark.parametrize('make', SUSPICIONS.values(), ids=SUSPICIONS.keys())
def test_each_check_can_withhold_trust(make: Callable[[], PlausibilityState]) -> None:
    assert make().is_suspected
    assert make().finding == ''


def test_a_delay_found_before_is_suspected_for_some_time_only() -> None:
    assert not PlausibilityState(shift=ShiftCheck(delay=0.5), moved_s=1000.0).is_suspected


NAMED: dict[str, tuple[PlausibilityState, tuple[float, float]]] = {
    'commands': (PlausibilityState(commands=CommandCheck('x', reversals=7.0)), (7.0, CommandCheck().limit)),
    'command_spikes': (PlausibilityState(command_spikes=ExcursionCheck('x', 4.0)), (4.0, ExcursionCheck().limit)),
    'releases': (PlausibilityState(releases=ReleaseCheck('x', 5.0)), (5.0, ReleaseCheck().limit)),
    'spikes': (PlausibilityState(spikes=SpikeCheck('x', 3.0)), (3.0, SpikeCheck().limit)),
    'gradient_spikes': (PlausibilityState(gradient_spikes=ExcursionCheck('x', 6.0)), (6.0, ExcursionCheck().limit)),
    'traction': (PlausibilityState(traction=Slope('x', xx=1.0, yx=3.0)), (3.0, TRACTION_RANGE[1])),
    'brake': (PlausibilityState(brake=Slope('x', xx=1.0, yx=0.1)), (0.1, BRAKE_RANGE[0])),
    'effort': (PlausibilityState(effort=Effort('x', xx=1.0, yx=2.0)), (2.0, 1.0)),
    'distance': (PlausibilityState(distance=DistanceCheck('x', error=0.05)), (0.05, DistanceCheck().limit)),
    'shift': (PlausibilityState(shift=ShiftCheck('x', delay=1.0)), (1.0, 0.0)),
    'line': (PlausibilityState(line=LineCheck('x', value=2.0, limit=0.7, lately=1.0)), (2.0, 0.7)),
    'change': (PlausibilityState(change=ChangeCheck('x', xx=1.0, residual_x=0.5)), (1.5, 1.0)),
    'balance': (PlausibilityState(balance=BalanceCheck('x', mean=9.0, resistance=2.0)), (9.0, 8.0)),
}


@pytest.mark.parametrize(('state', 'numbers'), NAMED.values(), ids=NAMED.keys())
def test_a_finding_of_each_check_comes_with_its_numbers(state: PlausibilityState, numbers: tuple[float, float]) -> None:
    assert state.finding == 'x'
    assert state.numbers == numbers
