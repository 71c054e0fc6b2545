# SPDX-License-Identifier: Apache-2.0
"""The algorithms of lab/ are found by name where the built-in ones are, with the settings that they use."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from trainid_lab.brake_rate.brake_rate_algorithms import ALGORITHMS as BRAKE_RATES
from trainid_lab.resistance.resistance_algorithms import ALGORITHMS as RESISTANCES
from trainid_lab.speed_model.speed_model_algorithms import ALGORITHMS as SPEED_MODELS
from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.pipeline import ConsistencyVerdict
from trainid_ros.interface.errors import InputError, setting_info
from trainid_ros.interface.records import NS_PER_S, Record, SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, ResistanceEstimate, SpeedModelEstimate
from trainid_ros.setup.params_file import node_setups
from trainid_ros.setup.pipelines import (
    BRAKE_RATE,
    KINDS,
    RESISTANCE,
    EstimatorSettings,
    brake_rate_pipeline,
    chosen_algorithms,
)
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

REGISTRIES: dict[str, Algorithms[Any]] = {kind.name: kind.algorithms for kind in KINDS}
GIVEN: dict[str, tuple[Algorithm[Any], ...]] = {
    'resistance': RESISTANCES,
    'speed_model': SPEED_MODELS,
    'brake_rate': BRAKE_RATES,
}


@pytest.mark.parametrize('field', GIVEN)
def test_the_names_follow_the_built_in_ones(field: str) -> None:
    algorithms = REGISTRIES[field]
    assert algorithms.names == (*algorithms.built_in, *(item.name for item in GIVEN[field]))
    assert algorithms.hint == ''
    assert all(algorithms[item.name] is item for item in GIVEN[field])


def test_replay_accepts_them_by_name(metro: TrainFile) -> None:
    chosen = ('LS', 'integral-RLS', 'brake_rate=KF')
    setups = node_setups(metro, 'train.yaml', None, chosen)
    assert [setup.algorithm for setup in setups] == ['LS', 'integral-RLS', 'KF']
    assert [type(setup.pipeline().current().estimate) for setup in setups] == [
        ResistanceEstimate,
        SpeedModelEstimate,
        BrakeRateEstimate,
    ]
    with pytest.raises(InputError, match='ambiguous: use resistance=RLS or speed_model=RLS'):
        chosen_algorithms(['RLS'])


def test_errors_larger_than_stated_are_detected(metro: TrainFile, day: tuple[Record, ...]) -> None:
    """SMA as printed leaves out what one of its particles moves by; the default does not."""
    printed = brake_rate_pipeline(metro, EstimatorSettings(brake_rate=BRAKE_RATE.choose('SMA')))
    default = brake_rate_pipeline(metro, EstimatorSettings())
    for record in day:
        if record.stamp_ns < day[0].stamp_ns + 240 * NS_PER_S:
            printed.push(record)
            default.push(record)
    assert printed.consistency.verdict is ConsistencyVerdict.OPTIMISTIC
    assert default.consistency.verdict is ConsistencyVerdict.CONSISTENT


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
def test_an_algorithm_does_not_offer_settings_that_it_ignores(field: str, name: str, setting: str) -> None:
    algorithms = REGISTRIES[field]
    assert setting in algorithms[name].config.__dataclass_fields__
    assert setting not in algorithms[name].settings
    with pytest.raises(InputError, match=f"{name} has no setting '{setting}'"):
        algorithms.choose(name, **{setting: 3})


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


PRINTED = [
    (algorithms, name)
    for algorithms in REGISTRIES.values()
    for name in algorithms.names
    if algorithms[name].fixed and name != 'LS'
]


def numbers(estimate: Any) -> list[float]:
    values = [getattr(estimate, name) for name in estimate.__dataclass_fields__]
    return [float(x) for value in values for x in (value if isinstance(value, tuple) else (value,))]


@pytest.mark.slow
@pytest.mark.parametrize(('algorithms', 'name'), PRINTED)
def test_every_setting_that_can_be_changed_has_an_effect(
    algorithms: Algorithms[Any], name: str, metro: TrainFile, spoiled: list[Sample]
) -> None:
    samples = spoiled[: 1400 if algorithms is RESISTANCE else 500]

    def end(**changes: float) -> list[float]:
        try:
            chosen = algorithms.make(algorithms.choose(name, **changes), metro, np.random.default_rng(1))
        except InputError:  # incompatible with the other settings
            return []
        for sample in samples:
            chosen.step(sample)
        return numbers(chosen.estimate(13.0))

    usual, config = end(), algorithms[name].config
    for item in fields(config):
        info = setting_info(item)
        # The limit of fitness for use changes no estimate.
        if info is not None and item.name in algorithms[name].settings and item.name != 'valid_std':
            kind, span = type(getattr(config, item.name)), info.high - info.low
            some = (kind(value) for value in (info.low, info.low + 0.01 * span, min(info.high, 100)))
            assert any(end(**{item.name: value}) != usual for value in some), item.name
