# SPDX-License-Identifier: Apache-2.0
"""Each sensor error has the size given in its model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import ForceRecord, SpeedRecord
from trainid_ros.sim.scenario import MAX_JITTER_NS, SensorModel, Sensors
from trainid_ros.train.forces import G

CLEAN = SensorModel(
    speed_noise=0.0,
    speed_quantum=0.0,
    force_noise=0.0,
    force_noise_relative=0.0,
    position_drift=0.0,
    map_error=0.0,
    mass_noise=0.0,
    stamp_jitter=0.0,
)
COUNT = 20_000
PULL = 60.0  # N/kN


def sensors(settings: dict[str, float] | None = None, seed: int = 1, **more: float) -> Sensors:
    model = replace(CLEAN, **(settings or {}) | more)
    return Sensors(model, 0.2, (0.0, 20_000.0), np.random.default_rng(seed))


def speeds(device: Sensors, true: float = 10.0) -> np.ndarray:
    records = [device.speed(10**9, true, 0.0, PULL) for _ in range(COUNT)]
    return np.array([record.speed for record in records if record is not None])


def test_sensors_without_errors_report_true_values() -> None:
    device = sensors()
    assert device.speed(7, 10.0, 500.0, 1.0) == SpeedRecord(7, 10.0, 500.0)
    assert device.force(7, -3e4, 2e5) == ForceRecord(7, -3e4)
    assert device.weigh(2e5) == 2e5
    record = device.gradient(7, 4.0, 500.0, 1, radius=300.0, tunnel=True)
    assert record is not None
    assert (record.gradient, record.curve_radius, record.tunnel) == (4.0, 300.0, True)


def test_the_force_may_be_stamped_late() -> None:
    assert sensors(force_delay=0.4).force(7 * 10**8, -3e4, 2e5) == ForceRecord(11 * 10**8, -3e4)


def test_speed_noise() -> None:
    # The std of 20 000 values is known to 0.5 %: 2 % is 4 sigma; the mean to 0.02 / 141.
    measured = speeds(sensors(speed_noise=0.02))
    assert measured.std() == pytest.approx(0.02, rel=0.02)
    assert measured.mean() == pytest.approx(10.0, abs=4 * 0.02 / math.sqrt(COUNT))


def test_speed_quantum() -> None:
    quantum = 0.1 / 3.6
    measured = speeds(sensors(speed_noise=0.1, speed_quantum=quantum))
    steps = measured / quantum
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert len(np.unique(np.round(steps))) > 10


def test_wheel_ratio_scales_speed_and_odometry() -> None:
    device = sensors(wheel_ratio=1.01)
    device.speed(1, 10.0, 0.0, 1.0)
    record = device.speed(2, 10.0, 100.0, 1.0)
    assert record is not None
    assert record.speed == pytest.approx(10.1)
    assert record.position == pytest.approx(101.0)


def test_a_stationary_train_measures_zero_speed_and_its_exact_position() -> None:
    device = sensors(speed_noise=0.5, position_drift=5.0)
    device.speed(1, 10.0, 0.0, 1.0)
    assert device.speed(2, 0.0, 40.0, 0.0) == SpeedRecord(2, 0.0, 40.0)


def test_speed_is_never_negative() -> None:
    assert speeds(sensors(speed_noise=1.0), true=0.1).min() == 0.0


def test_odometry_drifts_as_a_random_walk() -> None:
    ends = []
    for seed in range(400):
        device = sensors(seed=seed, position_drift=0.03)
        for _ in range(25):
            record = device.speed(1, 10.0, 0.0, 1.0)
        assert record is not None
        ends.append(record.position)
    # 5 s give 0.03 sqrt(5); the std of 400 values is known to 3.5 %: 15 % is 4 sigma.
    assert np.std(ends) == pytest.approx(0.03 * math.sqrt(5.0), rel=0.15)


@pytest.mark.parametrize(
    ('settings', 'force', 'expected'),
    [
        ({'force_noise': 0.3}, 0.0, 0.3 * 2e5 * G / 1000.0),
        ({'force_noise_relative': 0.003}, -2e5, 600.0),
    ],
)
def test_force_noise(settings: dict[str, float], force: float, expected: float) -> None:
    device = sensors(settings)
    records = [device.force(1, force, 2e5) for _ in range(COUNT)]
    measured = np.array([record.force for record in records if record is not None])
    assert measured.std() == pytest.approx(expected, rel=0.02)
    assert measured.mean() == pytest.approx(force, abs=4 * expected / math.sqrt(COUNT))


def test_the_map_error_depends_on_position_and_changes_sign_with_the_direction() -> None:
    device = sensors(map_error=0.5)
    there = device.gradient(1, 0.0, 1234.0, 1, radius=0.0, tunnel=False)
    back = device.gradient(2, 0.0, 1234.0, -1, radius=0.0, tunnel=False)
    assert there is not None
    assert back is not None
    assert there.gradient == -back.gradient != 0.0


def test_the_map_error_is_correlated_over_its_length() -> None:
    device = Sensors(replace(CLEAN, map_error=0.5), 0.2, (0.0, 2e6), np.random.default_rng(5))
    errors = np.array([device.map_error(x) for x in np.arange(0.0, 2e6, 100.0)])
    # 2000 km contain about 5000 independent values of 400 m.
    assert errors.std() == pytest.approx(0.5, rel=0.05)
    assert float(np.corrcoef(errors[:-2], errors[2:])[0, 1]) == pytest.approx(math.exp(-1.0), abs=0.06)
    assert device.map_error(-50.0) == device.map_error(0.0)


def test_dropout_loses_the_given_share_of_messages() -> None:
    device = sensors(dropout=0.1)
    lost = sum(device.brake(1, -0.5) is None for _ in range(COUNT))
    # Binomial: std 42 of 20 000.
    assert lost == pytest.approx(0.1 * COUNT, abs=4 * 42)


def test_stamp_jitter_is_clipped() -> None:
    device = sensors(stamp_jitter=0.002)
    records = [device.force(10**9, 0.0, 2e5) for _ in range(COUNT)]
    stamps = np.array([record.stamp_ns for record in records if record is not None]) - 10**9
    # Clipping a normal at two standard deviations reduces its std by 4 % (0.9594).
    assert stamps.std() == pytest.approx(0.9594 * 2e6, rel=0.02)
    assert np.abs(stamps).max() == MAX_JITTER_NS


def test_slip_has_the_given_share_and_the_sign_of_the_force() -> None:
    error = speeds(sensors(slip_share=0.05, slip_speed=3.0)) - 10.0
    # 4000 s contain about 150 bursts: the share is known to 10 %.
    assert np.mean(error != 0.0) == pytest.approx(0.05, rel=0.4)
    assert error.min() >= 0.0
    assert 2.0 < error.max() <= 3.0


def test_slip_needs_a_force_and_its_share_refers_to_the_entire_time() -> None:
    device = sensors(slip_share=0.1, slip_speed=3.0, seed=31)
    # 10 s each of traction, coasting and braking.
    pulls = np.tile(np.repeat([PULL, 0.5, -PULL], 50), 400)
    records = [device.speed(1, 10.0, 0.0, float(pull)) for pull in pulls]
    error = np.array([record.speed for record in records if record is not None]) - 10.0
    assert np.all(error[np.abs(pulls) < 1.0] == 0.0)
    assert np.all(error * pulls >= 0.0)
    # 12 000 s contain about 900 bursts: the share is known to 4 %.
    assert np.mean(error != 0.0) == pytest.approx(0.1, rel=0.15)


def test_a_setting_out_of_range_is_rejected() -> None:
    with pytest.raises(InputError, match=r'dropout = 2 '):
        sensors(dropout=2.0)
