# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from trainid_ros.bags.reader import BagReader
from trainid_ros.commands.main import main
from trainid_ros.core.records import ForceRecord
from trainid_ros.simulation.truth import load_truth

REPOSITORY = Path(__file__).parents[2]
TRAIN = REPOSITORY / 'config' / 'trains' / 'yizhuang.yaml'


def simulate(out: Path, *arguments: str) -> int:
    return main(['simulate', str(out), '--train', str(TRAIN), '--runs', '1', *arguments])


def test_bag_truth_and_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'bag'
    assert simulate(out, '--effect', 'resistance_step:time=60', '--effect', 'resistance_step:a=0.5', '--json') == 0
    answer = json.loads(capsys.readouterr().out)
    with BagReader(out) as reader:
        assert {topic.name: topic.count for topic in reader.topics()} == answer['messages']
    truth = load_truth(out / 'truth.yaml')
    assert truth.truth_at(61.0).resistance.a == pytest.approx(truth.truth_at(59.0).resistance.a + 0.5)
    assert answer['truth']['start_ns'] == truth.start_ns
    assert answer['runs'] == 1


def test_same_seed_same_records_other_seed_other_records(tmp_path: Path) -> None:
    found = []
    for name, seed in (('a', '3'), ('b', '3'), ('c', '4')):
        assert simulate(tmp_path / name, '--seed', seed) == 0
        with BagReader(tmp_path / name) as reader:
            found.append(list(reader.records()))
    assert found[0] == found[1]
    assert found[0] != found[2]


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        (['--effect', 'foo:x=1'], 'foo'),
        (['--effect', 'tunnel_drag:factr=2'], 'tunnel_drag:factr'),
        (['--effect', 'tunnel_drag:factor=much'], "'much'"),
        (['--effect', 'tunnel_drag'], 'NAME:key=value'),
        (['--runs', '0'], 'runs = 0'),
        (['--train', 'nope.yaml'], 'nope.yaml'),
    ],
)
def test_bad_arguments_are_named_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], named: str
) -> None:
    assert simulate(tmp_path / 'bag', *arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.count('\n') == 1
    assert named in captured.err
    assert not (tmp_path / 'bag').exists()


def test_existing_bag_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate(tmp_path) == 2
    assert f'{tmp_path}: exists already' in capsys.readouterr().err


def test_seed_must_be_a_whole_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        simulate(tmp_path / 'bag', '--seed', '-1')
    assert caught.value.code == 2
    assert "--seed: '-1' is not a whole number >= 0" in capsys.readouterr().err


def test_the_effect_of_the_readme_takes_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    readme = (REPOSITORY / 'README.md').read_text(encoding='utf-8')
    (example,) = re.findall(r'A new effect is one file.*?```python\n(.*?)```', readme, re.DOTALL)
    folder = tmp_path / 'effects'
    folder.mkdir()
    (folder / 'snow.py').write_text(example, encoding='utf-8')
    assert simulate(tmp_path / 'none', '--effect', 'snow:drag=2') == 2
    assert 'effect snow is not known' in capsys.readouterr().err
    monkeypatch.setenv('TRAINID_EFFECTS', str(folder))
    assert simulate(tmp_path / 'snow', '--effect', 'snow:drag=2') == 0
    assert simulate(tmp_path / 'clear') == 0
    # The same driver with the same orders needs more force in snow.
    work = []
    for name in ('snow', 'clear'):
        with BagReader(tmp_path / name) as reader:
            work.append(sum(max(0.0, record.force) for record in reader.records() if isinstance(record, ForceRecord)))
    assert work[0] > 1.05 * work[1]
