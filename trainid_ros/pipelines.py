# SPDX-License-Identifier: Apache-2.0
"""The three estimators, each with the algorithm that its settings choose, in a pipeline of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from trainid_ros.brake_rate.brake_rate_algorithms import BRAKE_RATE
from trainid_ros.estimators.algorithm_registry import Algorithms, Choice
from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineConfig
from trainid_ros.interface.results import BrakeRateEstimate, EstimateT, ResistanceEstimate, SpeedModelEstimate
from trainid_ros.resistance.resistance_algorithms import RESISTANCE
from trainid_ros.speed_model.speed_model_algorithms import SPEED_MODEL
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.train.train_file import TrainFile


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
    stream = SampleStream(StreamConfig(train_file, settings.alignment, settings.pipeline.time_jump_policy))
    return EstimatorPipeline(estimator, stream, settings.pipeline)
