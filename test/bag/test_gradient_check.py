# SPDX-License-Identifier: Apache-2.0
"""A gradient in a wrong unit is named without a line to compare it with, and a right or a flat one never is."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured_car import FOLDER, load_trip, records
from trainid_ros.bag.input_check import check_inputs
from trainid_ros.bag.reader import BagReader
from trainid_ros.interface.records import GradientRecord, Record, SpeedRecord
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.worlds import WORLDS, make_case, unknowns_of, world_train
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.train.train_file import TrainFile

BAGS = Path(__file__).resolve().parents[2] / 'bags'
DRIVES = (('metro', 2, 71), ('emu', 2, 72), ('freight', 2, 73), ('tram', 4, 74))


@cache
def scenario(world: str, runs: int, seed: int) -> tuple[Scenario, TrainFile]:
    """Return a drive on a hilly line, and the train file that an engineer has, without a line."""
    stated = world_train(WORLDS[world])
    rng = np.random.default_rng((6_112, seed))
    case = make_case(WORLDS[world], stated, unknowns_of('field', [], stated), runs, rng)
    return case.scenario, replace(case.stated, line=replace(case.stated.line, gradient=()))


@cache
def drive(world: str, runs: int, seed: int) -> tuple[Record, ...]:
    return simulate(scenario(world, runs, seed)[0], np.random.default_rng((6_113, seed))).records


def scaled(inputs: tuple[Record, ...], factor: float) -> list[Record]:
    return [replace(r, gradient=factor * r.gradient) if isinstance(r, GradientRecord) else r for r in inputs]


def found(inputs: list[Record], train: TrainFile | None = None) -> list[str]:
    problems = check_inputs((record.row() for record in inputs), AlignmentConfig(), train).problems
    return [text for text in problems if text.startswith('ato/gradient')]


@pytest.mark.parametrize('case', DRIVES)
@pytest.mark.parametrize(
    ('factor', 'text'),
    [
        (0.1, 'looks like per cent: the train is slowed '),
        (-0.1, 'looks like per cent, with the wrong sign: '),
        (math.pi / 180.0, 'looks too small: '),
        (0.18 / math.pi, 'looks like degrees: '),
        (0.001, 'looks like a ratio or radians: '),
        (10.0, 'looks ten times too large: '),
        (-1.0, 'looks as if it had the wrong sign: '),
    ],
)
def test_a_wrong_unit_is_named(case: tuple[str, int, int], factor: float, text: str) -> None:
    assert len(problems := found(scaled(drive(*case), factor))) == 1
    assert problems[0].startswith(f'ato/gradient {text}')


@pytest.mark.parametrize('case', DRIVES)
def test_the_mass_need_not_be_known(case: tuple[str, int, int]) -> None:
    train = scenario(*case)[1]
    assert found(scaled(drive(*case), 1.0), train) == []
    assert found(scaled(drive(*case), 0.1), train)[0].startswith('ato/gradient looks like per cent')


@pytest.mark.parametrize('case', DRIVES)
def test_a_right_gradient_is_not_named(case: tuple[str, int, int]) -> None:
    inputs = drive(*case)
    assert found(scaled(inputs, 1.0)) == []
    in_kmh = [replace(r, speed=3.6 * r.speed) if isinstance(r, SpeedRecord) else r for r in inputs]
    assert found(in_kmh) == []


@pytest.mark.parametrize('noise', [0.0, 0.05, 1.0])
def test_nothing_is_said_on_a_flat_line(noise: float) -> None:
    hilly = scenario('metro', 2, 71)[0]
    rng = np.random.default_rng(6_114)
    for share in (0.0, 0.02):
        line = replace(
            hilly.train_file.line, gradient=tuple((at, share * value) for at, value in hilly.train_file.line.gradient)
        )
        flat = simulate(replace(hilly, train_file=replace(hilly.train_file, line=line)), np.random.default_rng(6_115))
        inputs = [
            replace(r, gradient=r.gradient + rng.normal(0.0, noise)) if isinstance(r, GradientRecord) else r
            for r in flat.records
        ]
        assert found(inputs) == []


@pytest.mark.parametrize('name', ['altrios_manifest', 'tiny', 'yizhuang_day'])
def test_the_bags_are_in_order(name: str) -> None:
    with BagReader(BAGS / name) as reader:
        inputs = list(reader.records())
    assert found(inputs) == []


@pytest.mark.skipif(not FOLDER.is_dir(), reason='the measured data are not beside the repository')
def test_noise_of_a_measured_gradient_is_no_unit() -> None:
    inputs = tuple(records(load_trip(FOLDER, 'TripA30')))
    assert found(list(inputs)) == []
    assert found(scaled(inputs, 0.1))[0].startswith('ato/gradient looks like per cent')
