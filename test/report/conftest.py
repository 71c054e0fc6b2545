# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a synthetic drive with known values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.interface.results import (
    BrakeRateEstimate,
    Output,
    Reason,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
)
from trainid_ros.report.drive_report import Chapter
from trainid_ros.report.recording import Recorder
from trainid_ros.sim.truth import Truth
from trainid_ros.train.train_file import Davis, Train, TrainFile

START_NS = 1_700_000_000 * NS_PER_S
RESISTANCE = ResistanceEstimate(
    a=1.6, b=0.02, c=0.001, covariance=(0.04, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-8), resistance=1.9,
    resistance_std=0.2, speed=10.0, innovation=0.1, innovation_variance=0.04, test_ratio=0.02, speed_min=2.0,
    speed_max=20.0, resistance_std_max=0.3,
)  # fmt: skip
MODEL = SpeedModelEstimate(
    a1=-1e-5, a2=0.999, b1=0.0018, d0=-0.004, covariance=(0.0,) * 16, forgetting_factor=1.0, predicted_speed=10.0,
    prediction_error=0.0, a=1.5, b=0.02, c=0.001, mass_factor=1.08,
)  # fmt: skip
BRAKE = BrakeRateEstimate(
    brake_rate=0.9, brake_rate_std=0.05, position=0.0, speed=10.0, control_acceleration=0.0, filtered_target=0.0,
    effective_particles=100.0, observable=False, innovation=0.01, innovation_variance=0.001, test_ratio=0.01,
)  # fmt: skip
TRUTH = Truth(START_NS, ((0.0, 1.5, 0.02, 0.001), (60.0, 1.7, 0.02, 0.001)), ((0.0, 1.0), (60.0, 0.9)))
TRAIN = TrainFile(Train(mass=194e3), Davis(1.4, 0.02, 0.001))


def inputs(i: int) -> tuple[Record, ...]:
    """Return the inputs of second ``i``: cycles of traction, coasting, braking and standstill for 30 s each."""
    stamp, mode = START_NS + i * NS_PER_S, i // 30 % 4
    return (
        ForceRecord(stamp, 2e5 if mode == 0 else 0.0),
        GradientRecord(stamp, 3.0, 0.0, tunnel=False),
        BrakeRecord(stamp, -0.6 if mode >= 2 else 0.0, emergency=False),
        SpeedRecord(stamp, 0.0 if mode == 3 else 10.0, float(i)),
    )


def output(i: int, estimate: ResistanceEstimate | SpeedModelEstimate | BrakeRateEstimate, status: Status) -> Output:  # type: ignore[type-arg]
    return Output(START_NS + i * NS_PER_S, estimate, status, i, 5, None)


@pytest.fixture(scope='session')
def make_chapter() -> Callable[..., Chapter]:
    """Return a function that makes the chapter of a drive of a given duration [s]."""

    def make(seconds: int = 240, *, truth: Truth | None = TRUTH, braking: bool = True) -> Chapter:
        recorder = Recorder()
        for i in range(seconds):
            for record in inputs(i):
                recorder.add_record(record)
            status = Status.CONVERGING if i < 20 else Status.VALID if i // 30 % 4 < 2 else Status.HOLDING
            recorder.on_output(output(i, replace(RESISTANCE, innovation=0.001 * i), status))
            recorder.on_output(output(i, MODEL, status))
            observable = braking and i // 30 % 4 == 2
            recorder.on_output(output(i, replace(BRAKE, observable=observable), status))
        return Chapter(
            title='Trial <1>',
            bag='bags/trial',
            train_file_name='train.yaml',
            train_file=TRAIN,
            how='off line',
            recording=recorder.finish(),
            resistance=output(seconds, RESISTANCE, Status.HOLDING),
            speed_model=output(seconds, MODEL, Status.HOLDING),
            brake_rate=output(seconds, BRAKE, Status.HOLDING),
            rejections={
                'resistance': {Reason.BRAKING: 60, Reason.STANDSTILL: 60},
                'brake rate': {Reason.NOT_BRAKING: 120},
            },
            truth=truth,
            notes=('a note',),
        )

    return make
