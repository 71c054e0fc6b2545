# SPDX-License-Identifier: Apache-2.0
"""A saved speed model is restored, whatever the algorithm and its settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from trainid_ros.estimators.settings import AmVffRlsConfig
from trainid_ros.interface.errors import SettingInfo, setting_info
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.setup.pipelines import SPEED_MODEL, am_vff_rls
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import Brake, Davis, Effect, Train, TrainFile

Journey = Callable[..., list[Sample]]
Make = Callable[..., Sample]
NAMES = ('AM-VFF-RLS', 'EKF', 'integral-RLS', 'RLS', 'VFF-RLS', 'AM-RLS', 'AM-VFF-RLS-printed')
CURVES = Effect('curve_resistance', (('coefficient', 600.0),))


def make(train_file: TrainFile, name: str) -> SpeedModelEstimator:
    file = replace(train_file, effects=(CURVES,))
    made = SPEED_MODEL.make(SPEED_MODEL.choose(name), file, np.random.default_rng(1))
    assert isinstance(made, SpeedModelEstimator)
    return made


@pytest.fixture(scope='module')
def curved(journey: Journey) -> list[Sample]:
    """Power and coasting, curves, a gap, and a stop at the end."""
    items = journey(
        90.0, traction=lambda t: 30.0 if t < 25.0 else 0.0, brake=lambda t: -0.7 if t > 60.0 else 0.0, speed=8.0
    )
    radii = [400.0 if (k // 40) % 2 else 0.0 for k in range(len(items))]
    return [
        replace(item, curve_radius=radius, dt=math.nan if k == 150 else item.dt)
        for k, (item, radius) in enumerate(zip(items, radii, strict=True))
    ]


@pytest.mark.parametrize('name', NAMES)
def test_every_saved_state_is_restored(train_file: TrainFile, curved: list[Sample], name: str) -> None:
    original, copy = make(train_file, name), make(train_file, name)
    copy.restore(original.save())
    for item in curved:
        original.step(item)
        copy.restore(original.save())
        assert copy.save() == original.save()


def drawn(rng: np.random.Generator, default: float, info: SettingInfo) -> float:
    """Return the default half of the time, else an end of the range or a number within it of any size."""
    u = rng.random()
    if u < 0.5:
        return default
    if isinstance(default, int):
        return int(rng.choice([info.low, info.high]))
    if u < 0.8:
        return float(info.low if u < 0.65 else info.high)
    return math.exp(rng.uniform(math.log(max(info.low, 1e-9 * info.high)), math.log(info.high)))


def extremes(rng: np.random.Generator) -> SpeedModelEstimator:
    """Return an estimator with random settings on a random train, half of them extreme."""
    infos = {item.name: info for item in fields(AmVffRlsConfig) if (info := setting_info(item)) is not None}
    default = AmVffRlsConfig()
    changes: dict[str, Any] = {name: drawn(rng, getattr(default, name), info) for name, info in infos.items()}
    config = replace(default, **changes)
    mass, gamma, std = (float(rng.choice(x)) for x in ((1.0, 1e3, 2e5, 1e9), (0.0, 0.08, 1.0), (0.0, 0.03, 0.5)))
    a, b, c = (float(rng.choice(x)) for x in ((0.0, 1.5, 100.0), (0.0, 0.03, 10.0), (0.0, 0.004, 1.0)))
    file = TrainFile(Train(mass, gamma, mass_std=std), Davis(a, b, c), Brake(1.0, 0.4, 0.6), effects=(CURVES,))
    return am_vff_rls(file, config)


@pytest.mark.parametrize('seed', [574, 638, 1487, 2566])
def test_states_of_extreme_settings_are_restored(sample: Make, seed: int) -> None:
    """Forgetting and rejected samples left correlations of the curve error above one with these seeds."""
    rng = np.random.default_rng(seed)
    original, copy = extremes(rng), extremes(np.random.default_rng(seed))
    mass = original._known.train_file.train.mass
    weight, speed, stamp_ns, share = 9.8 * mass / 1000.0, 12.0, 1_700_000_000 * NS_PER_S, rng.choice([0.0, 0.01, 0.1])

    def wild(value: float, spread: float, low: float, high: float) -> float:
        if rng.random() < share:
            return float(rng.choice([math.nan, low, high, rng.uniform(low, high)]))
        return float(np.clip(value + spread * rng.standard_normal(), low, high))

    for k in range(200):
        dt = float(rng.choice([0.02, 0.2, 0.2, 0.5, 1.0]))
        stamp_ns += round(dt * NS_PER_S)
        measured = wild(speed, 0.1, 0.0, 200.0)
        speed = min(max(speed + 0.3 * rng.standard_normal(), 0.0), 60.0)
        force = wild(0.0, 30.0 * weight, -1e8, 1e8)
        given = sample(
            stamp_ns=stamp_ns,
            dt=math.nan if k == 0 or rng.random() < 0.02 else dt,
            speed=0.0 if math.isnan(measured) else measured,
            force=force,
            force_mean=wild(force, weight, -1e8, 1e8),
            gradient_mean=wild(0.0, 5.0, -200.0, 200.0),
            curve_radius=float(rng.choice([0.0, 300.0, 20.0])),
            mass=wild(mass, 0.01 * mass, 100.0, 1e9) if rng.random() < 0.5 else math.nan,
            brake_command=-1.0 if rng.random() < 0.01 else 0.0,
        )
        original.step(given)
        copy.restore(original.save())
        assert copy.save() == original.save()
