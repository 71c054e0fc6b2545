# SPDX-License-Identifier: Apache-2.0
"""One pipeline for every driver: records in, outputs out.

Live nodes, bag replay and fleets push the same records into the same pipeline and copy what comes out;
no number is computed outside it.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

import numpy as np

from trainid_ros.brake_rate.brake_rate_algorithms import BRAKE_RATE
from trainid_ros.core.alignment import ONE_LOST, Aligner, AlignmentConfig, TimeJump
from trainid_ros.core.codec import check_restored, decode, encode
from trainid_ros.core.records import NS_PER_S, Record
from trainid_ros.core.results import (
    BrakeRateEstimate,
    Estimate,
    Reason,
    Rejection,
    ResistanceEstimate,
    SpeedModelEstimate,
    Status,
    stated_innovation,
)
from trainid_ros.core.samples import Sample
from trainid_ros.core.settings import check_settings, setting
from trainid_ros.estimators.consistency import Consistency, ConsistencyMonitor
from trainid_ros.estimators.drive_history import DriveHistoryState, DriveHistoryTracker
from trainid_ros.estimators.known_force import KnownForce
from trainid_ros.estimators.registry import Algorithms, Choice
from trainid_ros.estimators.sensor_correction import SensorCorrection
from trainid_ros.estimators.stuck_speed import StuckSpeed
from trainid_ros.resistance.resistance_algorithms import RESISTANCE
from trainid_ros.speed_model.speed_model_algorithms import SPEED_MODEL

if TYPE_CHECKING:
    from trainid_ros.estimators.protocol import Estimator
    from trainid_ros.train.train_file import TrainFile

EstimateT = TypeVar('EstimateT', bound=Estimate)

# Brake commands older than this, in samples, act no more.
_MOST_UNSTEPPED: Final = 300


class TimeJumpPolicy(Enum):
    """What to do when the stamps jump back (a bag starts over, a clock is set)."""

    RESET = 'reset'
    IGNORE = 'ignore'
    REFUSE = 'refuse'


@dataclass(frozen=True, slots=True)
class PipelineConfig:
    """Settings shared by all pipelines."""

    stale_after: float = setting(
        0.8, 'inputs missing this long make an estimate stale; 2.5 intervals of a slower topic', 's', 0.1, 60.0
    )
    time_jump_policy: TimeJumpPolicy = TimeJumpPolicy.RESET


@dataclass(frozen=True, slots=True)
class Output(Generic[EstimateT]):
    """What a driver publishes for one sample.

    Attributes:
        stamp_ns: Stamp of the newest sample used.
        estimate: What is believed now.
        status: Its health.
        used: Samples taken in by the estimator since the last reset.
        rejected: Records and samples not used since the last reset.
        last_refusal: The newest refusal, None if there was none.

    """

    stamp_ns: int
    estimate: EstimateT
    status: Status
    used: int
    rejected: int
    last_rejection: Rejection | None


@dataclass(frozen=True, slots=True)
class PipelineState:
    """What a pipeline saves: the estimator's state as text, and the drive so far."""

    estimator: str
    motion: DriveHistoryState


class EstimatorPipeline(Generic[EstimateT]):
    """Aligner, estimator and status of one estimate."""

    def __init__(
        self, estimator: Estimator[EstimateT], train_file: TrainFile, config: PipelineConfig, alignment: AlignmentConfig
    ) -> None:
        check_settings(config)
        check_settings(alignment)
        self.estimator = estimator
        self.config = config
        self._known = KnownForce(train_file)
        self._correction = SensorCorrection(train_file.effects)
        self._motion = DriveHistoryTracker(train_file)
        self._follows = bool(train_file.effects)
        reject_jump_back = config.time_jump_policy is TimeJumpPolicy.REFUSE
        self._aligner = Aligner(self._correction.widen(alignment), reject_jump_back=reject_jump_back)
        self._stale_ns = round((config.stale_after + abs(self._correction.skew_s)) * NS_PER_S)
        self.resets = 0
        self._clear()

    def _clear(self) -> None:
        self._correction.reset()
        self._motion.reset()
        self.rejections: Counter[Reason] = Counter()
        self.used = 0
        self.samples = 0
        self.last_rejection: Rejection | None = None
        self._speed = 0.0
        self._stuck = StuckSpeed(self._known)
        self._unstepped: tuple[Sample, ...] = ()
        self._sample_ns = 0
        self._first_ns = 0
        self._consistency = ConsistencyMonitor()
        self._status = Status.UNINITIALIZED
        self._published = self.estimator.estimate(self._speed)

    def reset(self) -> None:
        """Go back to the prior and forget all records and counters."""
        self.estimator.reset()
        self._aligner.reset()
        self._clear()
        self.resets += 1

    @property
    def status(self) -> Status:
        """Status of the newest output."""
        return self._status

    @property
    def consistency(self) -> Consistency:
        """Whether errors are as large as the estimates state; over recent samples used."""
        return self._consistency.current()

    @property
    def newest_ns(self) -> int:
        """Newest stamp taken in on any topic; 0 before the first."""
        return self._aligner.newest_ns

    def timeout_ns(self, kind: type[Record]) -> int:
        """Return how long a required topic may be silent until it is missing; longer for a slow one."""
        return max(round(self.config.stale_after * NS_PER_S), round(ONE_LOST * self._aligner.interval_ns(kind)))

    def push(self, record: Record) -> list[Output[EstimateT]]:
        """Take one record in; return an output for each sample it completes."""
        outputs: list[Output[EstimateT]] = []
        for event in self._aligner.push(self._correction.correct(record)):
            if isinstance(event, Sample):
                outputs.append(self._step(event))
            elif isinstance(event, Rejection):
                self._count(event)
            else:
                self._jump(event)
        self._first_ns = self._first_ns or self.newest_ns
        if self._inputs_missing() and self._status not in (Status.STALE, Status.FAULT):
            outputs.append(self.mark_stale())
        return outputs

    def _inputs_missing(self) -> bool:
        """True if a required topic is behind the others by too much, or has not begun in that time."""
        reached_ns = self._aligner.complete_ns or self._first_ns
        # A slow topic is behind the others until its next record: that is asked only where the first answer is yes.
        return self.newest_ns - reached_ns > self._stale_ns and self._aligner.is_behind(self._stale_ns)

    def mark_stale(self) -> Output[EstimateT]:
        """Tell that inputs are missing; the last estimate stands."""
        self._status = Status.STALE
        return self.current()

    def fail(self) -> Output[EstimateT]:
        """Tell that the estimator cannot go on; holds, with the estimate told last, until a reset or a restore."""
        self._status = Status.FAULT
        return self.current()

    def save(self) -> str:
        """Return the estimator's whole state and the drive so far as JSON text."""
        return encode(PipelineState(self.estimator.save(), self._motion.state))

    def restore(self, text: str) -> None:
        """Take over what an estimator had learned, possibly on another drive; InputError if it does not fit.

        Records taken in before are forgotten, so the estimator begins anew with the train's speed. Time and distance
        of the drive go on, for effects that depend on them.
        """
        state = decode(text, PipelineState)
        check_restored(state.motion.sound, 'PipelineState', 'motion')
        self.estimator.restore(state.estimator)
        self._motion.state = state.motion
        self._consistency.clear()
        self._aligner.reset()
        self._stuck, self._unstepped = StuckSpeed(self._known), ()
        self._first_ns = 0
        if self._status is Status.FAULT:
            self._status = Status.UNINITIALIZED

    def current(self) -> Output[EstimateT]:
        """Return what is believed now, without a new sample."""
        return Output(
            stamp_ns=self._sample_ns,
            estimate=self._published if self._status is Status.FAULT else self.estimator.estimate(self._speed),
            status=self._status,
            used=self.used,
            rejected=self.rejections.total(),
            last_rejection=self.last_rejection,
        )

    def _step(self, sample: Sample) -> Output[EstimateT]:
        if self._follows:
            sample = self._motion.follow(sample)
        result = self._stuck.reject(sample)
        if result is None:
            answer = self.estimator.step(self._after_gap(sample))
            result = answer if isinstance(answer, Rejection) else None
        else:
            self._unstepped = (*self._unstepped, sample)[-_MOST_UNSTEPPED:]
        self.samples += 1
        self._speed = sample.speed
        self._sample_ns = sample.stamp_ns
        if result is None:
            self.used += 1
        else:
            self._count(result)
        self._status = self._judge(result)
        output = self.current()
        self._published = output.estimate
        self._consistency.see(*stated_innovation(output.estimate), used=result is None)
        return output

    def _after_gap(self, sample: Sample) -> Sample:
        """Return a sample as it looks to an estimator that missed those before it."""
        if not self._unstepped:
            return sample
        missed, self._unstepped = self._unstepped, ()
        changes = tuple(change for item in (*missed, sample) for change in item.brake_changes)
        return replace(sample, dt=math.nan, brake_changes=changes, brake_gap=True)

    def _judge(self, rejection: Rejection | None) -> Status:
        if self._status is Status.FAULT:
            return Status.FAULT
        if self._inputs_missing():
            return Status.STALE
        if not self.estimator.converged or self._consistency.current().refuted:
            return Status.CONVERGING
        return Status.VALID if rejection is None else Status.HOLDING

    def _count(self, rejection: Rejection) -> None:
        if rejection.reason is Reason.THINNED:  # nothing is wrong with a topic faster than the period
            return
        self.rejections[rejection.reason] += 1
        self.last_rejection = rejection

    def _jump(self, jump: TimeJump) -> None:
        """Follow a jump of the stamps by the policy; the aligner has started over already."""
        self._first_ns = 0
        if jump.step_s < 0.0 and self.config.time_jump_policy is TimeJumpPolicy.RESET:
            self.estimator.reset()
            self._clear()
            self.resets += 1


@dataclass(frozen=True, slots=True)
class EstimatorSettings:
    """Everything that shapes the three estimators besides the train file."""

    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    resistance: Choice = field(default_factory=RESISTANCE.choose)
    speed_model: Choice = field(default_factory=SPEED_MODEL.choose)
    brake_rate: Choice = field(default_factory=BRAKE_RATE.choose)
    seed: int = 1


ResistancePipeline: TypeAlias = EstimatorPipeline[ResistanceEstimate]
SpeedModelPipeline: TypeAlias = EstimatorPipeline[SpeedModelEstimate]
BrakeRatePipeline: TypeAlias = EstimatorPipeline[BrakeRateEstimate]


def resistance_pipeline(train_file: TrainFile, settings: EstimatorSettings) -> ResistancePipeline:
    """Return the chosen resistance estimator behind its alignment."""
    return _pipeline(RESISTANCE, settings.resistance, train_file, settings)


def speed_model_pipeline(train_file: TrainFile, settings: EstimatorSettings) -> SpeedModelPipeline:
    """Return the chosen estimator of the speed model behind its alignment."""
    return _pipeline(SPEED_MODEL, settings.speed_model, train_file, settings)


def brake_rate_pipeline(train_file: TrainFile, settings: EstimatorSettings) -> BrakeRatePipeline:
    """Return the chosen brake rate estimator behind its alignment."""
    return _pipeline(BRAKE_RATE, settings.brake_rate, train_file, settings)


def _pipeline(
    algorithms: Algorithms[EstimateT], choice: Choice, train_file: TrainFile, settings: EstimatorSettings
) -> EstimatorPipeline[EstimateT]:
    """Each estimator draws from a generator of its own."""
    estimator = algorithms.make(choice, train_file, np.random.default_rng(settings.seed))
    return EstimatorPipeline(estimator, train_file, settings.pipeline, settings.alignment)
