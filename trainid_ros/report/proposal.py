# SPDX-License-Identifier: Apache-2.0
"""Proposal of a new train file: a note on the change, and a test that it keeps what it has gained.

The note says what the change means for operation: running time, energy and stopping distance. Plant and driver of the
simulator go along the line and back, without gusts, passengers and dwells. The driver never coasts: it runs as fast as
train and line allow, which depends neither on chance nor on when coasting ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import numpy as np

from trainid_ros.client.train_model import TrainModel
from trainid_ros.explain.result import Explanation, Gap
from trainid_ros.interface.errors import NoAnswerError, TrainIdError
from trainid_ros.interface.records import KM_H, NS_PER_S
from trainid_ros.report import words
from trainid_ros.report.words import DASH, number
from trainid_ros.resistance.suggested_drive import top_speed
from trainid_ros.sim.plant import Driver, DriverModel, Plant
from trainid_ros.sim.scenario import DEFAULT_START_NS, MAX_RUN_S, TICK_NS
from trainid_ros.train.line import profile_of
from trainid_ros.train.train_file import Effect, TrainFile

_TEST: Final = '''"""The train file beside this test simulates runs better than the one before."""

import json
import subprocess
import sys
from pathlib import Path

TRAIN = Path(__file__).with_name('train.yaml')
BAGS = {bags}
OPTIONS = {options}
MOST = {most:.6g}  # m/s: geometric mean of the gaps of the file before ({before:.4g}) and of this one ({after:.4g})


def test_the_gap_stays_small():
    command = [sys.executable, '-m', 'trainid_ros.cli.main', 'explain', *BAGS, '--train', TRAIN, *OPTIONS, '--json']
    answer = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert answer['gap']['before'] < MOST
'''


def changes(before: TrainFile, after: TrainFile) -> list[tuple[str, str, str]]:
    """Return the fields of a train file that differ, with their old and new values as text."""
    pairs = ((f'resistance.{x}', getattr(before.resistance, x), getattr(after.resistance, x)) for x in 'abc')
    rows = [(name, number(old), number(new)) for name, old, new in pairs if old != new]
    gone = [effect for effect in before.effects if effect not in after.effects]
    added = [effect for effect in after.effects if effect not in before.effects]
    rows += [(f'effects: {effect.name}', _text(effect), 'removed') for effect in gone]
    return [*rows, *((f'effects: {effect.name}', 'none', _text(effect)) for effect in added)]


def _text(effect: Effect) -> str:
    return ', '.join(f'{name} = {number(value)}' for name, value in effect.parameters)


def migration_note(explanation: Explanation, before: TrainFile, train: str, bags: Sequence[str]) -> str:
    """Return what changes in a train file, why, what follows from it, and how to introduce it, as Markdown."""
    effects = [
        f'- `{effect.name}`, {effect.title}: {words.parameters_text(effect)}. Where: {effect.where}. '
        f'{words.how_sure(effect).capitalize()}.'
        for effect in explanation.effects
    ]
    parts = (
        '# Change of the train file',
        f'From `{train}`, by {words.drive_text(explanation)}: {", ".join(f"`{bag}`" for bag in bags)}.',
        '## What changes',
        _table(('field', 'before', 'after'), changes(before, explanation.train_file)),
        '## Why',
        words.headline(explanation),
        *(['\n'.join(effects)] if effects else []),
        words.gap_sentence(explanation),
        '## What follows',
        _table(('quantity', 'unit', 'before', 'after', 'change'), what_if_rows(before, explanation.train_file)),
        '## How to introduce it',
        '1. Run `pytest test_train.py`: the new file still simulates these bags better than the old one.\n'
        '2. Set the parameter `train_file` of the nodes to the new file. Estimators start anew: checkpoints belong to '
        'one train file.\n'
        '3. Watch the field `consistency` of the first drives; it should be near 1.\n'
        f'4. To go back, set `train_file` to `{train}`.',
    )
    return '\n\n'.join(parts) + '\n'


def regression_test(gap: Gap, bags: Sequence[str], options: Sequence[str]) -> str:
    """Return a test for pytest: the gap on these bags is nearer to that of the new train file than to the old one.

    ``options`` are those with which the bags were read.
    """
    most = (gap.before * gap.after) ** 0.5
    return _TEST.format(bags=list(bags), options=list(options), most=most, before=gap.before, after=gap.after)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = (head, ['---'] * len(head), *rows)
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def what_if_rows(before: TrainFile, after: TrainFile) -> list[tuple[str, str, str, str, str]]:
    """Return quantity, unit, values by two train files, and the change; none if they are equal or give no value."""
    if before == after:
        return []
    speed = top_speed(before)
    names = (
        ('running time, rising positions', 's'),
        ('traction energy, rising positions', 'kWh'),
        ('running time, falling positions', 's'),
        ('traction energy, falling positions', 'kWh'),
        (f'stopping distance from {speed * KM_H:.0f} km/h, rising positions', 'm'),
    )
    return [
        (
            *name,
            number(old),
            number(new),
            f'{new / old - 1.0:+.1%}' if old > 0.0 and math.isfinite(new) else DASH,
        )
        for name, old, new in zip(names, _values(before, speed), _values(after, speed), strict=True)
        if not (math.isnan(old) and math.isnan(new))
    ]


def _values(train_file: TrainFile, speed: float) -> list[float]:
    """Return the values of all rows by a train file, NaN where it gives none."""
    values = [math.nan] * 5
    with suppress(TrainIdError):
        values[4] = TrainModel(None, train_file).stopping_distance(speed).value
    with suppress(TrainIdError):
        values[:4] = *drive(train_file, 1), *drive(train_file, -1)
    return values


def drive(train_file: TrainFile, direction: int) -> tuple[float, float]:
    """Return running time [s] and energy of the traction [kWh] along the line in a direction.

    Raises:
        InputError: An effect cannot be evaluated.
        NoAnswerError: The line has no two stops, or the train does not reach one.
    """
    stops, profile = train_file.line.stops[::direction], profile_of(train_file)
    if len(stops) < 2:
        raise NoAnswerError(f'line.stops has {len(stops)} stops; a drive needs at least 2')
    model = DriverModel(cruise_low=MAX_RUN_S, cruise_high=MAX_RUN_S)
    train = Plant(train_file, profile, DEFAULT_START_NS, model.jerk)
    train.position, train.direction = stops[0], direction
    driver = Driver(model, train_file, profile, np.random.default_rng(0))
    # Steps of 0.1 s change running times and energies by 0.1 % against those of 0.02 s, in a third of the time.
    steps = 2  # between two decisions of the driver
    for stop in stops[1:]:
        start_ns, arrived = train.now_ns, len(driver.arrivals)
        driver.depart(stop)
        while len(driver.arrivals) == arrived:
            if train.now_ns - start_ns > MAX_RUN_S * NS_PER_S:
                raise NoAnswerError(f'the train does not reach stop {stop:g} m within {MAX_RUN_S:g} s')
            decision = driver.decide((train.now_ns - DEFAULT_START_NS) / NS_PER_S, train)
            train.command(decision.brake)
            for _ in range(steps):
                train.step(decision.traction, TICK_NS // steps)
    return (train.now_ns - DEFAULT_START_NS) / NS_PER_S, train.work / 3.6e6  # J to kWh
