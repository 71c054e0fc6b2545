# SPDX-License-Identifier: Apache-2.0
"""The note on a new train file states the change and its effects, and the test fails if the gain is lost."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from trainid_ros.explain.result import Explanation, Gap
from trainid_ros.report.proposal import changes, migration_note, regression_test
from trainid_ros.train.train_file import Line, TrainFile

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
