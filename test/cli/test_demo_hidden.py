# SPDX-License-Identifier: Apache-2.0
"""Last chapter of the demo: the hidden effect is found, without ROS, also if an earlier demo left its bag."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from trainid_ros.cli.demo import HIDDEN, describe_hidden, is_found
from trainid_ros.cli.main import main
from trainid_ros.explain.result import Explanation
from trainid_ros.train.train_file import TrainFile


@pytest.mark.slow
def test_the_hidden_effect_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / 'explain'
    (folder / 'bag').mkdir(parents=True)
    assert main(['demo', '--only', 'explain', '--out', str(tmp_path), '--json']) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert (answer['worked'], answer['bags'], answer['explain']['hidden']) == (True, [], HIDDEN)
    assert answer['explain']['found']['gap']['after'] < answer['explain']['found']['gap']['before']
    assert HIDDEN in err
    assert {path.name for path in folder.iterdir()} == {'bag', 'report.html', 'report.json', 'train.yaml'}
    assert HIDDEN in (folder / 'report.html').read_text(encoding='utf-8')


def test_text_shows_the_hidden_and_the_found_effect(
    make_explanation: Callable[..., Explanation], stated: TrainFile
) -> None:
    text = describe_hidden(stated, make_explanation(), Path('out'))
    assert text.index(HIDDEN) < text.index('EXPLAINED: The current model lacks local_drag')
    assert is_found(make_explanation())
    assert not is_found(make_explanation(effects=()))
