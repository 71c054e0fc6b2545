# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tools.documents import blocks
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.interface.records import ForceRecord, SpeedRecord
from trainid_ros.sim.truth import load_truth
from trainid_ros.train.train_file import load_train_file

REPOSITORY = Path(__file__).parents[2]
TRAIN = REPOSITORY / 'config' / 'trains' / 'yizhuang.yaml'


def simulate(out: Path, *arguments: str) -> int:
    return main(['simulate', str(out), '--train', str(TRAIN), '--runs', '1', *arguments])


def simulate_world(out: Path, *arguments: str) -> int:
    return main(['simulate', str(out), '--runs', '1', *arguments])


def test_bag_truth_and_json_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_the_effect_in_the_documents_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (REPOSITORY / 'docs' / 'effects.md').read_text(encoding='utf-8')
    (example,) = (block.text for block in blocks(page) if block.title == 'effects/snow.py')
    folder = tmp_path / 'effects'
    folder.mkdir()
    (folder / 'snow.py').write_text(example, encoding='utf-8')
    assert simulate(tmp_path / 'none', '--effect', 'snow:drag=2') == 2
    assert 'effect snow is not known' in capsys.readouterr().err
    monkeypatch.setenv('TRAINID_EFFECTS', str(folder))
    assert simulate(tmp_path / 'snow', '--effect', 'snow:drag=2') == 0
    assert simulate(tmp_path / 'clear') == 0
    # The same driver with the same timetable needs more force in snow.
    work = []
    for name in ('snow', 'clear'):
        with BagReader(tmp_path / name) as reader:
            work.append(sum(max(0.0, record.force) for record in reader.records() if isinstance(record, ForceRecord)))
    assert work[0] > 1.05 * work[1]


def test_a_world_writes_the_stated_train_file_beside_the_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'bag'
    assert simulate_world(out, '--world', 'tram', '--realism', 'field', '--json') == 0
    answer = json.loads(capsys.readouterr().out)
    stated, given = load_train_file(out / 'train.yaml'), load_train_file(REPOSITORY / 'config' / 'trains' / 'tram.yaml')
    truth = load_truth(out / 'truth.yaml')
    unknowns = dict(truth.unknowns)
    assert (stated.resistance, stated.line.stops) == (given.resistance, given.line.stops)
    assert stated.brake == replace(given.brake, timing_std=0.2)
    assert 0.02 <= stated.train.mass_std <= 0.05
    assert truth.truth_at(0.0).resistance != stated.resistance
    assert unknowns['brake_delay'] != stated.brake.delay
    assert answer['truth']['unknowns'] == unknowns


def test_clean_worlds_state_the_truth_and_unknowns_can_be_added(tmp_path: Path) -> None:
    speeds = []
    for name, more in (('clean', ()), ('wheels', ('--unknown', 'wheels'))):
        assert simulate_world(tmp_path / name, '--world', 'tram', *more) == 0
        with BagReader(tmp_path / name) as reader:
            speeds.append([record.speed for record in reader.records() if isinstance(record, SpeedRecord)])
    clean, wheels = (load_truth(tmp_path / name / 'truth.yaml') for name in ('clean', 'wheels'))
    stated = load_train_file(tmp_path / 'clean' / 'train.yaml')
    assert clean.truth_at(0.0).resistance == stated.resistance
    assert dict(clean.unknowns)['mass_ratio'] == 1.0
    changed = {key for key, value in wheels.unknowns if dict(clean.unknowns)[key] != value}
    assert changed == {'wheel_ratio'}
    # The same drive and the same noise, measured by other wheels and rounded.
    ratio = dict(wheels.unknowns)['wheel_ratio']
    assert speeds[1] == pytest.approx([ratio * speed for speed in speeds[0]], abs=0.2 / 3.6)


def test_a_world_can_use_another_train_and_adds_effects_only_to_the_truth(tmp_path: Path) -> None:
    arguments = ('--world', 'metro', '--train', str(TRAIN), '--effect', 'brake_scale:ratio=0.9')
    assert simulate_world(tmp_path / 'bag', *arguments) == 0
    assert load_train_file(tmp_path / 'bag' / 'train.yaml').effects == ()
    assert load_truth(tmp_path / 'bag' / 'truth.yaml').truth_at(0.0).brake_rate == 0.9


def test_without_a_world_nothing_but_bag_and_truth_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path / 'bag', '--json') == 0
    assert set(json.loads(capsys.readouterr().out)['truth']) == {'start_ns', 'resistance', 'brake_rate'}
    assert {path.name for path in (tmp_path / 'bag').iterdir()} == {'metadata.yaml', 'bag.mcap', 'truth.yaml'}


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        ((), 'no train: give --train T.yaml or --world NAME'),
        (('--train', str(TRAIN), '--realism', 'field'), '--realism needs --world'),
        (('--train', str(TRAIN), '--unknown', 'mass'), '--unknown needs --world'),
        (('--world', 'metro', '--unknown', 'curve'), 'unknown curve: '),
        (('--world', 'tram', '--runs', '0'), 'runs = 0'),
        (('--world', 'tram', '--train', 'nope.yaml'), 'nope.yaml'),
        (('--world', 'tram', '--effect', 'curve_resistance:coefficient=5'), 'curve_resistance: the true train has it'),
    ],
)
def test_invalid_world_options_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], named: str
) -> None:
    assert simulate_world(tmp_path / 'bag', *arguments) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert captured.err.count('\n') == 1
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize(
    ('arguments', 'option'),
    [
        (('--world', 'tramm'), '--world'),
        (('--world', 'tram', '--realism', 'real'), '--realism'),
        (('--world', 'tram', '--unknown', 'weels'), '--unknown'),
    ],
)
def test_unknown_names_are_usage_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], option: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        simulate_world(tmp_path / 'bag', *arguments)
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert f'argument {option}: invalid choice' in error
    assert error.count('\n') == 1
