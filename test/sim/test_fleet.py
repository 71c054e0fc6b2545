# SPDX-License-Identifier: Apache-2.0
"""A train of a simulated fleet is the same on all days; its faults act from their day on, beside its own errors."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import DAY_NS, NS_PER_S, SpeedRecord
from trainid_ros.sim.fleet import Fleet, draw_day, draw_train, drive, parse_fault
from trainid_ros.sim.scenario import Simulation
from trainid_ros.sim.worlds import WORLDS, world_train


def fleet() -> Fleet:
    return Fleet(WORLDS['metro'], world_train(WORLDS['metro']), 3)


def wheel_ratio(simulation: Simulation) -> float:
    """Return the distance by the speed over that by the position."""
    speeds = [record for record in simulation.records if isinstance(record, SpeedRecord)]
    driven = sum(
        0.5 * (one.speed + two.speed) * (two.stamp_ns - one.stamp_ns) / NS_PER_S for one, two in pairwise(speeds)
    )
    return driven / abs(speeds[-1].position - speeds[0].position)


def test_a_train_is_the_same_each_day_and_a_fault_comes_on_top() -> None:
    train, fault = draw_train(3, 1), parse_fault('T01:wheel_diameter:ratio=1.03:2', 2, 5)
    assert draw_train(3, 1) == train != draw_train(3, 2)
    drives = [
        drive(fleet(), train, draw_day(3, day), effects, runs=1)
        for day, effects in ((0, ()), (1, ()), (fault.day, fault.effects))
    ]
    first, second, broken = map(wheel_ratio, drives)
    assert first == pytest.approx(train.unknowns.wheel_ratio, abs=2e-3)
    assert second == pytest.approx(first, abs=2e-3)
    assert broken / second == pytest.approx(1.03, abs=2e-3)
    days = [simulation.records[0].stamp_ns // DAY_NS for simulation in drives]
    assert days[1] - days[0] == 1
    # The same fleet gives the same records.
    assert drive(fleet(), train, draw_day(3, 0), runs=1).records == drives[0].records


def test_a_fault_of_a_ratio_multiplies_that_of_the_train() -> None:
    train, day = draw_train(3, 1), draw_day(3, 0)
    pads = parse_fault('T01:brake_scale:ratio=0.8:2', 2, 5).effects
    rates = [drive(fleet(), train, day, faults, runs=1).truth.brake_rate[0][1] for faults in ((), pads)]
    assert rates[1] == pytest.approx(0.8 * rates[0])


def test_the_faults_of_the_page_are_some() -> None:
    text = (Path(__file__).parents[2] / 'docs' / 'simulator.md').read_text(encoding='utf-8')
    found = [parse_fault(name, 8, 8) for name in re.findall(r'(?m)^\| .*\| `(T.*)` \|$', text)]
    assert len(found) == 6


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('T01:brake_scale', 'must have the form TRAIN:EFFECT:key=value:DAY'),
        ('T01:brake_scale:ratio=0.8', 'must have the form'),
        ('T09:brake_scale:ratio=0.8:2', 'the trains are T01 to T02'),
        ('T01:brake_scale:ratio=0.8:1', 'day 1 is outside 2 to 5'),
        ('T01:brake_scale:ratio=0.8,ratio=0.9:2', 'more than once'),
        ('T01:brake_scael:ratio=0.8:2', 'brake_scale'),
        ('T01:brake_scale:ratio=-8:2', 'ratio'),
    ],
)
def test_a_wrong_fault_is_an_error(text: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        parse_fault(text, 2, 5)
