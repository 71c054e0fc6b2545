# SPDX-License-Identifier: Apache-2.0
"""Proposal of a new train file: a note on the change, and a test that it keeps what it has gained."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from trainid_ros.report import words
from trainid_ros.report.what_if import what_if_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from trainid_ros.explain.result import Explanation, Gap
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
    rows = [(name, words.number(old), words.number(new)) for name, old, new in pairs if old != new]
    gone = [effect for effect in before.effects if effect not in after.effects]
    added = [effect for effect in after.effects if effect not in before.effects]
    rows += [(f'effects: {effect.name}', _text(effect), 'removed') for effect in gone]
    return [*rows, *((f'effects: {effect.name}', 'none', _text(effect)) for effect in added)]


def _text(effect: Effect) -> str:
    return ', '.join(f'{name} = {words.number(value)}' for name, value in effect.parameters)


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
