# SPDX-License-Identifier: Apache-2.0
"""Every registered algorithm does its job on a real day through the one protocol."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pytest

from trainid_ros.core.errors import InputError
from trainid_ros.core.records import Record
from trainid_ros.estimators.algorithms import Algorithms
from trainid_ros.estimators.brake_rate.algorithms import BRAKE_RATE
from trainid_ros.estimators.pipeline import (
    EstimatorPipeline,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.estimators.resistance.algorithms import RESISTANCE
from trainid_ros.estimators.speed_model.algorithms import SPEED_MODEL
from trainid_ros.physics.train_file import TrainFile

Make: TypeAlias = Any

ALL: list[tuple[str, Algorithms[Any], Make, str]] = [
    (field, algorithms, make, name)
    for field, algorithms, make in (
        ('resistance', RESISTANCE, resistance_pipeline),
        ('speed_model', SPEED_MODEL, speed_model_pipeline),
        ('brake_rate', BRAKE_RATE, brake_rate_pipeline),
    )
    for name in algorithms.names
]
IDS = [f'{field}-{name}' for field, _, _, name in ALL]


def pipeline(
    field: str, algorithms: Algorithms[Any], make: Make, name: str, train_file: TrainFile
) -> EstimatorPipeline[Any]:
    settings: Any = {field: algorithms.choose(name)}
    made: EstimatorPipeline[Any] = make(train_file, EstimatorSettings(**settings))
    return made


def numbers(estimate: Any) -> list[float]:
    values = [getattr(estimate, name) for name in estimate.__dataclass_fields__]
    return [float(x) for value in values for x in (value if isinstance(value, tuple) else (value,))]


@pytest.mark.parametrize(('field', 'algorithms', 'make', 'name'), ALL, ids=IDS)
def test_a_restored_copy_goes_on_to_the_bit(
    field: str, algorithms: Algorithms[Any], make: Make, name: str, metro: TrainFile, day: tuple[Record, ...]
) -> None:
    whole = pipeline(field, algorithms, make, name, metro)
    half = len(day) // 2
    for record in day[:half]:
        whole.push(record)
    copy = pipeline(field, algorithms, make, name, metro)
    copy.restore(whole.save())
    assert numbers(copy.estimator.estimate(10.0)) == pytest.approx(numbers(whole.estimator.estimate(10.0)), nan_ok=True)
    whole.restore(whole.save())
    for record in day[half:]:
        first, second = whole.push(record), copy.push(record)
        for one, other in zip(first, second, strict=True):
            assert np.array_equal(numbers(one.estimate), numbers(other.estimate), equal_nan=True)


@pytest.mark.parametrize(('field', 'algorithms', 'make', 'name'), ALL, ids=IDS)
def test_nothing_but_numbers_leaves(
    field: str, algorithms: Algorithms[Any], make: Make, name: str, metro: TrainFile, day: tuple[Record, ...]
) -> None:
    chosen = pipeline(field, algorithms, make, name, metro)
    outputs = [output for record in day for output in chosen.push(record)]
    assert chosen.used > 100
    assert all(np.isfinite([x for x in numbers(o.estimate) if x == x]).all() for o in outputs)  # noqa: PLR0124
    prior = numbers(pipeline(field, algorithms, make, name, metro).estimator.estimate(10.0))
    chosen.reset()
    assert numbers(chosen.estimator.estimate(10.0)) == pytest.approx(prior, nan_ok=True)


def test_an_unknown_name_is_told() -> None:
    with pytest.raises(InputError, match=r"algorithm = 'XYZ' must be one of V-MILS"):
        RESISTANCE.choose('XYZ')


def test_settings_are_changed_by_name() -> None:
    assert RESISTANCE.choose().algorithm == RESISTANCE.default == 'V-MILS'
    assert RESISTANCE.choose(hop=5).config != RESISTANCE.choose().config
