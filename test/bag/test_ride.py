# SPDX-License-Identifier: Apache-2.0
"""The measured ride: no values are interpolated over pauses, and its energy balance agrees with its documentation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.train.forces import G
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

BAG = Path(__file__).parents[2] / 'bags' / 'ride'
WINDOW = 20  # s


@dataclass(frozen=True, slots=True)
class Series:
    """One topic: stamps [s] and values, shapes (n,)."""

    time: Array
    value: Array

    def every_second(self, first: float, seconds: int) -> Array:
        return np.asarray(np.interp(first + np.arange(seconds + 1), self.time, self.value))


@pytest.fixture(scope='module')
def series() -> dict[str, Series]:
    found: dict[type[Record], list[Record]] = {}
    with BagReader(BAG) as reader:
        for record in reader.records():
            found.setdefault(type(record), []).append(record)
    start = found[SpeedRecord][0].stamp_ns
    columns = (
        (SpeedRecord, 'speed'), (SpeedRecord, 'position'), (ForceRecord, 'force'), (GradientRecord, 'gradient'),
        (BrakeRecord, 'target_acceleration'),
    )  # fmt: skip
    return {
        name: Series(
            np.array([(record.stamp_ns - start) / NS_PER_S for record in found[kind]]),
            np.array([getattr(record, name) for record in found[kind]], dtype=np.float64),
        )
        for kind, name in columns
    }


def masses(series: dict[str, Series], late: float) -> tuple[float, float]:
    """Return the masses [kg] that fit climbing and acceleration if the gradient is late by ``late`` [s]."""
    speed = series['speed']
    rows = []
    for first in np.arange(0.0, speed.time[-1] - WINDOW - 10.0, WINDOW):
        inside = speed.time[(speed.time >= first) & (speed.time <= first + WINDOW + 10.0)]
        if inside.size < 2 or np.diff(inside).max() > 0.5:  # a pause
            continue
        v = speed.every_second(first, WINDOW)
        force = series['force'].every_second(first, WINDOW)
        if v.min() < 2.0 or force.min() <= 0.0:  # a rider who pedals does not brake
            continue
        climb = G * series['gradient'].every_second(first + late, WINDOW).mean() / 1000.0
        rows.append((force.mean(), 1.0, np.square(v).mean(), climb, 1.01 * (v[-1] - v[0]) / WINDOW))
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
    nominal = load_train_file(BAG / 'train.yaml').train.mass
    assert 60.0 < late[0] < 0.9 * nominal
    assert late[1] == pytest.approx(late[0], rel=0.15)
    assert at_once[1] < 0.8 * at_once[0]


def test_bag_stays_small() -> None:
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 3_500_000
