# SPDX-License-Identifier: Apache-2.0
"""All numbers of a bag, whatever their types, and slopes in the balance of forces."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from test.foreign_bag import FLOAT, TWIST, ForeignBag
from trainid_ros.inspection import number_series
from trainid_ros.inspection.number_series import (
    PER_MILLE,
    BagNumbers,
    is_near,
    nearest_unit,
    partial_slope,
    read_numbers,
    regress,
)
from trainid_ros.interface.records import NS_PER_S

START = 1_700_000_000 * NS_PER_S
STATE = 'float32[3] values\nfloat64[9] covariance\nstring name\nbool on\nstd_msgs/Float64[] list\n'


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with ForeignBag(tmp_path / 'bag', {'maker_msgs/msg/State': STATE}) as writer:
        for k in range(50):
            now = START + k * NS_PER_S // 5
            writer.write('/a/twist', TWIST, now, twist__linear__x=float(k))
            writer.write('/a/level', FLOAT, now, data=2.0)
            writer.write('/state', 'maker_msgs/msg/State', now, values=np.array([0.0, k, 1.0], np.float32), on=k > 25)
            writer.write('/gaps', FLOAT, now, data=math.nan if k % 2 else 1.0)
            writer.write('/none', FLOAT, now, data=math.inf)
            writer.write('/map', 'nav_msgs/msg/GridCells', now, cell_width=1.0)
            writer.write('/cam', 'sensor_msgs/msg/Image', now)
            writer.write('/text', 'std_msgs/msg/Float64MultiArray', now, data=np.ones(1000) * k)
    return tmp_path / 'bag'


def named(numbers: BagNumbers) -> dict[str, number_series.NumberSeries]:
    return {f'{item.topic} {item.field}': item for item in numbers.series}


def test_numbers_are_read_by_field_and_index(bag: Path) -> None:
    numbers = read_numbers(bag, '/', 64 << 20)
    found = named(numbers)
    assert sorted(found) == [
        '/a/level data', '/a/twist twist.linear.x', '/gaps data', '/map cell_width',
        '/state on', '/state values.1', '/state values.2',
    ]  # fmt: skip
    speed, on = found['/a/twist twist.linear.x'], found['/state on']
    assert (speed.has_stamps, speed.is_whole, on.has_stamps, on.is_whole) == (True, False, False, True)
    assert speed.rate == pytest.approx(5.0)
    assert speed.value.tolist() == list(range(50))
    assert found['/gaps data'].value.tolist() == [1.0] * 25
    assert numbers.duration_s == pytest.approx(9.8)
    assert dict(numbers.left_out) == {'/cam': 'sensor_msgs/msg/Image', '/text': 'large messages'}


def test_a_namespace_is_read_alone_with_relative_names(bag: Path) -> None:
    assert sorted(named(read_numbers(bag, '/a', 64 << 20))) == ['level data', 'twist twist.linear.x']


def test_only_the_beginning_of_a_long_bag_is_read(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(number_series, 'MAX_S', 4.0)
    monkeypatch.setattr(number_series, '_MAX_SAMPLES', 10)
    shares: list[float] = []
    numbers = read_numbers(bag, '/', 64 << 20, shares.append)
    assert named(numbers)['/a/twist twist.linear.x'].value.tolist() == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert 0.8 < sum(shares) < 1.01


def test_wide_strings_are_no_numbers(tmp_path: Path) -> None:
    writer = Writer(str(tmp_path / 'wide.mcap'))
    writer.start('ros2')
    schema = writer.register_schema('my_msgs/msg/Odo', 'ros2msg', b'wstring w\nfloat64 v\n')
    channel = writer.register_channel('/odo', 'cdr', schema)
    for k in range(5):
        payload = b'\0\1\0\0' + struct.pack('<I2Hd', 2, 65 + k, 66, 0.5 + k)
        writer.add_message(channel, 10**18 + k * NS_PER_S, payload, 10**18 + k * NS_PER_S)
    writer.finish()  # type: ignore[no-untyped-call]
    found = read_numbers(tmp_path / 'wide.mcap', '/', 1 << 20)
    assert [(item.topic, item.field) for item in found.series] == [('/odo', 'v')]
    assert found.series[0].value.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5]


COUNT = 400
TIME = np.array([2.0 * k for k in range(COUNT)], dtype=np.float64)


def columns(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a force, and a gradient that goes with it in part, each of shape (n,)."""
    force, gradient = np.random.default_rng(seed).normal(size=(2, COUNT))
    return force, gradient + 0.5 * force


def test_a_partial_slope_is_that_of_the_whole_regression() -> None:
    force, gradient = columns(0)
    y = 3.0 * force - 0.7 * gradient + 2.0 + 0.1 * np.random.default_rng(1).normal(size=COUNT)
    slope = partial_slope(y, gradient, [force], TIME)
    whole = regress(y, [gradient, force], np.ones(COUNT, dtype=bool))
    assert slope is not None
    assert whole is not None
    assert slope.value == pytest.approx(whole.slopes[0], rel=1e-9)
    less = regress(y, [force], np.ones(COUNT, dtype=bool))
    assert less is not None
    gain = (slope.value * slope.spread) ** 2 / np.var(y)
    assert gain == pytest.approx(whole.share - less.share, rel=1e-6)
    assert slope.share == pytest.approx(gain / (1.0 - less.share), rel=1e-6)


def test_the_standard_deviation_covers_errors_alike_in_time() -> None:
    """An error that lasts for 20 s counts once, not ten times."""
    errors, stds = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x, noise = (np.repeat(rng.normal(size=COUNT // 10), 10) for _ in range(2))
        slope = partial_slope(0.5 * x + noise, x, [], TIME)
        assert slope is not None
        errors.append(slope.value - 0.5)
        stds.append(slope.std)
    assert float(np.std(errors)) == pytest.approx(float(np.mean(stds)), rel=0.15)


def test_a_column_that_others_explain_has_no_slope() -> None:
    force, _ = columns(2)
    assert partial_slope(force, 2.0 * force + 1.0, [force], TIME) is None


def test_a_slope_names_the_unit_it_is_near() -> None:
    assert [nearest_unit(size, PER_MILLE) for size in (1.4, 7.0, 15.0, 900.0, 100.0)] == [
        *('per_mille', 'percent', 'deg', 'rad', ''),
    ]
    assert is_near(1.59, 1.0)
    assert not is_near(1.61, 1.0)
    assert math.isclose(PER_MILLE['deg'], 17.453, rel_tol=1e-4)
