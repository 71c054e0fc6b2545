# SPDX-License-Identifier: Apache-2.0
"""The note on a new train file states the change and what it means for operation; its test fails if that is lost."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainid_ros.client.train_model import TrainModel
from trainid_ros.explain.result import Explanation, Gap
from trainid_ros.interface.errors import NoAnswerError
from trainid_ros.report import proposal
from trainid_ros.report.proposal import changes, drive, migration_note, regression_test, what_if_rows
from trainid_ros.sim.plant import DriverModel, GustModel
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import Davis, Effect, Line, Train, TrainFile

LEVEL = TrainFile(Train(mass=200e3, rotary_mass=0.08), Davis(1.5, 0.0, 0.0), line=Line(stops=(0.0, 4000.0)))
GAP = Gap(0.4, 0.1, 0.05, 2, 0.3, 0.04, 25.0)


def test_changes_are_those_of_resistance_and_effects(
    make_explanation: Callable[..., Explanation], stated: TrainFile
) -> None:
    new = make_explanation().train_file
    assert changes(new, new) == []
    assert changes(replace(stated, resistance=new.resistance), new) == [
        ('effects: local_drag', 'none', 'start = 300, end = 500, permille = 1.5')
    ]
    assert changes(new, replace(new, effects=(), resistance=replace(new.resistance, a=2.0))) == [
        ('resistance.a', '1.61', '2'),
        ('effects: local_drag', 'start = 300, end = 500, permille = 1.5', 'removed'),
    ]


def test_the_note_says_what_changes_why_and_what_follows(
    make_explanation: Callable[..., Explanation], stated: TrainFile
) -> None:
    found = make_explanation()
    line = Line(stops=(0.0, 900.0))
    found = replace(found, train_file=replace(found.train_file, line=line))
    note = migration_note(found, replace(stated, line=line), 'old.yaml', ('monday', 'tuesday'))
    for part in (
        'From `old.yaml`', '`monday`, `tuesday`', '| effects: local_drag | none | start = 300, end = 500',
        'The current model lacks local_drag (probability 97%)', 'permille = 1.500 ± 0.050 per mille', '0.400 m/s',
        '| running time, rising positions | s |', 'set `train_file` to `old.yaml`',
    ):  # fmt: skip
        assert part in note


@pytest.mark.parametrize(('now', 'passes'), [(0.1, True), (0.19, True), (0.21, False)])
def test_the_test_fails_where_the_gap_is_nearer_to_the_old_one(
    monkeypatch: pytest.MonkeyPatch, now: float, passes: bool
) -> None:
    def run(command: list[Any], **_: object) -> SimpleNamespace:
        assert command[3:6] == ['explain', 'a b', "it's"]
        assert command[-3:] == ['--namespace', '/x', '--json']
        return SimpleNamespace(stdout=json.dumps({'gap': {'before': now}}))

    monkeypatch.setattr(subprocess, 'run', run)
    module: dict[str, Any] = {'__file__': '/folder/test_train.py'}
    exec(regression_test(GAP, ('a b', "it's"), ('--namespace', '/x')), module)
    if passes:
        module['test_the_gap_stays_small']()
    else:
        with pytest.raises(AssertionError):
            module['test_the_gap_stays_small']()


def test_running_time_is_that_of_the_simulator(metro: TrainFile) -> None:
    short = replace(metro, line=replace(metro.line, stops=metro.line.stops[:3]))
    still = DriverModel(cruise_low=3600.0, cruise_high=3600.0, dwell_low=0.0, dwell_high=0.0)
    scenario = Scenario(short, runs=2, passengers=0.0, driver=still, gust=GustModel(std=0.0))
    arrival = simulate(scenario, np.random.default_rng(1)).arrivals[-1].time_s
    assert drive(short, 1)[0] == pytest.approx(arrival, rel=0.005)


def test_energy_covers_kinetic_energy_and_work_of_the_resistance() -> None:
    seconds, kwh = drive(LEVEL, 1)
    speed = LEVEL.train.max_speed - 0.8  # the margin of the driver
    work = 0.5 * 1.08 * 200e3 * speed**2 + 0.0015 * 200e3 * 9.80665 * 4000.0
    # While the train brakes, the resistance does no work of the traction.
    assert 0.8 < 3.6e6 * kwh / work < 1.0
    assert 4000.0 / speed < seconds < 2.0 * 4000.0 / speed


def test_a_drag_costs_time_and_energy_in_both_directions_and_wind_in_one() -> None:
    assert what_if_rows(LEVEL, replace(LEVEL)) == []
    drag = Effect('local_drag', (('start', 1000.0), ('end', 3000.0), ('permille', 5.0)))
    wind = Effect('headwind', (('speed', 8.0),))
    drafty = replace(LEVEL, resistance=Davis(1.5, 0.0, 0.003))
    for file, effect, signs in ((LEVEL, drag, '++'), (drafty, wind, '+-')):
        rows = what_if_rows(file, replace(file, effects=(effect,)))
        energies = [row for row in rows if row[0].startswith('traction energy')]
        assert [row[4][0] for row in energies] == list(signs)
        assert [row[1] for row in rows] == ['s', 'kWh', 's', 'kWh', 'm']


def test_stopping_distance_is_that_of_the_client() -> None:
    weak = replace(LEVEL, brake=replace(LEVEL.brake, rate=0.8))
    name, unit, old, new, change = what_if_rows(LEVEL, weak)[-1]
    speed = float(name.split()[3]) / 3.6
    values = [TrainModel(None, file).stopping_distance(speed).value for file in (LEVEL, weak)]
    assert [float(old), float(new)] == pytest.approx(values, rel=1e-3)
    assert (unit, change) == ('m', f'{values[1] / values[0] - 1.0:+.1%}')


def test_what_cannot_be_driven_is_left_out_or_a_dash(monkeypatch: pytest.MonkeyPatch) -> None:
    bare = replace(LEVEL, line=Line())
    rows = what_if_rows(bare, replace(bare, resistance=Davis(2.0, 0.0, 0.0)))
    assert [row[0].split(' from ')[0] for row in rows] == ['stopping distance']
    stuck = replace(LEVEL, resistance=Davis(500.0, 0.0, 0.0))
    monkeypatch.setattr(proposal, 'MAX_RUN_S', 300.0)
    with pytest.raises(NoAnswerError, match='does not reach stop 4000 m within 300 s'):
        drive(stuck, 1)
    assert what_if_rows(LEVEL, stuck)[0][3:] == ('–', '–')
