# SPDX-License-Identifier: Apache-2.0
"""What a pipeline does about faults of its inputs: it withholds, goes back to an earlier state, and goes on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.results import Reason, Rejection, Status
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.stream.input_faults import Trust
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.forces import BrakeCommandChange
from trainid_ros.train.train_file import TrainFile

SETTINGS = EstimatorSettings()
# More than the motion between two snapshots, at 5 Hz [samples].
LONG = 620
Make = Callable[..., Sample]


class Learner:
    """An estimator that learns the number of samples, and publishes the prior of another one."""

    innovation = (0.0, 0.0)
    converged = True

    def __init__(self, other: Any) -> None:
        self._prior = other.estimate(0.0)
        self.reset()

    def reset(self) -> None:
        self.learned = 0
        self.last: Sample | None = None

    def step(self, sample: Sample) -> Rejection | None:
        self.learned += 1
        self.last = sample
        return None

    def estimate(self, _: float) -> Any:
        return self._prior

    def idle(self, _: float) -> None:
        pass

    def save(self) -> str:
        return json.dumps(self.learned)

    def restore(self, text: str) -> None:
        self.learned = json.loads(text)


class Drive:
    """A pipeline on a drive, with what its stream says of the inputs.

    Attributes:
        learner: Its estimator.
        pipeline: The pipeline.
        trust: What the stream says.
    """

    def __init__(self, make: Any, train_file: TrainFile, sample: Make) -> None:
        self.learner = Learner(make(train_file, SETTINGS).estimator)
        stream = SampleStream(StreamConfig(train_file))
        self.pipeline = EstimatorPipeline[Any](self.learner, stream, SETTINGS.pipeline)
        self.trust: Trust = self.pipeline.trust
        self._sample, self._count = sample, 0

    def status(self) -> Status:
        """Status of the estimate."""
        return self.pipeline.status

    def go(self, samples: int, **fields: Any) -> None:
        """Take in some samples."""
        for _ in range(samples):
            self.pipeline.take([self._sample(self._count, **fields)])
            self._count += 1


@pytest.fixture
def drive(train_file: TrainFile, sample: Make) -> Drive:
    return Drive(resistance_pipeline, train_file, sample)


def test_a_finding_makes_the_estimator_go_back_to_what_it_knew_some_minutes_before(drive: Drive) -> None:
    drive.go(2 * LONG + 50)
    drive.trust.finding, drive.trust.lasting_s = 'ato/force is in kN', 5.0
    rejection = Rejection(1, Reason.CONTRADICTION, math.nan, math.nan)
    drive.go(1, rejection=rejection)
    assert drive.learner.learned < LONG
    known = drive.learner.learned
    drive.go(100, rejection=rejection)
    assert drive.learner.learned == known
    assert drive.status() is Status.CONVERGING
    assert drive.pipeline.why_converging == 'inputs contradict each other'
    drive.trust.finding, drive.trust.lasting_s = '', 0.0
    drive.go(1)
    assert drive.learner.learned == known + 1
    assert drive.status() is Status.VALID
    assert drive.learner.last is not None
    assert math.isnan(drive.learner.last.dt)


def test_a_moment_of_contradiction_costs_its_samples_and_nothing_that_was_learned(drive: Drive) -> None:
    drive.go(LONG)
    drive.trust.finding = 'ato/brake_command alternates between values: two publishers?'
    drive.go(5, rejection=Rejection(1, Reason.CONTRADICTION, math.nan, math.nan))
    drive.trust.finding = ''
    drive.go(10)
    assert drive.learner.learned == LONG + 10


@pytest.mark.parametrize(('samples', 'goes_back'), [(20, True), (280, True), (320, False)])
def test_a_suspicion_that_passes_undoes_what_was_learned_unless_it_has_lasted(
    drive: Drive, samples: int, goes_back: bool
) -> None:
    drive.go(LONG + 200)
    drive.trust.suspicion = 'ato/force is late by about 1.2 s'
    drive.go(samples)
    assert drive.status() is Status.CONVERGING
    assert drive.pipeline.why_converging == 'it is suspected that ato/force is late by about 1.2 s'
    assert drive.learner.learned == LONG + 200 + samples
    drive.trust.suspicion = ''
    drive.go(1)
    assert drive.learner.learned < LONG if goes_back else drive.learner.learned == LONG + 201 + samples
    assert drive.status() is Status.VALID


def test_a_snapshot_taken_just_before_a_suspicion_is_not_trusted(drive: Drive) -> None:
    drive.go(2 * LONG)
    assert drive.pipeline._snapshots.moved_s < 20.0
    drive.trust.suspicion = 'ato/force is in kN'
    drive.go(20)
    drive.trust.suspicion = ''
    drive.go(1)
    assert drive.learner.learned < LONG


def test_no_state_is_kept_while_the_inputs_have_not_confirmed_each_other(drive: Drive) -> None:
    drive.trust.objection = 'the inputs have not yet confirmed each other'
    drive.go(2 * LONG)
    drive.trust.finding, drive.trust.lasting_s = 'ato/force is in kN', 5.0
    drive.go(1, rejection=Rejection(1, Reason.CONTRADICTION, math.nan, math.nan))
    assert drive.learner.learned == 0


def test_each_estimator_has_a_rejection_of_its_own(train_file: TrainFile, sample: Make) -> None:
    resistance, brake_rate = (
        Drive(resistance_pipeline, train_file, sample),
        Drive(brake_rate_pipeline, train_file, sample),
    )
    for drive in (resistance, brake_rate):
        drive.go(10)
        drive.go(5, brake_rejection=Rejection(1, Reason.CONTRADICTION, math.nan, math.nan))
    assert resistance.learner.learned == 15
    assert brake_rate.learner.learned == 10
    assert brake_rate.pipeline.rejections[Reason.CONTRADICTION] == 5


def test_the_first_sample_after_a_gap_states_all_commands_since_then(train_file: TrainFile, sample: Make) -> None:
    drive = Drive(resistance_pipeline, train_file, sample)
    drive.go(10)
    rejection = Rejection(1, Reason.CONTRADICTION, math.nan, math.nan)
    missed = BrakeCommandChange(7, -0.5)
    drive.go(1, rejection=rejection, brake_changes=(missed,), brake_command=-0.5)
    drive.go(3, rejection=rejection, brake_command=-0.5)
    text = drive.pipeline.save()
    drive.go(1, brake_command=-0.5)
    found = drive.learner.last
    assert found is not None
    assert found.brake_gap
    assert found.brake_changes == (missed, BrakeCommandChange(found.stamp_ns, -0.5))
    again = Drive(resistance_pipeline, train_file, sample)
    again.pipeline.restore(text)
    again.pipeline.take([replace(found, dt=0.2, brake_gap=False, brake_changes=())])
    assert repr(again.learner.last) == repr(found)  # where NaN is equal to itself
    drive.go(1, brake_command=-0.5)
    assert drive.learner.last is not None
    assert drive.learner.last.dt == 0.2
