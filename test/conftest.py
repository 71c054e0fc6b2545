# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: a train with exactly known motion, records of the shipped day, an explanation."""

from __future__ import annotations

import gc
import math
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.yizhuang_day import yizhuang_day
from trainid_ros.explain.likelihood import Noise
from trainid_ros.explain.nuisances import Spread
from trainid_ros.explain.result import (
    Explanation,
    FoundEffect,
    Gap,
    Learned,
    Location,
    Place,
    RunTrace,
    Verdict,
)
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.sim.scenario import simulate
from trainid_ros.stream.samples import Sample, coasting_sample
from trainid_ros.train.effects import Twin
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import Brake, Davis, Effect, Line, Train, TrainFile, load_train_file

STATED = TrainFile(
    Train(mass=194e3),
    Davis(1.5, 0.02, 0.001),
    line=Line(stops=(0.0, 900.0), curve=((0.0, 0.0), (100.0, 400.0), (200.0, 0.0)), tunnel=((600.0, 700.0),)),
)
DRAG = FoundEffect(
    name='local_drag',
    title='drag at one place',
    equation='w = permille between start and end',
    origin='physics',
    parameters=(('start', 300.0), ('end', 500.0), ('permille', 1.5)),
    std=(('start', 12.0), ('end', 9.0), ('permille', 0.05)),
    evidence=48.0,
    significance=30.0,
    probability=0.97,
    where='position 300 to 500 m (+1.50 N/kN)',
    twins=(),
)
TWIN = Twin('gradient_error', 'run <both> ways')
NAN = (math.nan, math.nan)

# A shell ignores SIGINT in what it starts in the background, and so would the programs that tests stop by it.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest test first, so that no process is left with it when the others have ended."""
    items.sort(key=lambda item: item.path.name != 'test_compiled.py')


def pytest_collection_finish() -> None:
    """Keep modules and collected tests out of garbage collection, which otherwise takes an eighth of the time."""
    gc.freeze()


def trace(direction: int) -> RunTrace:
    time = np.arange(0.0, 60.0)
    position = 15.0 * time if direction > 0 else 900.0 - 15.0 * time
    gap = 0.3 * np.sin(time / 10.0)
    return RunTrace(0, direction, time, position, np.full(60, 15.0), gap, 0.1 * gap, np.full(60, 0.05))


@pytest.fixture(scope='session')
def stated() -> TrainFile:
    """Return the train file of the explanation."""
    return STATED


@pytest.fixture(scope='session')
def make_learned() -> Callable[..., Learned]:
    """Return a factory of a curve over the speed while braking, confirmed with its effect; fields can be overridden."""
    x = np.linspace(0.0, 20.0, 5)
    learned = Learned(
        'brake-speed', 'the speed while braking', 'm/s', 'the brake force', 90.0, (),
        x, 0.01 * x, np.full(5, 0.002),
        Gap(0.4, 0.05, 0.049, 2, 0.3, 0.04, 25.0), is_confirmed=True, function='0.01 * x',
        effect='learned_brake_speed', source='EFFECT = None\n', train_file=STATED,
    )  # fmt: skip
    return partial(replace, learned)


@pytest.fixture(scope='session')
def make_explanation() -> Callable[..., Explanation]:
    """Return a factory of an explanation with one effect; fields can be overridden."""
    parts = tuple(
        Place(f'{100 * k} to {100 * k + 100} m', 100.0 * k, 100.0 * k + 100.0, 1.5 * (k in (3, 4)), 0.01, 0.1, 0.1)
        for k in range(9)
        if k != 6  # no data there
    )
    modes = tuple(Place(name, *NAN, 0.3, 0.1, 0.2, 0.5) for name in ('traction', 'coasting'))
    runs = tuple(Place(str(k), *NAN, 9.0, 9.0, 0.1, 0.1) for k in range(20))
    explained = Explanation(
        verdict=Verdict.EXPLAINED,
        effects=(DRAG,),
        gap=Gap(0.4, 0.05, 0.049, 2, 0.3, 0.04, 25.0),
        remaining='What is left is noise.',
        train_file=replace(
            STATED, resistance=Davis(1.61, 0.02, 0.0011), effects=(Effect('local_drag', DRAG.parameters, DRAG.std),)
        ),
        davis=Davis(1.61, 0.02, 0.0011),
        davis_std=(0.12, 0.004, 0.0001),
        davis_distance=5.2,
        locations=(Location('position', 'm', parts), Location('mode', '', modes), Location('run', '', runs)),
        traces=(trace(1), trace(-1)),
        noise=Noise(0.02, 0.1, 4.0, 0.0),
        spread=Spread(0.003, 0.002, 0.1),
        outliers=0.012,
        weighed=True,
        gradient_point=None,
        other=0.0,
        probabilities=(('local_drag', 0.97), ('gradient_error', 0.025), ('other', 0.004), ('none', 0.001)),
    )

    def make(*, ambiguous: bool = False, **changes: Any) -> Explanation:
        if ambiguous:
            changes = {'verdict': Verdict.AMBIGUOUS, 'effects': (replace(DRAG, twins=(TWIN,)),), **changes}
        return replace(explained, **changes)

    return make


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
    return load_train_file(Path(__file__).parents[1] / 'config' / 'trains' / 'yizhuang.yaml')


@pytest.fixture(scope='session')
def day(metro: TrainFile) -> tuple[Record, ...]:
    """Return the records of two runs of the shipped day: seven minutes, as in the bag ``tiny``."""
    return simulate(yizhuang_day(metro, runs=2), np.random.default_rng(2015)).records


@pytest.fixture(scope='session')
def sample() -> Callable[..., Sample]:
    """Return a factory of samples of a train coasting at 15 m/s; fields can be overridden."""

    def make(index: int = 0, **fields: Any) -> Sample:
        plain = coasting_sample(START + index * NS_PER_S // 5, math.nan if index == 0 else 0.2, 15.0)
        return replace(plain, **{'position': 1000.0 + 3.0 * index, **fields})

    return make


@pytest.fixture(scope='session')
def journey(sample: Callable[..., Sample]) -> Callable[..., list[Sample]]:
    """Return a factory of uphill journeys; traction, brake, rate and resistance are functions of time [s]."""

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
            target = brake(t)
            changes = (BrakeCommandChange(START + i * NS_PER_S // 5, target),) if target != command else ()
            command = target
            commands.append(command)
            specific_traction = traction(t)
            traction_force = specific_traction * MASS * G / 1000.0
            reported = traction_force + MASS * (1.0 + GAMMA) * actuator
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
                driven = (specific_traction - GRADIENT) / INERTIA + f * 0.5 * (actuator + after)
                middle = v + 0.5 * h * (driven - (w.a + w.b * v + w.c * v * v) / INERTIA)
                v_next = max(0.0, v + h * (driven - (w.a + w.b * middle + w.c * middle * middle) / INERTIA))
                position += 0.5 * h * (v + v_next)
                total += traction_force + MASS * (1.0 + GAMMA) * 0.5 * (actuator + after)
                v, actuator = v_next, after
            force_mean = total / SUBSTEPS
        return samples

    return drive
