# SPDX-License-Identifier: Apache-2.0
"""The demo draws hidden effects by seed, finds them, and states the truth beside the answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trainid_ros.cli.demo_explain import CASES, Case, describe_cases, draw_effect
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation, Verdict
from trainid_ros.train.effects import EFFECTS, parse_effects

HIDDEN = 'local_drag:permille=1.6,start=300,end=480'


def test_effects_are_drawn_within_the_line_and_of_noticeable_size() -> None:
    drawn = [draw_effect(np.random.default_rng(seed), 8000.0) for seed in range(60)]
    assert len({text.partition(':')[0] for text in drawn}) == 8
    for (effect,) in map(parse_effects, ([text] for text in drawn)):
        kind, values = EFFECTS[effect.name], dict(effect.parameters)
        size = (values[kind.amplitude] - kind.neutral) / kind.typical_size
        assert 0.999 <= abs(size) <= 2.001
        assert kind.sign * size >= 0.0
        if 'start' in values:
            assert 0.0 <= values['start'] < values['end'] <= 8000.0
            assert 499.0 <= values['end'] - values['start'] <= 3001.0


def test_the_truth_stands_beside_the_answer(make_explanation: Callable[..., Explanation]) -> None:
    nothing = make_explanation(verdict=Verdict.NO_GAP, effects=(), gap=None)
    cases = [Case(7, HIDDEN, found, Path('out')) for found in (make_explanation(), nothing)]
    _, head, first, second, *reports = describe_cases(cases).splitlines()
    assert head.split()[:2] == ['seed', 'hidden']
    assert first.startswith(f'7     {HIDDEN}  local_drag: start = ')
    assert first.endswith('0.400 -> 0.050')
    assert second.startswith(f'7     {HIDDEN}  no_gap')
    assert reports == ['report: out/report.html'] * 2
    assert [case.is_found for case in cases] == [True, False]


@pytest.mark.slow
def test_hidden_effects_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'explain' / 'seed_5' / 'bag').mkdir(parents=True)  # of an earlier demo
    assert main(['demo', '--only', 'explain', '--seed', '5', '--out', str(tmp_path), '--json']) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert (answer['worked'], answer['bags'], len(answer['explain'])) == (True, [], CASES)
    for seed, case in enumerate(answer['explain'], start=5):
        folder = tmp_path / 'explain' / f'seed_{seed}'
        assert (case['seed'], case['is_found']) == (seed, True)
        assert case['found']['gap']['after'] < case['found']['gap']['before']
        assert case['hidden'] in err
        assert {path.name for path in folder.iterdir()} == {'bag', 'report.html', 'report.json', 'train.yaml'}
        assert case['hidden'] in (folder / 'report.html').read_text(encoding='utf-8')
