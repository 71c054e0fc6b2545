# SPDX-License-Identifier: Apache-2.0
"""Which samples become brakings, and when these begin and end."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from trainid_ros.brake_rate.braking import BrakingCollector
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.interface.results import Reason
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Brake, Davis, Train, TrainFile

FILE = TrainFile(Train(mass=2e5), Davis(2.0, 0.1, 0.01), Brake(delay=0.5, time_constant=0.4))
PERIOD = 0.2
START = 100.0


def drive(changes: dict[float, float], seconds: float, speed: float = 12.0) -> list[Sample]:
    """Return samples at 5 Hz with changes of the command at some times [s]."""
    samples, value = [], 0.0
    for i in range(round(seconds / PERIOD)):
        now = i * PERIOD
        new = [(t, u) for t, u in changes.items() if now - PERIOD < t <= now]
        value = new[-1][1] if new else value
        sample = coasting_sample(round((START + now) * NS_PER_S), PERIOD, speed)
        sample.brake_command = value
        sample.brake_changes = tuple(BrakeCommandChange(round((START + t) * NS_PER_S), u) for t, u in new)
        samples.append(sample)
    return samples


def collected(samples: list[Sample]) -> BrakingCollector:
    collector, rejected = BrakingCollector(FILE), Counter[Reason]()
    for sample in samples:
        collector.add(sample, rejected)
    collector.end_piece()
    return collector


def test_a_braking_has_what_comes_before_and_after_it() -> None:
    samples = drive({10.05: -0.5, 15.0: -0.7, 20.0: 0.0}, 40.0)
    (braking,) = collected(samples).brakings
    assert braking.changes == pytest.approx([(10.05, -0.5), (15.0, -0.7), (20.0, 0.0)])
    assert 5.9 < braking.time[0] < 6.5
    assert 29.5 < braking.time[-1] < 30.1
    # Decelerations by the resistance of the file, in m/s^2.
    inertia = 1000.0 * 1.08 / 9.80665
    assert braking.rolling[0] == pytest.approx((2.0 + 0.1 * 12.0) / inertia)
    assert braking.air[0] == pytest.approx(0.01 * 144.0 / inertia)


def test_a_braking_ends_when_the_train_pulls_and_its_traction_counts() -> None:
    samples = drive({10.0: -0.5, 20.0: 0.0}, 40.0)
    for sample in samples[110:]:
        sample.force = sample.force_mean = 2e4
    for sample in samples[50:100]:
        sample.force = sample.force_mean = -9e4  # the effort of the brake
    (braking,) = collected(samples).brakings
    assert braking.time[-1] < 22.1
    assert not braking.traction.any()


@pytest.mark.parametrize('changes', [{2.0: -0.5}, {10.0: -0.5, 11.0: 0.0, 14.5: -0.5, 16.0: 0.0}])
def test_only_from_a_released_brake(changes: dict[float, float]) -> None:
    found = collected(drive(changes, 30.0)).brakings
    # The first has too little before it; a second application soon after belongs to the first.
    assert len(found) == (1 if 10.0 in changes else 0) or found[0].time[0] < 2.0


def test_gaps_emergencies_and_standstill_end_a_braking() -> None:
    samples = drive({10.0: -0.5}, 30.0)
    for change in ({'emergency': True}, {'dt': float('nan')}, {'brake_gap': True}, {'speed': 0.1}):
        cut = [*samples[:100], replace(samples[100], **change), *samples[101:]]
        (braking,) = collected(cut).brakings
        assert braking.time[-1] == pytest.approx(19.8)


def test_rejections_are_counted() -> None:
    samples, rejected = drive({}, 1.0), Counter[Reason]()
    samples[0].force_mean = float('nan')
    collector = BrakingCollector(FILE)
    for sample in samples:
        collector.add(sample, rejected)
    assert rejected == {Reason.FORCE_MISSING: 1}


def test_a_brake_applied_before_the_part_asked_for_counts() -> None:
    samples = drive({8.0: -0.5, 9.0: 0.0, 11.0: -0.5}, 20.0)
    collector = BrakingCollector(FILE)
    for sample in samples[:46]:
        collector.monitor(sample)
    for sample in samples[46:]:
        collector.add(sample, Counter())
    collector.end_piece()
    assert collector.brakings == []
