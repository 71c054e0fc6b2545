# SPDX-License-Identifier: Apache-2.0
"""Suggested mappings of bags of several makers: what is found, in which unit, and that the replay is the same."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from test.foreign_bag import FLOAT, INT, ODOMETRY, TWIST, WRENCH, ForeignBag
from test.own_bag import write_bag
from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.inputs.mapped_inputs import MappedInputs
from trainid_ros.inputs.mapping import QUANTITIES, Mapping, Signal, Source, parse_mapping
from trainid_ros.inspection.choice import Suggestion, comment
from trainid_ros.inspection.number_series import NumberSeries, family, read_numbers, score, unit_in, words_of
from trainid_ros.inspection.suggest import suggest
from trainid_ros.interface.records import (
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import TrainFile

ROOT = Path(__file__).parents[2]
TRAIN = str(ROOT / 'config' / 'trains' / 'yizhuang.yaml')
NOTCHES = (0.0, -0.3, -0.6, -0.9)
Write = Callable[[ForeignBag, Record], None]


@pytest.fixture(scope='module')
def ride(metro: TrainFile) -> list[Record]:
    """Return five minutes of driving, without curves and tunnels, which no topic of others carries."""
    records = simulate(Scenario(metro, runs=2), np.random.default_rng(3)).records
    return [replace(r, curve_radius=0.0, tunnel=False) if isinstance(r, GradientRecord) else r for r in records]


def written(path: Path, records: Iterable[Record], write: Write) -> Path:
    with ForeignBag(path) as bag:
        for record in records:
            write(bag, record)
    return path


def stamped(bag: ForeignBag, record: Record) -> None:
    """Write what a maker with headers writes: km/h, kN of two cars, a gradient in percent, m/s^2 with + for braking."""
    now = record.stamp_ns
    match record:
        case SpeedRecord(_, speed, position):
            bag.write('/odo/twist', TWIST, now, twist__linear__x=3.6 * speed, twist__linear__z=0.01)
            bag.write('/odo/chainage', FLOAT, now, data=position / 1e3)
        case ForceRecord(_, force):
            for car, share in ((1, 0.5e-3), (2, 0.5e-3)):
                bag.write(f'/car{car}/force', WRENCH, now, wrench__force__x=-share * force)
        case GradientRecord(_, gradient):
            bag.write('/track/slope', FLOAT, now, data=0.1 * gradient)
        case BrakeRecord(_, target):
            bag.write('/brake/deceleration', FLOAT, now, data=-target)
        case MassRecord(_, mass):
            bag.write('/train/load', FLOAT, now, data=mass / 1e3)


class Plain:
    """Writes what a maker of robots writes: Odometry, forces as plain numbers, notches only when they change."""

    def __init__(self) -> None:
        self._notch = -1
        self._rng = np.random.default_rng(4)
        self._speed = (0, 0.0)

    def __call__(self, bag: ForeignBag, record: Record) -> None:
        now = record.stamp_ns
        match record:
            case SpeedRecord(_, speed, position):
                noise = self._rng.normal(0.0, 0.1, 3)
                slope = (speed - self._speed[1]) / max((now - self._speed[0]) / 1e9, 0.1)
                self._speed = now, speed
                bag.write('/odom', ODOMETRY, now, twist__twist__linear__x=speed, pose__pose__position__x=position)
                bag.write('/gps/velocity', TWIST, now, twist__linear__x=speed + noise[0])
                bag.write('/motor/temperature', FLOAT, now, data=60.0 + 0.2 * speed + noise[1])
                bag.write('/imu', 'sensor_msgs/msg/Imu', now, linear_acceleration__x=slope + noise[2])
                bag.write('/cam', 'sensor_msgs/msg/Image', now, data=np.zeros(5000, dtype=np.uint8))
                bag.write('/lidar', 'sensor_msgs/msg/MagneticField', now, magnetic_field__x=noise[0])
            case ForceRecord(_, force):
                for end in ('front', 'rear'):
                    bag.write(f'/traction_{end}/effort', FLOAT, now, data=0.5e-3 * force)
            case GradientRecord(_, gradient):
                bag.write('/map/gradient_permille', FLOAT, now, data=gradient)
            case BrakeRecord(_, target) if (notch := notch_of(target)) != self._notch:
                self._notch = notch
                bag.write('/desk/brake_notch', INT, now, data=notch)


def notch_of(target: float) -> int:
    return min(range(len(NOTCHES)), key=lambda k: abs(NOTCHES[k] - target))


def suggested(path: Path, train: TrainFile | None = None, namespace: str = '/') -> Suggestion:
    return suggest(read_numbers(path, namespace, 64 << 20), path.name, train)


def mapping_of(suggestion: Suggestion) -> Mapping:
    return parse_mapping(suggestion.text(), 'map.yaml')


def sources(signal: object) -> tuple[Source, ...]:
    assert isinstance(signal, Signal)
    return signal.sources


def chosen(mapping: Mapping) -> dict[str, set[tuple[str, str, float]]]:
    """Return name, unit and sign of the sources of each quantity."""
    signals = {name: getattr(mapping, name) for name in QUANTITIES}
    return {
        name: {(f'{source.topic} {source.field}', source.unit.name, source.sign) for source in signal.sources}
        for name, signal in signals.items()
        if isinstance(signal, Signal)
    }


def estimates(path: Path, train: TrainFile, mapping: Mapping | None = None) -> list[float]:
    """Return what the three estimators learn from a bag."""
    inputs = None if mapping is None else partial(MappedInputs, mapping, train)
    settings = EstimatorSettings()
    with BagReader(path, inputs=inputs) as reader:
        aligned = replace(settings, alignment=reader.mapping.alignment(settings.alignment))
        outcome = replay_through(Pipelines.of(train, aligned), reader)
    w, m, f = outcome.resistance.output, outcome.speed_model.output, outcome.brake_rate.output
    return [
        *(w.estimate.a, w.estimate.b, w.estimate.c, w.used),
        *(m.estimate.a1, m.estimate.b1, m.used),
        *(f.estimate.brake_rate, f.estimate.brake_rate_std, f.used),
    ]


def test_a_bag_with_headers_is_mapped_and_gives_the_same_estimates(
    ride: list[Record], metro: TrainFile, tmp_path: Path
) -> None:
    foreign = written(tmp_path / 'foreign', ride, stamped)
    suggestion = suggested(foreign, metro)
    mapping = mapping_of(suggestion)
    assert suggestion.missing == ()
    assert chosen(mapping) == {
        'speed': {('/odo/twist twist.linear.x', 'km/h', 1.0)},
        'position': {('/odo/chainage data', 'km', 1.0)},
        'force': {(f'/car{k}/force wrench.force.x', 'kN', -1.0) for k in (1, 2)},
        'gradient': {('/track/slope data', 'percent', 1.0)},
        'brake_command': {('/brake/deceleration data', 'm/s^2', -1.0)},
        'mass': {('/train/load data', 't', 1.0)},
    }
    text = suggestion.text()
    assert 'with d(speed)/dt over' in text
    assert 'mass x acceleration is' in text
    own = write_bag(tmp_path / 'own', ride)
    assert estimates(foreign, metro, mapping) == pytest.approx(estimates(own, metro), rel=1e-6)


def test_a_bag_with_other_sensors_is_mapped_to_those_of_the_train(
    ride: list[Record], metro: TrainFile, tmp_path: Path
) -> None:
    foreign = written(tmp_path / 'foreign', ride, Plain())
    suggestion = suggested(foreign, metro)
    mapping, text = mapping_of(suggestion), suggestion.text()
    assert chosen(mapping) == {
        'speed': {('/odom twist.twist.linear.x', 'm/s', 1.0)},
        'position': {('/odom pose.pose.position.x', 'm', 1.0)},
        'force': {(f'/traction_{end}/effort data', 'kN', 1.0) for end in ('front', 'rear')},
        'gradient': {('/map/gradient_permille data', 'per_mille', 1.0)},
        'brake_command': {('/desk/brake_notch data', 'm/s^2', 1.0)},
    }
    assert mapping.on_change
    (notches,) = sources(mapping.brake_command)
    assert dict(notches.table) == pytest.approx(dict(enumerate(NOTCHES[:3])), abs=0.16)
    assert 'decide: the nominal deceleration of each notch' in text
    assert 'notch 3 was not seen on the move and would be rejected' in text
    assert 'also like a speed: /gps/velocity twist.linear.x' in text
    assert '/cam (sensor_msgs/msg/Image)' in text
    assert '/motor/temperature' in text.partition('not used')[2]
    (by_motion,) = sources(mapping_of(suggested(foreign)).brake_command)
    assert dict(by_motion.table) == pytest.approx(dict(enumerate(NOTCHES[:3])), abs=0.16)
    # The reader decides on the notches.
    inputs = [
        replace(r, target_acceleration=NOTCHES[notch_of(r.target_acceleration)]) if isinstance(r, BrakeRecord) else r
        for r in ride
        if not isinstance(r, MassRecord)
    ]
    own = write_bag(tmp_path / 'own', inputs)
    decided = replace(notches, table=tuple((float(k), value) for k, value in enumerate(NOTCHES)))
    found = estimates(foreign, metro, replace(mapping, brake_command=Signal((decided,))))
    assert found[:7] == pytest.approx(estimates(own, metro)[:7], rel=1e-3)


@pytest.mark.parametrize(
    ('speed_unit', 'speed_factor', 'unit', 'factor'),
    [('mph', 1.0 / 0.44704, 'm', 1.0), ('m/s', 1.0, 'km', 1e-3), ('km/h', 3.6, 'm', 1.0)],
)
def test_units_of_speed_and_position_follow_from_their_ratio(
    ride: list[Record], tmp_path: Path, speed_unit: str, speed_factor: float, unit: str, factor: float
) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/a/velocity', FLOAT, record.stamp_ns, data=speed_factor * record.speed)
            # As by balises: now and then, and set back once.
            if record.stamp_ns // 10**9 % 30 == 0:
                offset = 500.0 * (record.position > 1000.0)
                bag.write('/a/balise_position', FLOAT, record.stamp_ns, data=factor * (record.position - offset))

    assert chosen(mapping_of(suggested(written(tmp_path / 'foreign', ride, write)))) == {
        'speed': {('/a/velocity data', speed_unit, 1.0)},
        'position': {('/a/balise_position data', unit, 1.0)},
    }


def test_what_is_missing_is_said_with_what_to_do(ride: list[Record], metro: TrainFile, tmp_path: Path) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/tacho', FLOAT, record.stamp_ns, data=3.6 * record.speed)
        if isinstance(record, ForceRecord):
            bag.write('/percent/force', FLOAT, record.stamp_ns, data=record.force / 4e3)

    path = written(tmp_path / 'foreign', ride, write)
    suggestion = suggested(path)
    assert suggestion.missing == ('gradient', 'brake_command')
    assert 'gradient: nothing found; {from: line} takes it from the line' in suggestion.text()
    assert 'unit km/h: up to' in suggestion.text()
    mapping = mapping_of(suggested(path, metro))
    assert mapping.position is not None
    assert mapping.gradient is not None
    (force,) = sources(mapping.force)
    assert force.unit.name.startswith('percent_of ')
    assert force.unit.factor == pytest.approx(4e3, rel=0.15)


@pytest.mark.parametrize(
    ('shift', 'said'), [(0.0, 'times the gradients at its positions\n'), (600.0, 'is it this line')]
)
def test_the_gradients_of_the_line_are_compared_with_the_drive(
    ride: list[Record], metro: TrainFile, tmp_path: Path, shift: float, said: str
) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/tacho', FLOAT, record.stamp_ns, data=3.6 * record.speed)
            bag.write('/odo/chainage', FLOAT, record.stamp_ns, data=record.position + shift)
        if isinstance(record, ForceRecord):
            bag.write('/force', FLOAT, record.stamp_ns, data=record.force)

    suggestion = suggested(written(tmp_path / 'foreign', ride, write), metro)
    assert 'gradient: {from: line}' in suggestion.text()
    assert said in suggestion.text()


def test_traction_and_brake_effort_with_signs_of_their_own_are_summed(
    ride: list[Record], metro: TrainFile, tmp_path: Path
) -> None:
    def parts(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/speed', FLOAT, record.stamp_ns, data=record.speed)
        if isinstance(record, ForceRecord):
            bag.write('/drive/tractive_effort', FLOAT, record.stamp_ns, data=max(record.force, 0.0))
            bag.write('/brakes/effort', FLOAT, record.stamp_ns, data=max(-record.force, 0.0))

    def with_total(bag: ForeignBag, record: Record) -> None:
        parts(bag, record)
        if isinstance(record, ForceRecord):
            bag.write('/total/force', FLOAT, record.stamp_ns, data=1e-3 * record.force)

    both = mapping_of(suggested(written(tmp_path / 'both', ride, parts), metro))
    assert chosen(both)['force'] == {('/drive/tractive_effort data', 'N', 1.0), ('/brakes/effort data', 'N', -1.0)}
    total = mapping_of(suggested(written(tmp_path / 'total', ride, with_total), metro))
    assert chosen(total)['force'] == {('/total/force data', 'kN', 1.0)}


def test_a_train_of_several_is_mapped_in_its_namespace(
    ride: list[Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ForeignBag(tmp_path / 'foreign') as bag:
        for record in ride[: len(ride) // 2]:
            if isinstance(record, SpeedRecord):
                for name, factor in (('/train_1', 3.6), ('/train_2', 1.0)):
                    bag.write(f'{name}/odo', TWIST, record.stamp_ns, twist__linear__x=factor * record.speed)
                    bag.write(f'{name}/distance', FLOAT, record.stamp_ns, data=record.position)
    assert main(['info', str(tmp_path / 'foreign'), '--suggest-map']) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.endswith('foreign: two trains here: /train_1, /train_2; use --namespace\n')
    for name, unit in (('/train_1', 'km/h'), ('/train_2', 'm/s')):
        assert main(['info', str(tmp_path / 'foreign'), '--suggest-map', '--namespace', name]) == 1
        captured = capsys.readouterr()
        assert 'nothing found for force, gradient, brake_command' in captured.err
        assert chosen(parse_mapping(captured.out, 'map.yaml')) == {
            'speed': {('odo twist.linear.x', unit, 1.0)},
            'position': {('distance data', 'm', 1.0)},
        }


@pytest.mark.parametrize(('delay_s', 'code'), [(0, 1), (40, 2)])
def test_parts_that_drive_apart_are_trains(
    ride: list[Record], tmp_path: Path, capsys: pytest.CaptureFixture[str], delay_s: int, code: int
) -> None:
    with ForeignBag(tmp_path / 'foreign') as bag:
        for record in ride:
            for name, delay_ns in (('/depot/front', 0), ('/depot/rear', delay_s * 10**9)):
                if isinstance(record, SpeedRecord):
                    bag.write(f'{name}/odo', TWIST, record.stamp_ns + delay_ns, twist__linear__x=record.speed)
                elif isinstance(record, ForceRecord):
                    bag.write(f'{name}/force', FLOAT, record.stamp_ns + delay_ns, data=record.force)
    for namespace in ('/', '/depot'):
        assert main(['info', str(tmp_path / 'foreign'), '--suggest-map', '--namespace', namespace]) == code
        trains = 'two trains here: /depot/front, /depot/rear; use --namespace'
        assert (trains in capsys.readouterr().err) == (code == 2)


def test_the_command_prints_a_file_that_info_and_replay_take(
    ride: list[Record], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign, path = str(written(tmp_path / 'foreign', ride, stamped)), tmp_path / 'map.yaml'
    assert main(['info', foreign, '--suggest-map', '--train', TRAIN]) == 0
    path.write_text(capsys.readouterr().out, encoding='utf-8')
    assert main(['info', foreign, '--map', str(path)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ['ato/force', 'from', '/car1/force', '+', '/car2/force'] in [row[:5] for row in rows]
    assert rows[0][1] == 'usable;'
    assert main(['replay', foreign, '--map', str(path), '--train', TRAIN]) == 0
    assert main(['info', foreign, foreign, '--suggest-map']) == 2
    assert '--suggest-map takes one bag' in capsys.readouterr().err


def test_a_bag_of_our_own_needs_no_mapping(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(ROOT / 'bags' / 'tiny'), '--suggest-map']) == 0
    text = capsys.readouterr().out
    assert parse_mapping(text, 'map.yaml') == Mapping()
    assert 'from our own topics: ato/brake_command' in text


def test_an_own_speed_shows_what_a_foreign_force_is(ride: list[Record], metro: TrainFile, tmp_path: Path) -> None:
    numbers = read_numbers(write_bag(tmp_path / 'own', ride), '/', 64 << 20)
    renamed = tuple(
        replace(item, topic='/car/force') if item.topic == '/ato/force' else item for item in numbers.series
    )
    own = numbers.own - {'/ato/force'}
    mapping = mapping_of(suggest(replace(numbers, series=renamed, own=own), 'bag', metro))
    assert mapping.speed is None
    assert chosen(mapping)['force'] == {('/car/force force', 'N', 1.0)}


def test_names_of_others_cannot_leave_their_comment() -> None:
    assert comment('a\nspeed: {topic: /x}') == '# a\\nspeed: {topic: /x}'
    assert comment('\x1b[31m') == '# \\x1b[31m'


def test_a_position_without_a_name_is_the_integral_of_a_speed_with_one(ride: list[Record], tmp_path: Path) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/a/velocity', FLOAT, record.stamp_ns, data=record.speed)
            bag.write('/a/fahrstand', FLOAT, record.stamp_ns, data=record.position / 1e3)
            bag.write('/a/raum', FLOAT, record.stamp_ns, data=21.0 + 0.1 * math.sin(record.stamp_ns * 1e-9))

    speed, position = suggested(written(tmp_path / 'bag', ride, write)).choices
    assert (position.parts[0].series.topic, position.parts[0].unit) == ('/a/fahrstand', 'km')
    assert 'whether this is the position: no name says so' in position.decisions
    assert speed.reasons[0].startswith('unit m/s: /a/fahrstand data changes by 0.000999')


@pytest.mark.parametrize('way', [1.0, -1.0])
def test_a_jump_of_kilometre_posts_is_named(ride: list[Record], tmp_path: Path, way: float) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            post = way * record.position + (0.0 if way > 0.0 else 4000.0)
            bag.write('/a/velocity', FLOAT, record.stamp_ns, data=record.speed)
            bag.write('/a/chainage', FLOAT, record.stamp_ns, data=1e-3 * (post + 150.0 * (post > 1000.0)))

    _, position = suggested(written(tmp_path / 'bag', ride, write)).choices
    (text,) = position.decisions
    found = re.fullmatch(
        r'it jumps while .*; if kilometre posts do, add a line beside position: chainage: \[\[(.*), (.*)\]\]', text
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(1000.0, abs=6.0)
    assert float(found[2]) == pytest.approx(150.0, abs=3.0)


@pytest.mark.parametrize('parts', ['position and force', 'position', 'force'])
def test_numbers_without_names_are_told_apart(tmp_path: Path, ride: list[Record], parts: str, metro: TrainFile) -> None:
    def write(bag: ForeignBag, record: Record) -> None:
        now = record.stamp_ns
        match record:
            case SpeedRecord(_, speed, position):
                bag.write('/can/a', FLOAT, now, data=3.6 * speed)
                if 'position' in parts:
                    bag.write('/can/b', FLOAT, now, data=position)
            case ForceRecord(_, force) if 'force' in parts:
                bag.write('/can/c', FLOAT, now, data=force / 1e3)
            case GradientRecord(_, gradient):
                bag.write('/can/d', FLOAT, now, data=gradient)

    bag = written(tmp_path / 'bag', ride, write)
    found = suggest(read_numbers(bag, '/', 1 << 26), 'bag', metro)
    topics = {item.quantity: item.parts[0].series.topic for item in found.choices if item.parts}
    expected = {'speed': '/can/a', 'position': '/can/b', 'force': '/can/c'}
    assert topics == {name: topic for name, topic in expected.items() if name == 'speed' or name in parts}
    speed = found.choices[0]
    assert speed.parts[0].unit == 'km/h'
    assert speed.reasons[0].startswith('no name says speed; by its numbers: never negative')
    assert 'whether this is the speed' in speed.decisions


def test_an_acceleration_without_a_name_is_no_force(tmp_path: Path, ride: list[Record], metro: TrainFile) -> None:
    before: list[SpeedRecord] = []

    def write(bag: ForeignBag, record: Record) -> None:
        if isinstance(record, SpeedRecord):
            bag.write('/can/a', FLOAT, record.stamp_ns, data=record.speed)
            if before:
                step_s = (record.stamp_ns - before[-1].stamp_ns) / 1e9
                bag.write('/can/b', FLOAT, record.stamp_ns, data=(record.speed - before[-1].speed) / step_s)
            before.append(record)

    found = suggest(read_numbers(written(tmp_path / 'bag', ride, write), '/', 1 << 26), 'bag', metro)
    assert [item.quantity for item in found.choices if item.parts] == ['speed']
    assert 'force' in found.missing


@pytest.mark.parametrize('names', [('T1',), ('T1', 'T2')])
def test_our_own_topics_in_a_namespace_need_no_mapping(
    tmp_path: Path, ride: list[Record], names: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(tmp_path / 'bag', ride[:200], namespaces=[f'/{name}' for name in names])
    assert main(['info', str(tmp_path / 'bag'), '--suggest-map']) == 2
    where = ', '.join(f'/{name}' for name in names)
    text = f'our own topics are in {where}: no mapping is needed, use --namespace\n'
    assert capsys.readouterr().err.endswith(text)


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('/car1/tractionForce_kN', ('car', '1', 'traction', 'force', 'kn')),
        ('/speed_km_h', ('speed', 'kmh')),
        ('speed.km_per_h', ('speed', 'kmh')),
        ('gradient_per_mille', ('gradient', 'permille')),
    ],
)
def test_names_are_split_into_words(name: str, words: tuple[str, ...]) -> None:
    assert words_of(name) == words


@pytest.mark.parametrize(
    ('quantity', 'topic', 'field', 'points'),
    [
        ('speed', '/odo/twist', 'twist.linear.x', 2.0),
        ('speed', '/odo/twist', 'twist.linear.y', 1.5),
        ('speed', '/odo/twist', 'twist.angular.x', 0.0),
        ('force', '/brakes/pressure', 'data', -2.0),
        ('brake_command', '/desk/notch', 'data', 1.0),
    ],
)
def test_names_speak_for_a_quantity_or_against_it(quantity: str, topic: str, field: str, points: float) -> None:
    assert score(quantity, topic, field) == points


def test_units_are_found_by_the_last_word_that_is_one_of_the_quantity() -> None:
    def unit(topic: str, quantity: str, kind: str = FLOAT) -> str:
        none = np.empty(0)
        return unit_in(NumberSeries(topic, kind, 'data', none, none, has_stamps=True, is_whole=False), quantity)

    assert unit('/train/speed_kmh', 'speed') == 'km/h'
    assert unit('/n/force_kN', 'force') == 'kN'
    assert unit('/force', 'force') == ''
    assert unit('/force_N', 'force', 'kN') == 'kN'


def test_topics_of_alike_cars_are_one_family() -> None:
    assert family('/car1/force') == family('/car12/force') != family('/car/total_force')
    assert family('/front/effort') == family('/rear/effort')
