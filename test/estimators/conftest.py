# SPDX-License-Identifier: Apache-2.0
"""A train whose motion is known exactly: samples without aligner or simulator. And two runs of the shipped day."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainid_ros.core.records import NS_PER_S, Record
from trainid_ros.core.samples import BrakeCommandChange, Sample
from trainid_ros.physics.train_file import Brake, Davis, Train, TrainFile, load_train_file
from trainid_ros.simulation.scenario import simulate
from trainid_ros.simulation.yizhuang_day import yizhuang_day

START = 1_700_000_000 * NS_PER_S
MASS, GAMMA, G = 200e3, 0.08, 9.80665
INERTIA = 1000.0 * (1.0 + GAMMA) / G
SUBSTEPS = 8
GRADIENT = 6.0


@pytest.fixture(scope='session')
def train_file() -> TrainFile:
    return TrainFile(Train(MASS, GAMMA, 100.0), Davis(1.5, 0.03, 0.004), Brake(1.0, 0.4, 0.6))


@pytest.fixture(scope='session')
def metro() -> TrainFile:
    """Return the train file of the shipped day."""
    return load_train_file(Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml')


@pytest.fixture(scope='session')
def day(metro: TrainFile) -> tuple[Record, ...]:
    """Return the records of two runs of the shipped day: seven minutes, as long as the bag ``tiny``."""
    return simulate(yizhuang_day(metro, runs=2), np.random.default_rng(2015)).records


@pytest.fixture(scope='session')
def sample() -> Callable[..., Sample]:
    """Return the maker of a sample of a train that coasts at 15 m/s; fields can be given."""

    def make(index: int = 0, **fields: Any) -> Sample:
        plain = Sample(
            stamp_ns=START + index * NS_PER_S // 5,
            dt=math.nan if index == 0 else 0.2,
            speed=15.0,
            position=1000.0 + 3.0 * index,
            direction=1,
            force=0.0,
            force_mean=0.0,
            gradient=0.0,
            gradient_mean=0.0,
            curve_radius=0.0,
            tunnel=False,
            mass=math.nan,
            brake_command=0.0,
            brake_changes=(),
            brake_gap=False,
            emergency=False,
        )
        return replace(plain, **fields)

    return make


@pytest.fixture(scope='session')
def journey(sample: Callable[..., Sample]) -> Callable[..., list[Sample]]:
    """Return the maker of a journey up a gradient; traction, brake, rate and resistance are functions of time [s]."""

    def drive(
        seconds: float,
        *,
        traction: Callable[[float], float] = lambda _: 0.0,
        resistance: Callable[[float], Davis] = lambda _: Davis(1.8, 0.02, 0.005),
        brake: Callable[[float], float] = lambda _: 0.0,
        rate: Callable[[float], float] = lambda _: 1.0,
        speed: float = 15.0,
        noise: float = 0.02,
        seed: int = 0,
    ) -> list[Sample]:
        """Integrate the balance in steps of 25 ms; traction [N/kN], brake command [m/s^2] held over a sample."""
        rng = np.random.default_rng(seed)
        samples: list[Sample] = []
        v, position, actuator, command, force_mean = speed, 0.0, 0.0, math.nan, 0.0
        commands: list[float] = []
        lag = round(0.6 / 0.2)
        for i in range(round(5.0 * seconds)):
            t = 0.2 * i
            wanted = brake(t)
            changes = (BrakeCommandChange(START + i * NS_PER_S // 5, wanted),) if wanted != command else ()
            command = wanted
            commands.append(command)
            pull_kn = traction(t)
            pull = pull_kn * MASS * G / 1000.0
            reported = pull + MASS * (1.0 + GAMMA) * actuator
            measured = max(0.0, v + noise * float(rng.standard_normal())) if v > 0.0 else 0.0
            samples.append(
                sample(
                    i,
                    speed=measured,
                    position=position,
                    force=reported,
                    force_mean=force_mean,
                    gradient=GRADIENT,
                    gradient_mean=GRADIENT,
                    brake_command=command,
                    brake_changes=changes,
                )
            )
            delayed = commands[i - lag] if i >= lag else 0.0
            w, f, total = resistance(t), rate(t), 0.0
            for _ in range(SUBSTEPS):
                h = 0.2 / SUBSTEPS
                after = delayed + (actuator - delayed) * math.exp(-h / 0.4)
                pushed = (pull_kn - GRADIENT) / INERTIA + f * 0.5 * (actuator + after)
                middle = v + 0.5 * h * (pushed - (w.a + w.b * v + w.c * v * v) / INERTIA)
                v_next = max(0.0, v + h * (pushed - (w.a + w.b * middle + w.c * middle * middle) / INERTIA))
                position += 0.5 * h * (v + v_next)
                total += pull + MASS * (1.0 + GAMMA) * 0.5 * (actuator + after)
                v, actuator = v_next, after
            force_mean = total / SUBSTEPS
        return samples

    return drive
