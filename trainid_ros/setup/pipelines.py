# SPDX-License-Identifier: Apache-2.0
"""The three kinds of estimators: their algorithms, settings and pipelines, and what they find wrong in a train file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, Generic

import numpy as np

from trainid_ros.brake_rate.brake_rate_estimator import BrakeRateEstimator
from trainid_ros.brake_rate.gsma import Gsma
from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms, Choice
from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineConfig
from trainid_ros.estimators.settings import AmVffRlsConfig, FilterBankConfig, GsmaConfig, VMilsConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    ADHESION_TOPIC,
    BRAKE_RATE_TOPIC,
    RESISTANCE_TOPIC,
    SPEED_MODEL_TOPIC,
    OutputTopic,
)
from trainid_ros.interface.results import BrakeRateEstimate, EstimateT, ResistanceEstimate, SpeedModelEstimate
from trainid_ros.resistance.davis_posterior import is_delay_at_end
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
        'GSMA', 'group stochastic M-algorithm, corrected: particles that drift or jump; the default', GsmaConfig(), Gsma
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


@dataclass(frozen=True, slots=True)
class EstimatorKind(Generic[EstimateT]):
    """One kind of estimator, with its node, topic and algorithms."""

    algorithms: Algorithms[EstimateT]  # Available algorithms
    topic: OutputTopic  # Topic of the estimates
    # Topic of the adhesion, None if another node publishes it: it comes with the samples of all
    adhesion: OutputTopic | None = None

    @property
    def topics(self) -> tuple[OutputTopic, ...]:
        """All topics of its node."""
        return (self.topic,) if self.adhesion is None else (self.topic, self.adhesion)

    @property
    def name(self) -> str:
        """Its name in EstimatorSettings, in pipelines and results."""
        return self.algorithms.kind

    @property
    def node_name(self) -> str:
        """Name of its node."""
        return f'{self.name}_estimator'

    def pipeline(self, train_file: TrainFile, settings: EstimatorSettings) -> EstimatorPipeline[EstimateT]:
        """Return the chosen estimator behind its alignment; each draws from a random generator of its own."""
        choice: Choice = getattr(settings, self.name)
        estimator = self.algorithms.make(choice, train_file, np.random.default_rng(settings.seed))
        stream = SampleStream(StreamConfig(train_file, settings.alignment, settings.pipeline.time_jump_policy))
        return EstimatorPipeline(estimator, stream, settings.pipeline)


RESISTANCE_KIND: Final = EstimatorKind(RESISTANCE, RESISTANCE_TOPIC)
SPEED_MODEL_KIND: Final = EstimatorKind(SPEED_MODEL, SPEED_MODEL_TOPIC)
BRAKE_RATE_KIND: Final = EstimatorKind(BRAKE_RATE, BRAKE_RATE_TOPIC, ADHESION_TOPIC)
KINDS: Final[tuple[EstimatorKind[Any], ...]] = (RESISTANCE_KIND, SPEED_MODEL_KIND, BRAKE_RATE_KIND)

resistance_pipeline: Final = RESISTANCE_KIND.pipeline
speed_model_pipeline: Final = SPEED_MODEL_KIND.pipeline
brake_rate_pipeline: Final = BRAKE_RATE_KIND.pipeline


def chosen_algorithms(wanted: Iterable[str]) -> dict[str, str]:
    """Return algorithms by kind of estimator, each chosen as ``NAME``, or ``KIND=NAME`` where several kinds have it.

    InputError if a kind or algorithm does not exist, a name is ambiguous, or a kind is given two algorithms.
    """
    chosen: dict[str, str] = {}
    for text in wanted:
        kind, name = _find(text)
        if chosen.setdefault(kind, name) != name:
            raise InputError(f'algorithm: two given for {kind}, {chosen[kind]} and {name}')
    return chosen


def _find(text: str) -> tuple[str, str]:
    wanted, equals, name = text.rpartition('=')
    if equals and wanted not in {kind.name for kind in KINDS}:
        raise InputError(f'algorithm {text!r}: {wanted!r} must be one of {", ".join(kind.name for kind in KINDS)}')
    among = [kind for kind in KINDS if kind.name == wanted or not equals]
    # A built-in name means the same whatever plug-ins are installed.
    found = [kind.name for kind in among if name in kind.algorithms.built_in]
    found = found or [kind.name for kind in among if name in kind.algorithms]
    if len(found) == 1:
        return found[0], name
    if found:
        raise InputError(f'algorithm {name!r} is ambiguous: use {" or ".join(f"{item}={name}" for item in found)}')
    choices = '; '.join(f'{kind.name}: {", ".join(kind.algorithms.names)}' for kind in among)
    problem = next((kind.algorithms.problem for kind in among if kind.algorithms.problem), '')
    raise InputError(problem or f'algorithm {name!r} is unknown; there are {choices}{among[0].algorithms.hint}')


def brake_findings(pipeline: EstimatorPipeline[Any]) -> tuple[str, ...]:
    """Return a sentence for the rate over speed and one for times, if they are wrong; none for other estimates."""
    if not isinstance(pipeline.estimator, BrakeRateEstimator):
        return ()
    return tuple(filter(None, (pipeline.stream.faults.brake_warning, pipeline.estimator.timing_finding)))


_LEAST_SHARE: Final = 0.01  # error of a force, or of a wheel beside it, that is large enough to matter
_LEAST_DELAY_S: Final = 0.1  # s: the same of its times: half a sample period
_SIGMAS: Final = 4.0  # standard deviations by which it must differ from 0
_WORN: Final = 0.1  # share of the diameter that wheels lose until they are scrapped (920 to 840 mm): more is no wheel


def wheel_findings(ratio: float, std: float, stated: float) -> tuple[str, ...]:
    """Return a sentence if measured over true speed, with its standard deviation, is not as the train file states."""
    if abs(ratio - stated) <= max(_LEAST_SHARE, _SIGMAS * std) or abs(ratio - 1.0) > _WORN:
        return ()
    return (f'wheel ratio {ratio:.4f} ± {std:.2g}: state the effect wheel_diameter with ratio: {ratio:.4f}',)


def force_findings(estimate: ResistanceEstimate) -> tuple[str, ...]:
    """Return one sentence per significant error of the reported force; none where it is not estimated."""
    scale, delay = estimate.force_scale - 1.0, estimate.force_delay
    found = []
    if abs(scale) > max(_LEAST_SHARE, _SIGMAS * estimate.force_scale_std):
        value = f'{estimate.force_scale:.3f} ± {estimate.force_scale_std:.3f}'
        found.append(f'force scale {value}: ato/force or the mass (ato/mass or train.mass) is off')
    if abs(delay) > max(_LEAST_DELAY_S, _SIGMAS * estimate.force_delay_std):
        sense = 'later' if delay > 0.0 else 'earlier'
        value = f'{abs(delay):.2f} ± {estimate.force_delay_std:.2g} s'
        if is_delay_at_end(delay):
            value = f'{abs(delay):.1f} s or more, which cannot be estimated'
        found.append(f'force delay {value}: ato/force is stamped {sense} than it acts')
    return tuple(found)
