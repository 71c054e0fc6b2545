# SPDX-License-Identifier: Apache-2.0
"""Settings of the nodes without running them: the same parameter file, checks and settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.errors import InputError
from trainid_ros.ros.jobs import JOBS, chosen_algorithms
from trainid_ros.ros.parameter_specs import (
    ALGORITHM,
    TRAIN_PARAMETERS,
    build_settings,
    build_train_file,
    check_fallback,
    check_problems,
    estimator_parameters,
    qos_overrides,
    requested_algorithm,
    validate_overrides,
)
from trainid_ros.ros.params_file import find_mismatch, read_overrides

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from trainid_ros.estimators.pipeline import EstimatorPipeline, EstimatorSettings
    from trainid_ros.ros.jobs import Job
    from trainid_ros.train.train_file import TrainFile

# Parameters that ROS adds to every node.
_OF_ROS: Final = ('use_sim_time', 'start_type_description_service')


@dataclass(frozen=True, slots=True)
class Setup:
    """Train file and settings that one node would run with."""

    job: Job
    train_file: TrainFile
    settings: EstimatorSettings

    @property
    def algorithm(self) -> str:
        """Name of the algorithm."""
        return str(getattr(self.settings, self.job.field).algorithm)

    def pipeline(self) -> EstimatorPipeline[Any]:
        """Return the pipeline that the node would run."""
        return self.job.pipeline(self.train_file, self.settings)


def node_setups(
    train_file: TrainFile,
    source: str,
    params: Path | None = None,
    algorithms: Sequence[str] = (),
    *,
    namespace: str = '/',
    warn: Callable[[str], None] = lambda _: None,
) -> tuple[Setup, ...]:
    """Return the train file and settings that the three nodes would run with.

    Args:
        train_file: Train file of the nodes.
        source: Its name, for messages.
        params: Parameter file, None for defaults.
        algorithms: Algorithms that replace those in the file, see :func:`chosen_algorithms`.
        namespace: Namespace of the nodes.
        warn: Called with each warning.

    Raises:
        InputError: The file cannot be read, or a node would fail to configure; the message names node and reason.

    """
    chosen = chosen_algorithms(algorithms)
    base = '/' + namespace.strip('/') if namespace.strip('/') else ''
    setups = []
    for job in JOBS:
        overrides = {} if params is None else _given(job, params, f'{base}/{job.node_name}', warn)
        if job.field in chosen:
            overrides[ALGORITHM] = chosen[job.field]
        topics = qos_overrides(job, lambda topic: f'{base}/{topic}')
        setups.append(_setup(job, train_file, source, overrides, {*_OF_ROS, *topics}))
    return tuple(setups)


def _given(job: Job, params: Path, node: str, warn: Callable[[str], None]) -> dict[str, object]:
    overrides = read_overrides(params, node)
    if (found := find_mismatch(params, node, job.node_name)) is not None:
        message, certain = found
        if certain:
            raise InputError(message)
        warn(message)
    return overrides


def _setup(
    job: Job, train_file: TrainFile, source: str, overrides: Mapping[str, object], others: Collection[str]
) -> Setup:
    algorithm = requested_algorithm(overrides, job.algorithms)
    specs = {spec.name: spec for spec in estimator_parameters(job.algorithms, algorithm)}
    given, problems = validate_overrides(overrides, specs, others)
    fallback = {item.name: item.of(train_file) for item in TRAIN_PARAMETERS if item.name not in given}
    try:
        check_problems(problems)
        check_fallback(fallback, specs, source)
        values = {name: spec.default for name, spec in specs.items()} | fallback | given
        settings = build_settings(values, job.algorithms, job.field)
        return Setup(job, build_train_file(values, frozenset(given), train_file), settings)
    except InputError as error:
        msg = f'{job.node_name}: {error}'
        raise InputError(msg) from None
