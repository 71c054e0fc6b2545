# SPDX-License-Identifier: Apache-2.0
"""Every registered algorithm does its job on a real day through the one protocol."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np
import pytest

from trainid_ros.core.alignment import Aligner, AlignmentConfig
from trainid_ros.core.errors import InputError
from trainid_ros.core.records import NS_PER_S, Record, SpeedRecord
from trainid_ros.core.samples import Sample
from trainid_ros.core.settings import setting_info
from trainid_ros.estimators.algorithms import Algorithms
from trainid_ros.estimators.brake_rate.algorithms import BRAKE_RATE
from trainid_ros.estimators.pipeline import (
    EstimatorPipeline,
    EstimatorSettings,
    Output,
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


@dataclass(frozen=True)
class Drive:
    """Four minutes with an algorithm, its state saved and taken over again in the middle; a copy goes on from there.

    Attributes:
        chosen: The pipeline at the end.
        prior: Estimate at 10 m/s at the start.
        restored: The same in the middle, of the pipeline and of the copy.
        outputs: Of the whole drive.
        since: How many of them came before the middle.
        copied: Of the copy, for a minute after the middle.

    """

    chosen: EstimatorPipeline[Any]
    prior: list[float]
    restored: tuple[list[float], list[float]]
    outputs: list[Output[Any]]
    since: int
    copied: list[Output[Any]]


@pytest.fixture(scope='module', params=ALL, ids=IDS)
def drive(request: pytest.FixtureRequest, metro: TrainFile, day: tuple[Record, ...]) -> Drive:
    field, algorithms, make, name = request.param
    whole, copy = (pipeline(field, algorithms, make, name, metro) for _ in range(2))
    prior = numbers(whole.estimator.estimate(10.0))
    records = [record for record in day if record.stamp_ns < day[0].stamp_ns + 240 * NS_PER_S]
    half = len(records) // 2
    outputs = [output for record in records[:half] for output in whole.push(record)]
    since = len(outputs)
    for restored in (copy, whole):
        restored.restore(whole.save())
    middle = numbers(whole.estimator.estimate(10.0)), numbers(copy.estimator.estimate(10.0))
    outputs += [output for record in records[half:] for output in whole.push(record)]
    end_ns = records[half].stamp_ns + 60 * NS_PER_S
    copied = [output for record in records[half:] if record.stamp_ns < end_ns for output in copy.push(record)]
    return Drive(whole, prior, middle, outputs, since, copied)


def test_a_restored_copy_goes_on_to_the_bit(drive: Drive) -> None:
    assert drive.restored[1] == pytest.approx(drive.restored[0], nan_ok=True)
    assert len(drive.copied) > 250
    assert drive.copied[-1].used > 20
    for one, other in zip(drive.outputs[drive.since :], drive.copied, strict=False):
        assert np.array_equal(numbers(one.estimate), numbers(other.estimate), equal_nan=True)


def test_nothing_but_numbers_leaves(drive: Drive) -> None:
    assert drive.chosen.used > 100
    assert all(np.isfinite([x for x in numbers(o.estimate) if x == x]).all() for o in drive.outputs)  # noqa: PLR0124


def test_a_reset_is_the_prior_again(drive: Drive) -> None:
    drive.chosen.reset()
    assert numbers(drive.chosen.estimator.estimate(10.0)) == pytest.approx(drive.prior, nan_ok=True)


def test_an_unknown_name_is_told() -> None:
    with pytest.raises(InputError, match=r"algorithm = 'XYZ' must be one of V-MILS"):
        RESISTANCE.choose('XYZ')


def test_settings_are_changed_by_name() -> None:
    assert RESISTANCE.choose().algorithm == RESISTANCE.default == 'V-MILS'
    assert RESISTANCE.choose(hop=5).config != RESISTANCE.choose().config


@pytest.mark.parametrize(
    ('field', 'name', 'setting'),
    [
        ('brake_rate', 'SMA', 'prior_std'),
        ('brake_rate', 'GSMA-printed', 'prior_std'),
        ('speed_model', 'integral-RLS', 'readmit_after'),
        ('speed_model', 'AM-VFF-RLS-printed', 'readmit_after'),
        ('speed_model', 'AM-RLS', 'min_forgetting'),
        ('resistance', 'LS', 'innovation_length'),
        ('resistance', 'V-MILS-printed', 'record_length'),
    ],
)
def test_what_an_algorithm_does_not_heed_is_no_setting_of_it(field: str, name: str, setting: str) -> None:
    algorithms = {item[0]: item[1] for item in ALL}[field]
    assert setting in algorithms[name].config.__dataclass_fields__
    assert setting not in algorithms[name].settings
    with pytest.raises(InputError, match=f"{name} has no setting '{setting}'"):
        algorithms.choose(name, **{setting: 3})


def test_fixed_settings_are_settings() -> None:
    for _, algorithms, _, name in ALL:
        assert algorithms[name].fixed <= set(algorithms[name].config.__dataclass_fields__)
        assert algorithms[name].settings


@pytest.fixture(scope='module')
def spoiled(day: tuple[Record, ...]) -> list[Sample]:
    """Samples of a day in which some speeds are far off, up to six in a row."""
    aligner, samples, count = Aligner(AlignmentConfig()), [], 0
    for record in day:
        count += isinstance(record, SpeedRecord)
        far_off = count % 97 == 0 or count % 400 in range(4) or count % 900 in range(6)
        wrong = replace(record, speed=record.speed + 6.0) if isinstance(record, SpeedRecord) and far_off else record
        samples += [event for event in aligner.push(wrong) if isinstance(event, Sample)]
        if len(samples) > 1400:
            break
    return samples


PRINTED = [(algorithms, name) for _, algorithms, _, name in ALL if algorithms[name].fixed and name != 'LS']


@pytest.mark.slow
@pytest.mark.parametrize(('algorithms', 'name'), PRINTED)
def test_every_setting_that_can_be_changed_acts(
    algorithms: Algorithms[Any], name: str, metro: TrainFile, spoiled: list[Sample]
) -> None:
    samples = spoiled[: 1400 if algorithms is RESISTANCE else 500]

    def end(**changes: float) -> list[float]:
        try:
            chosen = algorithms.make(algorithms.choose(name, **changes), metro, np.random.default_rng(1))
        except InputError:  # it does not fit the other settings
            return []
        for sample in samples:
            chosen.step(sample)
        return numbers(chosen.estimate(13.0))

    usual, config = end(), algorithms[name].config
    for item in fields(config):
        info = setting_info(item)
        # The limit of what is fit to use changes no estimate.
        if info is not None and item.name in algorithms[name].settings and item.name != 'valid_std':
            kind, span = type(getattr(config, item.name)), info.high - info.low
            some = (kind(value) for value in (info.low, info.low + 0.01 * span, min(info.high, 100)))
            assert any(end(**{item.name: value}) != usual for value in some), item.name
