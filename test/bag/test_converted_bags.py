# SPDX-License-Identifier: Apache-2.0
"""The bags converted from other data: an independent check of signs, units and stamps.

The freight run agrees with its ground truth. In the measured ride no values are interpolated over pauses, and its
energy balance agrees with its documentation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import Output, ResistanceEstimate, Status
from trainid_ros.setup.pipelines import EstimatorSettings, resistance_pipeline
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

BAGS = Path(__file__).parents[2] / 'bags'
MANIFEST, RIDE = BAGS / 'altrios_manifest', BAGS / 'ride'
WINDOW = 50  # samples of the freight run, 10 s
RIDE_WINDOW = 20  # s


def by_type(bag: Path) -> dict[type[Record], list[Record]]:
    found: dict[type[Record], list[Record]] = {}
    with BagReader(bag) as reader:
        for record in reader.records():
            found.setdefault(type(record), []).append(record)
        assert reader.warnings == []
    return found


def column(records: list[Record], name: str) -> Array:
    return np.array([getattr(record, name) for record in records], dtype=np.float64)


@pytest.mark.parametrize('bag', [MANIFEST, RIDE])
def test_bags_stay_small(bag: Path) -> None:
    assert sum(path.stat().st_size for path in bag.iterdir()) < 3_500_000


def test_forces_balance_with_the_true_resistance() -> None:
    records = by_type(MANIFEST)
    train = load_train_file(MANIFEST / 'train.yaml')
    davis = load_truth(MANIFEST / 'truth.yaml').truth_at(0.0).resistance
    ((_, coefficient),) = train.effects[0].parameters
    speed, brake = column(records[SpeedRecord], 'speed'), column(records[BrakeRecord], 'target_acceleration')
    gradient, radius = column(records[GradientRecord], 'gradient'), column(records[GradientRecord], 'curve_radius')
    known = {record.stamp_ns: record.force for record in records[ForceRecord] if isinstance(record, ForceRecord)}
    force = np.array([known.get(record.stamp_ns, np.nan) for record in records[GradientRecord]])
    curve = np.divide(coefficient, radius, out=np.zeros_like(radius), where=radius > 0.0)
    dt = WINDOW * (records[SpeedRecord][1].stamp_ns - records[SpeedRecord][0].stamp_ns) / NS_PER_S
    errors = []
    for i in range(0, len(speed) - WINDOW - 1, WINDOW):
        steps = slice(i + 1, i + WINDOW + 1)  # those between speed i and speed i + WINDOW
        if (brake[steps] < 0.0).any():
            continue
        pull = 1000.0 * force[steps].mean() / (train.train.mass * G) - gradient[steps].mean() - curve[steps].mean()
        inertia = 1000.0 * (1.0 + train.train.rotary_mass) * (speed[i + WINDOW] - speed[i]) / dt / G
        v = speed[i : i + WINDOW + 1]
        errors.append(pull - inertia - (davis.a + davis.b * v.mean() + davis.c * np.square(v).mean()))
    assert len(errors) > 200
    # Speed noise of 0.05 m/s at both ends of 10 s makes 0.74 N/kN; the mean over the windows has a tenth of that.
    assert np.nanstd(errors) < 1.0
    assert abs(np.nanmean(errors)) < 0.15


def test_while_valid_the_std_was_below_three_times_the_limit_within_the_last_second() -> None:
    pipeline = resistance_pipeline(load_train_file(MANIFEST / 'train.yaml'), EstimatorSettings())
    outputs: list[Output[ResistanceEstimate]] = []
    with BagReader(MANIFEST) as reader:
        for _, row in reader.rows():
            pipeline.take(pipeline.stream.push_row(*row), outputs.append)
    held_ns, valid = 0, 0
    for output in outputs:
        estimate = output.estimate
        if estimate.resistance_std < 3.0 * math.hypot(0.15, 0.05 * estimate.resistance):
            held_ns = output.stamp_ns
        if output.status is Status.VALID:
            valid += 1
            assert output.stamp_ns - held_ns <= NS_PER_S
    assert valid > 1000


def test_the_train_file_deviates_as_documented() -> None:
    truth = load_truth(MANIFEST / 'truth.yaml').truth_at(0.0).resistance
    nominal = load_train_file(MANIFEST / 'train.yaml').resistance
    ratios = (nominal.a / truth.a, nominal.b / truth.b, nominal.c / truth.c)
    assert ratios == pytest.approx((1.2, 0.8, 1.2), rel=1e-3)


@dataclass(frozen=True, slots=True)
class Series:
    """One topic: stamps [s] and values, shapes (n,)."""

    time: Array
    value: Array

    def every_second(self, first: float, seconds: int) -> Array:
        return np.asarray(np.interp(first + np.arange(seconds + 1), self.time, self.value))


@pytest.fixture(scope='module')
def series() -> dict[str, Series]:
    found = by_type(RIDE)
    start = found[SpeedRecord][0].stamp_ns
    columns = (
        (SpeedRecord, 'speed'), (SpeedRecord, 'position'), (ForceRecord, 'force'), (GradientRecord, 'gradient'),
        (BrakeRecord, 'target_acceleration'),
    )  # fmt: skip
    return {
        name: Series(
            np.array([(record.stamp_ns - start) / NS_PER_S for record in found[kind]]),
            column(found[kind], name),
        )
        for kind, name in columns
    }


def masses(series: dict[str, Series], late: float) -> tuple[float, float]:
    """Return the masses [kg] that fit climbing and acceleration if the gradient is late by ``late`` [s]."""
    speed = series['speed']
    rows = []
    for first in np.arange(0.0, speed.time[-1] - RIDE_WINDOW - 10.0, RIDE_WINDOW):
        inside = speed.time[(speed.time >= first) & (speed.time <= first + RIDE_WINDOW + 10.0)]
        if inside.size < 2 or np.diff(inside).max() > 0.5:  # a pause
            continue
        v = speed.every_second(first, RIDE_WINDOW)
        force = series['force'].every_second(first, RIDE_WINDOW)
        if v.min() < 2.0 or force.min() <= 0.0:  # a rider who pedals does not brake
            continue
        climb = G * series['gradient'].every_second(first + late, RIDE_WINDOW).mean() / 1000.0
        rows.append((force.mean(), 1.0, np.square(v).mean(), climb, 1.01 * (v[-1] - v[0]) / RIDE_WINDOW))
    table = np.array(rows)
    assert len(table) > 200
    _, _, climbing, accelerating = np.linalg.lstsq(table[:, 1:], table[:, 0])[0].tolist()
    return climbing, accelerating


def test_nothing_is_interpolated_over_pauses(series: dict[str, Series]) -> None:
    for name, step in (('speed', 0.2), ('gradient', 0.5)):
        gaps = np.diff(series[name].time)
        assert ((np.abs(gaps - step) < 1e-6) | (gaps > 1.5)).all()
    assert np.count_nonzero(np.diff(series['speed'].time) > 1.5) == 10
    assert (series['target_acceleration'].value == 0.0).all()


def test_distance_and_speed_agree(series: dict[str, Series]) -> None:
    time, speed, position = series['speed'].time, series['speed'].value, series['position'].value
    riding = np.diff(time) < 0.5
    distance = float((0.5 * (speed[1:] + speed[:-1]) * np.diff(time))[riding].sum())
    assert distance == pytest.approx(float(np.diff(position)[riding].sum()), rel=0.02)


def test_the_energy_balance_gives_one_mass_if_the_altimeter_is_late(series: dict[str, Series]) -> None:
    at_once, late = masses(series, 0.0), masses(series, 3.0)
    nominal = load_train_file(RIDE / 'train.yaml').train.mass
    assert 60.0 < late[0] < 0.9 * nominal
    assert late[1] == pytest.approx(late[0], rel=0.15)
    assert at_once[1] < 0.8 * at_once[0]
