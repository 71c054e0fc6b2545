# SPDX-License-Identifier: Apache-2.0
"""A bag with topics, types and units of others gives the same records as ours, by a mapping."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from test.foreign_bag import FLOAT, TWIST, ForeignBag, write_foreign
from test.foreign_bag import MAPPING as FOREIGN
from trainid_ros.bag.reader import BagReader, missing_topics
from trainid_ros.cli.main import main
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import BrakeRecord, ForceRecord, Record, SpeedRecord
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import Davis, Train, TrainFile, load_train_file

TRAIN = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001))
TRAINS = """
speed: {topic: odo, field: twist.linear.x, unit: km/h}
position: {topic: distance, field: data, stamp: receive}
force: {topic: force, field: data, stamp: receive}
gradient: {from: line}
brake_command: {topic: /both/brake, field: data, stamp: receive}
"""
TRAIN_PATH = Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml'
METRO = load_train_file(TRAIN_PATH)
MAPPING = FOREIGN.replace('/odo/twist', 'odo/twist')


@pytest.fixture(scope='module')
def foreign(tmp_path_factory: pytest.TempPathFactory, records: list[Record]) -> Path:
    path = tmp_path_factory.mktemp('foreign') / 'bag'
    write_foreign(path, records)
    return path


def reader(path: Path, text: str = MAPPING, namespace: str = '/') -> BagReader:
    return BagReader(path, namespace, inputs=partial(MappedInputs, parse_mapping(text, 'map.yaml'), TRAIN))


def test_the_records_are_those_of_our_own_topics(foreign: Path, records: list[Record]) -> None:
    with reader(foreign) as bag:
        found = list(bag.records())
        assert missing_topics(bag) == ()
        assert bag.input_count == 6 * len(records) // 4
    assert len(found) == len(records)
    for record, expected in zip(sorted(found, key=key), sorted(records, key=key), strict=True):
        assert record.row()[:2] == expected.row()[:2]
        assert record.row()[2] == pytest.approx(expected.row()[2], rel=1e-6)
        if isinstance(expected, SpeedRecord):
            assert record.row()[3] == pytest.approx(expected.position)


def key(record: Record) -> tuple[int, int]:
    return record.stamp_ns, record.row()[0]


@pytest.mark.parametrize(
    ('text', 'missing'),
    [
        (MAPPING.replace('/car2', '/car3'), ('/car3/force',)),
        (MAPPING.replace('odo/twist', 'other'), ('other',)),
        ('speed: {topic: /odo/twist, field: twist.linear.x}', ('ato/force', 'ato/gradient', 'ato/brake_command')),
    ],
)
def test_topics_of_the_mapping_that_are_missing_are_named(foreign: Path, text: str, missing: tuple[str, ...]) -> None:
    with reader(foreign, text) as bag:
        assert missing_topics(bag) == missing


def test_a_topic_of_the_mapping_without_a_type_is_named(tmp_path: Path) -> None:
    path = tmp_path / 'x.mcap'
    writer = Writer(str(path))
    writer.start('ros2')
    writer.add_message(writer.register_channel('/odo/twist', 'cdr', schema_id=0), 1, b'', 1)
    writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(InputError, match=r'x\.mcap: topic /odo/twist: the file states no type'), reader(path):
        pass


def test_a_relative_topic_lies_in_the_namespace(foreign: Path) -> None:
    with reader(foreign, MAPPING.replace('odo/twist', 'twist'), '/odo') as bag:
        assert missing_topics(bag) == ()
        assert sum(isinstance(record, SpeedRecord) for record in bag.records()) > 0


def test_trains_of_one_bag_are_replayed_by_one_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = simulate(Scenario(METRO, runs=1), np.random.default_rng(3)).records
    with ForeignBag(tmp_path / 'bag') as bag:
        for record in records:
            match record:
                case SpeedRecord(now, speed, position):
                    for name, factor in (('/train_1', 3.6), ('/train_2', 7.2)):
                        bag.write(f'{name}/odo', TWIST, now, twist__linear__x=factor * speed)
                        bag.write(f'{name}/distance', FLOAT, now, data=position)
                case ForceRecord(now, force):
                    bag.write('/train_1/force', FLOAT, now, data=force)
                    bag.write('/train_2/force', FLOAT, now, data=2.0 * force)
                case BrakeRecord(now, target):
                    bag.write('/both/brake', FLOAT, now, data=target)
    mapping = tmp_path / 'map.yaml'
    mapping.write_text(TRAINS, encoding='utf-8')
    info = ['info', str(tmp_path / 'bag'), '--map', str(mapping), '--train', str(TRAIN_PATH), '--json']
    tops = []
    for name, finding in (('/train_1', ''), ('/train_2', 'inputs contradict each other')):
        assert main([*info, '--namespace', name]) == bool(finding)  # the second is twice as fast for the same command
        captured = capsys.readouterr()
        assert finding in captured.err
        ranges = json.loads(captured.out)['ranges']
        tops.append([item['high'] for item in ranges if item['field'] in {'speed', 'force'}])
    assert tops[1] == pytest.approx([2.0 * value for value in tops[0]])
    assert main([*info, '--namespace', '/train_3']) == 1
    assert 'no messages on odo, force' in capsys.readouterr().err


def test_a_field_that_does_not_exist_is_named(foreign: Path) -> None:
    text = r'/bag: topic odo/twist: field twist\.linear\.w is not a number of geometry_msgs/msg/TwistStamped '
    text += r'\(fields of twist.linear: x, y, z\)'
    with reader(foreign, MAPPING.replace('linear.x', 'linear.w')) as bag, pytest.raises(InputError, match=text):
        list(bag.records())


def test_replay_takes_a_mapping_file(foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mapping, train = tmp_path / 'map.yaml', tmp_path / 'train.yaml'
    train.write_text('train: {mass: 194000.0}\nresistance: {a: 1.5, b: 0.02, c: 0.001}\n', encoding='utf-8')
    mapping.write_text(MAPPING, encoding='utf-8')
    assert main(['replay', str(foreign), '--train', str(train), '--map', str(mapping)]) in (0, 1)
    assert '50 samples' in capsys.readouterr().out
    params = tmp_path / 'params.yaml'
    params.write_text(f'/**: {{ros__parameters: {{mapping_file: {mapping}}}}}', encoding='utf-8')
    assert main(['replay', str(foreign), '--train', str(train), '--params', str(params)]) in (0, 1)
    assert '50 samples' in capsys.readouterr().out
    mapping.write_text('speed: {topic: /x}', encoding='utf-8')
    assert main(['replay', str(foreign), '--train', str(train), '--map', str(mapping)]) == 2
    assert 'map.yaml: speed.field is missing' in capsys.readouterr().err


OUTSIDE = '/brake, /car1/force, /car2/force, /load, /odo/distance, /track/slope'


@pytest.mark.parametrize(('namespace', 'outside'), [('/', ''), ('/train_2', OUTSIDE)])
def test_topics_outside_the_namespace_are_named(foreign: Path, namespace: str, outside: str) -> None:
    text = f'mapping: {outside} outside --namespace {namespace}, so they may be of another train'
    with reader(foreign, namespace=namespace) as bag:
        assert [warning.startswith(text) for warning in bag.warnings] == ([True] if outside else [])
