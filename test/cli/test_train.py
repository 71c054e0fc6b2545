# SPDX-License-Identifier: Apache-2.0
"""``trainid train import`` writes a train file with what it lacks as comments, ``trainid train show`` shows it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from test.train.test_draft import STOCK_OSRD, TRACK_OSRD
from test.train.test_railml import FORMULA, STOCK_3, TRACK_2
from trainid_ros.cli.main import main
from trainid_ros.train.train_file import load_train_file


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, content in (
        ('stock.json', json.dumps(STOCK_OSRD)), ('infra.json', json.dumps(TRACK_OSRD)),
        ('stock.xml', STOCK_3.format(resistance=FORMULA)), ('track.railml', TRACK_2),
        ('brake.yaml', 'brake: {delay: 0.9}\n'),
    ):  # fmt: skip
        (tmp_path / name).write_text(content, encoding='utf-8')
    return tmp_path


def run(folder: Path, text: str) -> int:
    words = (str(folder / word) if '.' in word else word for word in text.split())
    return main(['train', *words])


@pytest.mark.parametrize('files', ['stock.json infra.json --track TA', 'stock.xml track.railml brake.yaml'])
def test_files_of_train_and_line_make_one_that_can_be_used(
    files: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(folder, f'import {files} --out out/T.yaml') == 0
    text = (folder / 'out' / 'T.yaml').read_text(encoding='utf-8')
    said = capsys.readouterr().out
    assert 'left out: ' in text
    assert f'next: trainid train show {folder}/out/T.yaml --out page.html' in said
    found = load_train_file(folder / 'out' / 'T.yaml')
    assert found.line.curve
    assert found.brake.delay == (0.9 if 'brake' in files else 0.6)
    assert ('brake.delay' in text) is ('brake' not in files)
    assert run(folder, 'show out/T.yaml --out page.html') == 0
    page = (folder / 'page.html').read_text(encoding='utf-8')
    assert page.count('<svg') == 2
    for words in ('speed limit', 'gradient') if found.line.gradient else ('speed limit',):
        assert words in page
    assert f'{found.train.mass / 1e3:g} t' in capsys.readouterr().out


def test_what_a_train_file_needs_is_listed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, 'import track.railml') == 1
    out = capsys.readouterr().out
    assert '# missing: train.mass; resistance.a; resistance.b; resistance.c\n' in out
    assert '# next: enter what is missing, then trainid train show T.yaml' in out


def test_what_comes_from_a_train_file_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = 'train: {mass: 2e5, mass_std: 0.002, cars: 6}\nresistance: {a: 1.0, b: 0.0, c: 0.01}\nbrake: {delay: 0.9}\n'
    (folder / 'old.yaml').write_text(text, encoding='utf-8')
    assert run(folder, 'import old.yaml stock.json') == 0
    out = capsys.readouterr().out
    assert 'train.cars, brake of old.yaml' in ' '.join(out.replace('#', '').split())
    assert 'mass_std' not in out


def test_the_std_of_a_mass_stays_with_the_last_file_that_states_both(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, mass, std in (('old', 2e5, 0.002), ('new', 3e5, 0.004)):
        (folder / f'{name}.yaml').write_text(f'train: {{mass: {mass}, mass_std: {std}}}\n', encoding='utf-8')
    run(folder, 'import old.yaml new.yaml --json')
    assert json.loads(capsys.readouterr().out)['train_file']['train'] == {'mass': 3e5, 'mass_std': 0.004}


def test_an_imported_file_that_was_edited_is_kept(
    folder: Path, capsys: pytest.CaptureFixture[str], one_error: Callable[[], str]
) -> None:
    for _ in range(2):
        assert run(folder, 'import track.railml --out T.yaml') == 1
    capsys.readouterr()
    edited = (folder / 'T.yaml').read_text(encoding='utf-8') + 'train: {mass: 2e5}\n'
    (folder / 'T.yaml').write_text(edited, encoding='utf-8')
    assert run(folder, 'import track.railml --out T.yaml') == 2
    assert 'T.yaml: edited since it was imported' in one_error()
    assert (folder / 'T.yaml').read_text(encoding='utf-8') == edited
    (folder / 'T.yaml').write_bytes(b'# trainid train import 00000000\n# Z\xfcge\n')
    assert run(folder, 'import track.railml --out T.yaml') == 2
    assert 'T.yaml' in one_error()


def test_json_holds_all_of_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, 'import stock.json --json') == 0
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert answer['train_file']['resistance']['a'] == pytest.approx(0.6118, abs=1e-4)
    assert (answer['missing'], answer['out']) == ([], None)
    assert 'line.stops' in answer['not_stated']
    run(folder, 'import stock.json --out T.yaml')
    capsys.readouterr()
    assert run(folder, 'show T.yaml --json') == 0
    assert json.loads(capsys.readouterr().out)['train_file']['train']['mass'] == 9e5


def test_a_value_out_of_range_and_a_file_of_the_user_are_refused(folder: Path, one_error: Callable[[], str]) -> None:
    (folder / 'stock.json').write_text(json.dumps(STOCK_OSRD | {'mass': 10.0}), encoding='utf-8')
    assert run(folder, 'import stock.json --out T.yaml') == 2
    assert 'resistance.a' in one_error()
    assert not (folder / 'T.yaml').exists()
    (folder / 'T.yaml').write_text('train: {mass: 1}\n', encoding='utf-8')
    assert run(folder, 'import stock.xml --out T.yaml') == 2
    assert 'T.yaml: exists and was not written by trainid' in one_error()


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        ({'rolling_resistance': {'type': 'davis', 'A': 5.4, 'B': 0.2, 'C': 0.012}}, 'resistance at 10 m/s = 0.00'),
        ({'mass': 900.0, 'rolling_resistance': {'type': 'davis', 'A': 9.0, 'B': 0.0, 'C': 0.0}}, 'train.mass = 900 kg'),
    ],
)
def test_values_that_no_train_has_are_said(
    folder: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], problem: str
) -> None:
    assert run(folder, 'import stock.json --out T.yaml') == 0
    assert 'check' not in (folder / 'T.yaml').read_text(encoding='utf-8').partition('\ntrain:')[0]
    (folder / 'stock.json').write_text(json.dumps(STOCK_OSRD | change), encoding='utf-8')
    capsys.readouterr()
    assert run(folder, 'import stock.json --out T.yaml') == 0
    text = (folder / 'T.yaml').read_text(encoding='utf-8')
    assert f'# check: {problem}' in text
    assert run(folder, 'show T.yaml') == 0
    said = capsys.readouterr().out
    assert f'\ncheck: {problem}' in f'\n{said}'
    assert f'\nCheck: {problem}' in said


def test_effects_are_shown_with_values_and_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / 'T.yaml').write_text(
        'train: {mass: 2e5, cars: 1}\nresistance: {a: 1.5, b: 0.0, c: 0.01}\neffects:\n'
        '- {name: mass_error, parameters: {ratio: 1.15}, std: {ratio: 0.02}, runs: [2, 3]}\n'
        '- {name: headwind, parameters: {speed: 3.0}}\n',
        encoding='utf-8',
    )
    assert run(folder, 'show T.yaml') == 0
    said = capsys.readouterr().out
    assert ', 1 car, ' in said
    unstated = 'train.length, train.max_speed, train.rotary_mass, brake.rate, brake.delay, brake.time_constant'
    assert f'Assumed: {unstated}: not in the file\n' in said
    assert 'Effect: mass_error: ratio = 1.150 ± 0.020, on runs 2 and 3 only\n' in said
    assert 'Effect: headwind: speed = 3 m/s\n' in said


@pytest.mark.parametrize('command', ['show brake.yaml', 'import stock.json brake.yaml'])
def test_runs_of_an_effect_on_records_are_refused(command: str, folder: Path, one_error: Callable[[], str]) -> None:
    text = 'effects: [{name: wheel_diameter, parameters: {ratio: 1.02}, runs: [1]}]\n'
    if 'show' in command:
        text += 'train: {mass: 2e5}\nresistance: {a: 1.5, b: 0.0, c: 0.01}\n'
    (folder / 'brake.yaml').write_text(text, encoding='utf-8')
    assert run(folder, command) == 2
    assert 'effect wheel_diameter: runs: it acts on all records' in one_error()
