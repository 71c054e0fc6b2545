# SPDX-License-Identifier: Apache-2.0
"""Pipelines of the three kinds of estimators by name, and what they publish."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

from trainid_ros.estimators.algorithm_registry import Estimator
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.records import Record
from trainid_ros.interface.results import Output
from trainid_ros.setup.pipelines import KINDS, RESISTANCE, EstimatorSettings
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

EstimatorT = TypeVar('EstimatorT', bound=Estimator[Any])
NAMES = tuple(kind.name for kind in KINDS)
SETTINGS = EstimatorSettings()


def make(name: str, train_file: TrainFile, settings: EstimatorSettings = SETTINGS) -> EstimatorPipeline[Any]:
    """Return the pipeline of a kind of estimator, or of V-MILS."""
    if name == 'V-MILS':
        return make('resistance', train_file, EstimatorSettings(resistance=RESISTANCE.choose(name)))
    return KINDS[NAMES.index(name)].pipeline(train_file, settings)


def run(pipeline: EstimatorPipeline[Any], records: Iterable[Record]) -> list[Output[Any]]:
    return [output for record in records for output in pipeline.push(record)]


def stepped(estimator: EstimatorT, samples: Iterable[Sample]) -> EstimatorT:
    """Return an estimator after some samples."""
    for sample in samples:
        estimator.step(sample)
    return estimator
