# SPDX-License-Identifier: Apache-2.0
"""Algorithms are chosen by name, and errors of the reported force become findings."""

from __future__ import annotations

import math
from typing import Any

import pytest

from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import RESISTANCE_TOPIC
from trainid_ros.interface.results import ResistanceEstimate
from trainid_ros.resistance.vmils import VMils
from trainid_ros.setup import pipelines
from trainid_ros.setup.pipelines import EstimatorKind, chosen_algorithms, force_findings

# Algorithms by name


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds that share a name of an algorithm."""

    def algorithm(name: str) -> Algorithm[Any]:
        return Algorithm(name, '', VMilsConfig(), lambda train_file, config, _: VMils(train_file, config))

    def named(kind: str, *names: str) -> EstimatorKind[Any]:
        algorithms = Algorithms(kind, *map(algorithm, names))
        vars(algorithms)['_plug_ins'] = ({}, '')  # whatever is installed
        return EstimatorKind(algorithms, RESISTANCE_TOPIC)

    kinds = (named('resistance', 'V', 'EKF'), named('speed_model', 'A', 'EKF'), named('brake_rate', 'G'))
    monkeypatch.setattr(pipelines, 'KINDS', kinds)


@pytest.mark.usefixtures('many')
def test_algorithms_are_found_by_name_or_by_kind_and_name() -> None:
    assert chosen_algorithms(['A', 'resistance=EKF', 'G', 'G']) == {
        'speed_model': 'A',
        'resistance': 'EKF',
        'brake_rate': 'G',
    }


@pytest.mark.usefixtures('many')
@pytest.mark.parametrize(
    ('wanted', 'reason'),
    [
        (['EKF'], "algorithm 'EKF' is ambiguous: use resistance=EKF or speed_model=EKF"),
        (['X'], "algorithm 'X' is unknown; there are resistance: V, EKF; speed_model: A, EKF; brake_rate: G"),
        (['resistance=G'], "algorithm 'G' is unknown; there are resistance: V, EKF"),
        (['speed=A'], "'speed' must be one of resistance, speed_model, brake_rate"),
        (['V', 'resistance=EKF'], 'algorithm: two given for resistance, V and EKF'),
    ],
)
def test_invalid_choices_are_reported_with_the_valid_ones(wanted: list[str], reason: str) -> None:
    with pytest.raises(InputError) as caught:
        chosen_algorithms(wanted)
    assert reason in str(caught.value)


# Findings


def estimate(scale: float, scale_std: float, delay: float = 0.0, delay_std: float = 0.02) -> ResistanceEstimate:
    davis = (1.5, 0.02, 0.003, (0.0,) * 9, 2.0, 0.1, 10.0, 0.0, 1.0, 0.0, 1.0, 20.0, 0.3)
    return ResistanceEstimate(*davis, scale, scale_std, delay, delay_std)


def test_a_force_scale_of_5_percent_error_is_reported() -> None:
    assert force_findings(estimate(0.953, 0.004)) == (
        'force scale 0.953 ± 0.004: ato/force or the mass (ato/mass or train.mass) is off',
    )


@pytest.mark.parametrize(('scale', 'std'), [(1.0, 0.004), (0.96, 0.02), (1.008, 0.001), (math.nan, math.nan)])
def test_a_small_uncertain_or_missing_error_is_not_reported(scale: float, std: float) -> None:
    assert force_findings(estimate(scale, std)) == ()


@pytest.mark.parametrize(('delay', 'sense'), [(0.25, 'later'), (-0.25, 'earlier')])
def test_a_force_delay_is_reported_with_its_sign(delay: float, sense: str) -> None:
    (found,) = force_findings(estimate(1.0, 0.004, delay))
    assert found == f'force delay 0.25 ± 0.02 s: ato/force is stamped {sense} than it acts'
