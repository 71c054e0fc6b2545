# SPDX-License-Identifier: Apache-2.0
"""The three estimators: the algorithms of each, and its pipeline with the algorithm that the settings choose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms, Choice
from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineConfig
from trainid_ros.estimators.settings import AmVffRlsConfig, FilterBankConfig, GsmaConfig, VMilsConfig
from trainid_ros.interface.results import BrakeRateEstimate, EstimateT, ResistanceEstimate, SpeedModelEstimate
from trainid_ros.resistance.filter_bank import FilterBank
from trainid_ros.resistance.vmils import VMils
from trainid_ros.speed_model.am_vff_rls import AuxiliaryModel, Symmetric, Theta, Tuning
from trainid_ros.speed_model.speed_model_estimator import SpeedModelEstimator, load_std
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.stream.sample_stream import SampleStream, StreamConfig
from trainid_ros.stream.samples import SAMPLE_PERIOD
from trainid_ros.train.train_file import TrainFile

RESISTANCE: Final = Algorithms[ResistanceEstimate](
    'resistance',
    Algorithm(
        'filter-bank',
        'change-point bank of Kalman filters on raw speed, with the force errors as states; default',
        FilterBankConfig(),
        lambda train_file, config, _: FilterBank(train_file, config),
    ),
    Algorithm(
        'V-MILS',
        'interval-varying multi-innovation least squares on speed windows; less computing time',
        VMilsConfig(),
        lambda train_file, config, _: VMils(train_file, config),
    ),
)


def am_vff_rls(train_file: TrainFile, config: AmVffRlsConfig) -> SpeedModelEstimator:
    """Return an estimator of a1, a2, b1, d0 from aligned samples by AM-VFF-RLS."""

    def method(theta0: Theta, P0: Symmetric) -> AuxiliaryModel:
        b1 = theta0[2]
        tuning = Tuning(
            noise=0.0,
            drift=(config.drift * b1) ** 2 * SAMPLE_PERIOD,
            load=(load_std(train_file, config) * b1) ** 2,
            share=1.0 / config.memory,
            threshold=config.threshold,
            scale=config.forgetting_scale,
            low=config.min_forgetting,
            gate=config.gate,
            gate_floor=config.gate_floor,
        )
        return AuxiliaryModel(theta0, P0, tuning)

    return SpeedModelEstimator(train_file, config, method)


SPEED_MODEL: Final = Algorithms[SpeedModelEstimate](
    'speed_model',
    Algorithm(
        'AM-VFF-RLS',
        'recursive least squares with auxiliary model and variable forgetting; the default',
        AmVffRlsConfig(),
        lambda train_file, config, _: am_vff_rls(train_file, config),
    ),
)
BRAKE_RATE: Final = Algorithms[BrakeRateEstimate](
    'brake_rate',
    Algorithm(
        'GSMA',
        'group stochastic M-algorithm, corrected: particles that drift or jump; the default',
        GsmaConfig(),
        Gsma,
    ),
)


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
