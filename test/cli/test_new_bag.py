# SPDX-License-Identifier: Apache-2.0
"""``trainid import`` makes a bag of a table, ``trainid simulate`` one with its truth, or a fleet; none leaves half."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tools.documents import blocks
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.fleet.table_file import find_bags, label_rule, list_bags
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord
from trainid_ros.sim.truth import load_truth
from trainid_ros.sim.worlds import WORLDS, world_train
from trainid_ros.train.train_file import dump_train_file, load_train_file

ROOT = Path(__file__).parents[2]
TRAIN = ROOT / 'config' / 'trains' / 'yizhuang.yaml'
MAPPING = """
time:          {field: Zeit, start: 2023-11-14T22:13:20Z}
speed:         {field: v, unit: km/h}
position:      {field: Weg, unit: km}
force:         {field: F, unit: kN}
gradient:      {field: Steigung, unit: deg}
brake_command: {field: Bremse, unit: percent_of 1.2 m/s^2, sign: -1}
"""


Driven = list[tuple[Any, ...]]


@pytest.fixture(scope='module')
def driven(driven_bag: Path) -> Driven:
    """Return what a bag holds at each of its speeds."""
    found: dict[type[Record], list[Record]] = {}
    with BagReader(driven_bag) as reader:
        for record in reader.records():
            found.setdefault(type(record), []).append(record)
    return list(zip(*(found[kind] for kind in (SpeedRecord, ForceRecord, GradientRecord, BrakeRecord)), strict=True))


def write(folder: Path, driven: Driven) -> Path:
    """Write a CSV file as a German logger does, and its mapping; return the file."""
    start_ns = 1_700_000_000 * NS_PER_S
    lines = ['Fahrzeug;4711', 'Zeit;v;Weg;F;Steigung;Bremse', 's;km/h;km;kN;°;%']
    for speed, force, gradient, brake in driven:
        row = (
            (speed.stamp_ns - start_ns) / NS_PER_S,
            3.6 * speed.speed,
            speed.position / 1e3,
            force.force / 1e3,
            math.degrees(math.asin(gradient.gradient / 1e3)),
            -brake.target_acceleration / 0.012,
        )
        lines.append(';'.join(f'{number:.9g}'.replace('.', ',') for number in row))
    path = folder / 'log.csv'
    path.write_text('\r\n'.join(lines), encoding='latin-1', newline='')
    (folder / 'map.yaml').write_text(MAPPING, encoding='utf-8')
    return path


def call(path: Path, *arguments: str) -> int:
    return main(['import', str(path), str(path.parent / 'bag'), '--map', str(path.parent / 'map.yaml'), *arguments])


def test_a_csv_file_becomes_the_bag_that_it_was_made_of(
    tmp_path: Path, driven: Driven, driven_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    assert call(path, '--json') == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown['rows'] == len(driven)
    assert shown['blank'] == {}
    assert set(shown['messages'].values()) == {len(driven)}
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.warnings == []
        found = sorted(reader.records(), key=lambda record: (record.stamp_ns, record.row()[0]))
    for record, (stamp_ns, other) in zip(found, ((row[0].stamp_ns, x) for row in driven for x in row), strict=True):
        assert type(record) is type(other)
        assert record.stamp_ns == pytest.approx(stamp_ns, abs=1e3)
        assert record.row()[2:4] == pytest.approx(other.row()[2:4], rel=1e-6, abs=1e-6)
    assert main(['replay', str(tmp_path / 'bag'), '--train', str(driven_bag / 'train.yaml')]) == 0
    assert sorted(item.name for item in tmp_path.iterdir()) == ['bag', 'log.csv', 'map.yaml']


def test_three_commands_lead_from_a_file_to_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is printed by the one before."""
    for slow in ('suggested_drive', 'suggested_braking'):  # without which there is a report too
        monkeypatch.setattr(f'trainid_ros.cli.replay.{slow}', lambda *_: None)
    monkeypatch.setattr('trainid_ros.report.page.to_svg', lambda *_: '')
    lines = (ROOT / 'bags' / 'logger.csv').read_bytes().splitlines(keepends=True)
    log, train = tmp_path / 'a log.csv', ROOT / 'bags' / 'tiny' / 'train.yaml'
    log.write_bytes(b''.join((*lines[:3], *lines[3:503:5])))  # at 1 Hz, for speed

    def next_of(text: str) -> list[str]:
        (command,) = re.findall(r'^(?:trainid: )?next: trainid (.*)$', text, re.MULTILINE)
        return shlex.split(command)

    assert main(['import', str(log), '--suggest-map', '--train', str(train)]) == 0
    mapping, said = capsys.readouterr()
    (tmp_path / 'map.yaml').write_text(mapping, encoding='utf-8')
    command = next_of(said)
    command[command.index('map.yaml')] = str(tmp_path / 'map.yaml')
    assert main(command) == 0
    assert main(next_of(capsys.readouterr().out)) == 0
    assert {'a log', 'a log.html'} <= {item.name for item in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ('arguments', 'error'),
    [
        ([], r'OUT and --map are missing; trainid import \S*log\.csv --suggest-map > map\.yaml proposes a mapping'),
        (['out'], r'--map is missing; trainid import'),
        (['out', '--suggest-map'], r'--suggest-map takes a table alone'),
    ],
)
def test_what_an_import_lacks_is_said(
    tmp_path: Path, arguments: list[str], error: str, one_error: Callable[[], str]
) -> None:
    assert main(['import', str(tmp_path / 'log.csv'), *arguments]) == 2
    assert re.search(error, one_error())


def test_a_suggested_mapping_names_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / 'log.csv'
    rows = (f'{0.2 * k:.1f},{5.0 + 0.1 * k:.1f}' for k in range(100))
    log.write_text('\n'.join(('t,v [m/s]', *rows)), encoding='utf-8')
    assert main(['import', str(log), '--suggest-map', '--json']) == 1
    shown = json.loads(capsys.readouterr().out)
    assert shown['missing'] == ['force', 'gradient', 'brake_command']
    assert 'speed: {field: "v [m/s]", unit: m/s}' in shown['mapping']


def test_the_line_of_a_train_file_gives_the_gradient(tmp_path: Path) -> None:
    columns = (ROOT / 'config' / 'mappings' / 'logger.yaml').read_text(encoding='utf-8')
    from_line = re.sub(r'(?m)^gradient:.*$', 'gradient: {from: line}', columns)
    found = []
    for name, text in (('column', columns), ('line', from_line)):
        (tmp_path / 'map.yaml').write_text(text, encoding='utf-8')
        train = str(ROOT / 'bags' / 'tiny' / 'train.yaml')
        bag, mapping = str(tmp_path / name), str(tmp_path / 'map.yaml')
        assert main(['import', str(ROOT / 'bags' / 'logger.csv'), bag, '--map', mapping, '--train', train]) == 0
        with BagReader(bag) as reader:
            found.append([record.gradient for record in reader.records() if isinstance(record, GradientRecord)])
    column, line = found
    # The logger saw the map of the line with errors of .05 per mille.
    assert line == pytest.approx(column, abs=0.5)
    assert max(map(abs, line)) > 1.0


def test_an_error_is_one_line_and_leaves_nothing_behind(
    tmp_path: Path, driven: Driven, one_error: Callable[[], str]
) -> None:
    path = write(tmp_path, driven)
    with path.open('a', encoding='latin-1') as file:
        file.write('\r\n400,0;zwei;1;1;1;1')
    assert call(path) == 2
    error = one_error()
    assert f"{path}: line {len(driven) + 4}: column 'v' = 'zwei' is not a number" in error
    assert not (tmp_path / 'bag').exists()
    assert sorted(item.name for item in tmp_path.iterdir()) == ['log.csv', 'map.yaml']


def test_a_unit_that_is_not_the_one_in_the_file_is_a_warning(
    tmp_path: Path, driven: Driven, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path, driven)
    (tmp_path / 'map.yaml').write_text(MAPPING.replace('{field: v, unit: km/h}', '{field: v}'), encoding='utf-8')
    assert call(path) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"trainid: warning: {path}: column 'v': the file says km/h, the mapping m/s"


def test_a_notch_that_is_not_in_the_table_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / 'log.csv'
    rows = [f'{0.2 * k:.1f},{10.0},{0.0},{k // 10}' for k in range(40)]
    log.write_text('\n'.join(('t,v,F,notch', *rows)), encoding='utf-8')
    (tmp_path / 'map.yaml').write_text(
        'time: {field: t}\nspeed: {field: v}\nforce: {field: F}\ngradient: {value: 0.0}\n'
        'brake_command: {field: notch, table: {0: 0.0, 2: -0.5}}\n',
        encoding='utf-8',
    )
    assert call(log) == 0
    out, err = capsys.readouterr()
    for notch in (1, 3):
        assert f"{log}: column 'notch': {notch} is not in table of the mapping (10 rows)" in err
    assert 'rows without a value: brake_command 20' in out


def test_nothing_is_written_over(tmp_path: Path, driven: Driven, one_error: Callable[[], str]) -> None:
    path = write(tmp_path, driven)
    before = path.read_bytes()
    for arguments in (['import', str(path), str(path), '--map', str(tmp_path / 'map.yaml')],
                      ['simulate', str(path), '--train', str(TRAIN)]):  # fmt: skip
        assert main(arguments) == 2
        assert one_error() == f'trainid: error: {path}: exists already and is not overwritten'
    assert path.read_bytes() == before


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'log.csv'
    path.write_text('t,v\n0,1\n0.2,\n0.1,2\n', encoding='utf-8')
    (tmp_path / 'map.yaml').write_text('{time: {field: t}, speed: {field: v}}', encoding='utf-8')
    assert call(path) == 0
    out, err = capsys.readouterr()
    assert 'rows without a value: speed 1' in out
    assert '1 row earlier than one before' in err
    assert 'no messages on ato/force, ato/gradient, ato/brake_command' in err
    path.write_text('t,v\n0,\n', encoding='utf-8')
    assert main(['import', str(path), str(tmp_path / 'bag2'), '--map', str(tmp_path / 'map.yaml')]) == 2
    assert 'log.csv: nothing in 1 row has a time and a value' in capsys.readouterr().err
    mapping = '{time: {field: t}, speed: {field: v}, gradient: {from: line}}'
    (tmp_path / 'map.yaml').write_text(mapping, encoding='utf-8')
    assert main(['import', str(path), str(tmp_path / 'bag2'), '--map', str(tmp_path / 'map.yaml')]) == 2
    assert 'no train file is given (--train)' in capsys.readouterr().err


def simulate(out: Path, *arguments: str, train: Path | None = TRAIN) -> int:
    stated = () if train is None else ('--train', str(train))
    return main(['simulate', str(out), *stated, '--runs', '1', *arguments])


def test_bag_truth_and_json_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'bag'
    assert simulate(out, '--effect', 'resistance_step:time=60', '--effect', 'resistance_step:a=0.5', '--json') == 0
    answer = json.loads(capsys.readouterr().out)
    with BagReader(out) as reader:
        assert {topic.name: topic.count for topic in reader.topics()} == answer['messages']
    assert set(answer['truth']) == {'start_ns', 'resistance', 'brake_rate'}
    assert {path.name for path in out.iterdir()} == {'metadata.yaml', 'bag.mcap', 'truth.yaml'}
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


def test_the_effect_in_the_documents_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / 'docs' / 'effects.md').read_text(encoding='utf-8')
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
    assert simulate(out, '--world', 'tram', '--realism', 'field', '--json', train=None) == 0
    answer = json.loads(capsys.readouterr().out)
    stated, given = load_train_file(out / 'train.yaml'), load_train_file(ROOT / 'config' / 'trains' / 'tram.yaml')
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
        assert simulate(tmp_path / name, '--world', 'tram', *more, train=None) == 0
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
    assert simulate(tmp_path / 'bag', *arguments, train=None) == 0
    assert load_train_file(tmp_path / 'bag' / 'train.yaml').effects == ()
    assert load_truth(tmp_path / 'bag' / 'truth.yaml').truth_at(0.0).brake_rate == 0.9


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        ('--train TRAIN --effect foo:x=1', 'foo'),
        ('--train TRAIN --effect tunnel_drag:factr=2', 'tunnel_drag:factr'),
        ('--train TRAIN --effect tunnel_drag:factor=much', "'much'"),
        ('--train TRAIN --effect tunnel_drag', 'NAME:key=value'),
        ('--train TRAIN --runs 0', 'runs = 0'),
        ('--train nope.yaml', 'nope.yaml'),
        ('', 'no train: give --train T.yaml or --world NAME'),
        ('--train TRAIN --realism field', '--realism needs --world'),
        ('--train TRAIN --unknown mass', '--unknown needs --world'),
        ('--world metro --unknown curve', 'unknown curve: '),
        ('--world tram --runs 0', 'runs = 0'),
        ('--world tram --train nope.yaml', 'nope.yaml'),
        ('--world tram --effect curve_resistance:coefficient=5', 'curve_resistance: the true train has it'),
        ('--world tramm', 'argument --world: invalid choice'),
        ('--world tram --realism real', 'argument --realism: invalid choice'),
        ('--world tram --unknown weels', 'argument --unknown: invalid choice'),
        ('--world tram --seed -1', "argument --seed: '-1' is not a whole number >= 0"),
    ],
)
def test_bad_arguments_are_named_and_leave_nothing(
    tmp_path: Path, one_error: Callable[[], str], arguments: str, named: str
) -> None:
    code: object
    try:
        code = simulate(tmp_path / 'bag', *arguments.replace('TRAIN', str(TRAIN)).split(), train=None)
    except SystemExit as error:  # of the parser
        code = error.code
    assert code == 2
    assert named in one_error()
    assert not (tmp_path / 'bag').exists()


def simulate_fleet(out: Path, *options: str) -> int:
    return main(['simulate', str(out), '--runs', '1', *options])


def test_bags_have_train_and_day_and_the_next_command_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'my fleet'
    fault = 'T02:wheel_diameter:ratio=1.02:2'
    assert simulate_fleet(out, '--fleet', '2', '--days', '2', '--fault', fault) == 0
    text = capsys.readouterr().out
    bags = list_bags(find_bags([out]), label_rule(None))
    days = ('2026-01-01', '2026-01-02')
    assert [(bag.train, bag.day) for bag in bags] == [(train, day) for train in ('T01', 'T02') for day in days]
    assert all((Path(bag.path) / 'truth.yaml').is_file() for bag in bags)
    assert '2 trains, 2 days, 4 bags; faults: T02' in text
    replay, report = text.splitlines()[-1].removeprefix('next: ').split(' && ')
    assert shlex.split(replay)[2:5] == [str(out), '--train', str(out / 'train.yaml')]
    assert shlex.split(report)[:4] == ['trainid', 'fleet', 'report', shlex.split(replay)[-1]]
    assert [item.name for item in tmp_path.iterdir()] == [out.name]
    assert simulate_fleet(out, '--fleet', '2') == 2


@pytest.mark.parametrize(
    ('options', 'problem'),
    [
        (('--days', '3'), '--days needs --fleet N'),
        (('--fault', 'T01:brake_scale:ratio=0.8:2'), '--fault needs --fleet N'),
        (('--fleet', '2', '--days', '0'), '--days = 0 must be >= 1'),
        (('--fleet', '2', '--effect', 'headwind:speed=3'), '--effect is of a single bag'),
        (('--fleet', '2', '--fault', 'T03:brake_scale:ratio=0.8:2'), 'the trains are T01 to T02'),
    ],
)
def test_wrong_options_leave_nothing_behind(
    tmp_path: Path, options: tuple[str, ...], problem: str, one_error: Callable[[], str]
) -> None:
    assert simulate_fleet(tmp_path / 'fleet', *options) == 2
    assert problem in one_error()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('options', [(), ('--fleet', '1', '--days', '1')], ids=['bag', 'fleet'])
def test_effects_on_runs_that_the_drive_does_not_have_are_named(
    tmp_path: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    path, text = tmp_path / 'T.yaml', dump_train_file(world_train(WORLDS['metro']))
    effect = '{name: mass_error, parameters: {ratio: 1.15}, runs: [1, 40, 41]}'
    path.write_text(text.replace('effects: []', f'effects: [{effect}]'), encoding='utf-8')
    assert simulate_fleet(tmp_path / 'out', '--train', str(path), *options) == 0
    assert capsys.readouterr().err == ('trainid: warning: effect mass_error: the drive has 1 run, not runs 40, 41\n')


@pytest.mark.long
def test_the_printed_commands_make_a_page_that_names_the_faults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faults = {'T02': 'wheel_diameter:ratio=1.02', 'T04': 'brake_scale:ratio=0.85'}
    given = [word for train, effect in faults.items() for word in ('--fault', f'{train}:{effect}:4')]
    assert simulate_fleet(tmp_path / 'fleet', '--fleet', '6', '--days', '6', '--json', *given) == 0
    for command in json.loads(capsys.readouterr().out)['next']:
        assert main(shlex.split(command)[1:]) == 0
    text = (tmp_path / 'fleet' / 'report.html').read_text(encoding='utf-8')
    for cause in ('wrong wheel diameter: measure the wheels', 'worn or glazed brake pads: check thickness'):
        assert cause in text
