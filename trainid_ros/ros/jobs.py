# SPDX-License-Identifier: Apache-2.0
"""The three estimation jobs and their nodes; importable without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.brake_rate.brake_rate_algorithms import BRAKE_RATE
from trainid_ros.errors import InputError
from trainid_ros.estimators.pipeline import brake_rate_pipeline, resistance_pipeline, speed_model_pipeline
from trainid_ros.messages import BRAKE_RATE_TOPIC, RESISTANCE_TOPIC, SPEED_MODEL_TOPIC, OutputTopic
from trainid_ros.resistance.resistance_algorithms import RESISTANCE
from trainid_ros.speed_model.speed_model_algorithms import SPEED_MODEL

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from trainid_ros.estimators.pipeline import EstimatorPipeline, EstimatorSettings
    from trainid_ros.estimators.registry import Algorithms
    from trainid_ros.train.train_file import TrainFile


@dataclass(frozen=True, slots=True)
class Job:
    """One estimate with its node, topics and algorithms.

    Attributes:
        field: Its name in EstimatorSettings, in pipelines and results.
        node_name: Name of the node.
        topic: Topic of the estimates.
        algorithms: Available algorithms.
        pipeline: Creates the pipeline.

    """

    field: str
    node_name: str
    topic: OutputTopic
    algorithms: Algorithms[Any]
    pipeline: Callable[[TrainFile, EstimatorSettings], EstimatorPipeline[Any]]


RESISTANCE_JOB: Final = Job(
    'resistance',
    'resistance_estimator',
    RESISTANCE_TOPIC,
    RESISTANCE,
    resistance_pipeline,
)
SPEED_MODEL_JOB: Final = Job(
    'speed_model', 'speed_model_estimator', SPEED_MODEL_TOPIC, SPEED_MODEL, speed_model_pipeline
)
BRAKE_RATE_JOB: Final = Job(
    'brake_rate',
    'brake_rate_estimator',
    BRAKE_RATE_TOPIC,
    BRAKE_RATE,
    brake_rate_pipeline,
)
JOBS: Final = (RESISTANCE_JOB, SPEED_MODEL_JOB, BRAKE_RATE_JOB)


def chosen_algorithms(wanted: Iterable[str]) -> dict[str, str]:
    """Return the chosen algorithms by the field of their job.

    Args:
        wanted: ``NAME``, or ``JOB=NAME`` where several jobs have an algorithm of that name.

    Raises:
        InputError: A job or algorithm does not exist, a name is ambiguous, or a job is given two algorithms.

    """
    chosen: dict[str, str] = {}
    for text in wanted:
        field, name = _find(text)
        if chosen.setdefault(field, name) != name:
            msg = f'algorithm: two given for {field}, {chosen[field]} and {name}'
            raise InputError(msg)
    return chosen


def _find(text: str) -> tuple[str, str]:
    field, equals, name = text.rpartition('=')
    if equals and field not in {job.field for job in JOBS}:
        msg = f'algorithm {text!r}: {field!r} must be one of {", ".join(job.field for job in JOBS)}'
        raise InputError(msg)
    among = [job for job in JOBS if job.field == field or not equals]
    # A built-in name means the same whatever plug-ins are installed.
    found = [job.field for job in among if name in job.algorithms.built_in]
    found = found or [job.field for job in among if name in job.algorithms]
    if len(found) == 1:
        return found[0], name
    if found:
        msg = f'algorithm {name!r} is ambiguous: use {" or ".join(f"{item}={name}" for item in found)}'
    else:
        choices = '; '.join(f'{job.field}: {", ".join(job.algorithms.names)}' for job in among)
        msg = f'algorithm {name!r} is unknown; there are {choices}{among[0].algorithms.hint}'
    raise InputError(msg)
