# SPDX-License-Identifier: Apache-2.0
"""Every algorithm, built in or of an installed plug-in, works on a full day through the common protocol."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from benchmarks.stepping import step_and_estimate
from trainid_ros.estimators.pipeline import EstimatorPipeline
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.interface.results import Output, Rejection
from trainid_ros.setup.pipelines import KINDS, RESISTANCE, EstimatorKind, EstimatorSettings
from trainid_ros.stream.alignment import Aligner, AlignmentConfig
from trainid_ros.stream.samples import Sample
from trainid_ros.train.train_file import TrainFile

ALL = [(kind, name) for kind in KINDS for name in kind.algorithms.names]
IDS = [f'{kind.name}-{name}' for kind, name in ALL]


def pipeline(kind: EstimatorKind[Any], name: str, train_file: TrainFile) -> EstimatorPipeline[Any]:
    settings: Any = {kind.name: kind.algorithms.choose(name)}
    return kind.pipeline(train_file, EstimatorSettings(**settings))


def numbers(estimate: Any) -> list[float]:
    values = [getattr(estimate, name) for name in estimate.__dataclass_fields__]
    return [float(x) for value in values for x in (value if isinstance(value, tuple) else (value,))]


@dataclass(frozen=True)
class Drive:
    """Four minutes with an algorithm.

    Attributes:
        chosen: The pipeline at the end.
        prior: Estimate at 10 m/s at the start.
        outputs: All outputs of the drive.

    """

    chosen: EstimatorPipeline[Any]
    prior: list[float]
    outputs: list[Output[Any]]


@pytest.fixture(scope='module', params=ALL, ids=IDS)
def drive(request: pytest.FixtureRequest, metro: TrainFile, day: tuple[Record, ...]) -> Drive:
    kind, name = request.param
    original = pipeline(kind, name, metro)
    prior = numbers(original.estimator.estimate(10.0))
    records = [record for record in day if record.stamp_ns < day[0].stamp_ns + 240 * NS_PER_S]
    return Drive(original, prior, [output for record in records for output in original.push(record)])


@pytest.fixture(scope='module')
def samples(day: tuple[Record, ...]) -> list[Sample]:
    """Some minutes with lost records, so that there are gaps, and with speeds beyond any gate."""
    rng, aligner = np.random.default_rng(61), Aligner(AlignmentConfig())
    found: list[Sample] = []
    for record in day:
        if record.stamp_ns < day[0].stamp_ns + 200 * NS_PER_S and rng.random() > 0.002:
            found += [event for event in aligner.push(record) if isinstance(event, Sample)]
    wrong = rng.random(len(found)) < 0.02
    return [replace(s, speed=s.speed + 8.0) if bad else s for s, bad in zip(found, wrong, strict=True)]


@pytest.mark.parametrize(('kind', 'name'), ALL, ids=IDS)
def test_a_copy_restored_at_any_sample_continues_to_the_bit(
    kind: EstimatorKind[Any], name: str, metro: TrainFile, samples: list[Sample]
) -> None:
    original, copy, fresh = (pipeline(kind, name, metro).estimator for _ in range(3))
    used = 0
    for k, item in enumerate(samples):
        if k % 31 == 7 or (k < 5 and name in kind.algorithms.built_in):
            copy.restore(original.save())
            assert repr(copy.estimate(10.0)) == repr(original.estimate(10.0)), k
        answer, copied = step_and_estimate(original, item), step_and_estimate(copy, item)
        assert (repr(copied), copy.converged) == (repr(answer), original.converged), k
        used += not isinstance(answer, Rejection)
    assert used > 100
    assert copy.save() == original.save()
    if name not in kind.algorithms.built_in:
        return
    for estimator in (copy, original):
        estimator.reset()
    assert copy.save() == original.save() == fresh.save()


def test_all_outputs_are_finite(drive: Drive) -> None:
    assert drive.chosen.used > 100
    assert all(np.isfinite([x for x in numbers(o.estimate) if x == x]).all() for o in drive.outputs)  # noqa: PLR0124


def test_a_reset_restores_the_prior(drive: Drive) -> None:
    drive.chosen.reset()
    assert numbers(drive.chosen.estimator.estimate(10.0)) == pytest.approx(drive.prior, nan_ok=True)


def test_an_unknown_name_is_rejected_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"algorithm = 'XYZ' must be one of filter-bank"):
        RESISTANCE.choose('XYZ')


def test_settings_are_changed_by_name() -> None:
    assert RESISTANCE.choose().algorithm == RESISTANCE.default == 'filter-bank'
    assert RESISTANCE.choose(min_age=5.0).config != RESISTANCE.choose().config


def test_fixed_settings_exist() -> None:
    for kind, name in ALL:
        algorithm = kind.algorithms[name]
        assert algorithm.fixed <= set(algorithm.config.__dataclass_fields__)
        assert algorithm.settings
