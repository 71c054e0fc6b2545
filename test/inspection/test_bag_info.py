# SPDX-License-Identifier: Apache-2.0
"""Contents of a bag, and faults that make it unusable: forgotten signs, wrong units, slow topics."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from operator import neg
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from benchmarks.measured_car import FOLDER, load_trip
from benchmarks.measured_car import records as records_of
from test.own_bag import START_NS, short_drive, write_bag
from trainid_ros.bag.reader import BagReader
from trainid_ros.cli.main import main
from trainid_ros.inspection.bag_info import BagInfo, Findings, TopicInfo, check_inputs, inspect
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.worlds import WORLDS, make_case, unknowns_of, world_train
from trainid_ros.stream.alignment import AlignmentConfig
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


@pytest.fixture
def short() -> list[Record]:
    return short_drive()


@pytest.fixture
def bag(tmp_path: Path, short: list[Record]) -> Path:
    return write_bag(tmp_path / 'bag', short)


def without(records: Iterable[Record], *kinds: type[Record]) -> list[Record]:
    return [record for record in records if not isinstance(record, kinds)]


def altered(records: Iterable[Record], kind: type[Record], change: Callable[[Any], dict[str, Any]]) -> list[Record]:
    """Return the records, those of one kind with other values."""
    return [replace(record, **change(record)) if isinstance(record, kind) else record for record in records]


def topic(info: BagInfo, name: str) -> TopicInfo:
    return next(topic for topic in info.topics if topic.name == name)


def test_numbers_of_a_plain_bag(bag: Path, short: list[Record]) -> None:
    info = inspect(bag)
    assert info.usable
    assert (info.problems, info.warnings, info.missing) == ((), (), ())
    assert info.messages == len(short)
    assert info.duration_s == pytest.approx(49 * 0.2 + 3e-9, abs=1e-9)
    stamps = topic(info, 'ato/speed').stamps
    assert stamps is not None
    assert stamps.rate == pytest.approx(5.0)
    assert (stamps.first_ns, stamps.last_ns) == (short[0].stamp_ns, short[-4].stamp_ns)
    ranges = {f'{item.topic} {item.field}': (item.low, item.high) for item in info.ranges}
    assert ranges['ato/speed speed'] == pytest.approx((0.0, 4.9))
    assert ranges['ato/force force'] == (1e5 - 49, 1e5)
    assert ranges['ato/gradient gradient'] == pytest.approx((-3.0, 1.9))
    assert ranges['ato/brake_command target_acceleration'] == (-0.5, 0.0)
    # Speed exceeds 0.1 m/s from the third of 50 messages on, the brake acts from the 26th on; how long the last
    # one holds is not known.
    assert info.moving_share == pytest.approx(47 / 49)
    assert info.braking_share == pytest.approx(24 / 49)


def test_progress_is_shown_while_a_bag_is_read(bag: Path) -> None:
    shares: list[float] = []
    inspect(bag, advance=shares.append)
    assert sum(shares) == pytest.approx(1.0)
    assert shares[0] > 0.0


def test_faults_of_stamps_and_values_are_counted(tmp_path: Path, short: list[Record]) -> None:
    speeds = [record for record in short if isinstance(record, SpeedRecord)]
    kept = [*speeds[:10], *speeds[20:]]  # a gap of 2.2 s
    kept[3] = replace(kept[3], speed=math.nan)
    kept[5] = replace(kept[5], position=math.nan)  # unknown is allowed
    bad = [*without(short, SpeedRecord), *kept, kept[7], replace(kept[0], stamp_ns=0)]
    last_ns = short[-1].stamp_ns
    info = inspect(write_bag(tmp_path / 'bag', bad, range(last_ns, last_ns + len(bad))))
    speed = topic(info, 'ato/speed')
    assert speed.stamps is not None
    assert (speed.count, speed.not_finite) == (42, 1)
    assert speed.stamps.gaps == 1
    assert speed.stamps.longest_gap_s == pytest.approx(2.2)
    assert (speed.stamps.duplicates, speed.stamps.out_of_order, speed.stamps.zero) == (1, 1, 1)
    assert info.usable
    assert len(info.warnings) == 5
    assert all(line.startswith('ato/speed: ') for line in info.warnings)


def test_a_log_time_behind_the_stamps_is_reported(tmp_path: Path, short: list[Record]) -> None:
    path = write_bag(tmp_path / 'bag', short, [record.stamp_ns + 30_000_000 for record in short])
    stamps = topic(inspect(path), 'ato/force').stamps
    assert stamps is not None
    assert stamps.log_offset_s == pytest.approx(0.03)


def test_missing_topics_make_a_bag_unusable(tmp_path: Path, short: list[Record]) -> None:
    info = inspect(write_bag(tmp_path / 'bag', without(short, ForceRecord, BrakeRecord)))
    assert not info.usable
    assert info.missing == ('ato/force', 'ato/brake_command')
    assert info.problems == ('no messages on ato/force, ato/brake_command',)


def test_topics_in_another_namespace_are_suggested(tmp_path: Path, short: list[Record]) -> None:
    path = write_bag(tmp_path / 'bag', short[:1], namespaces=['/t7'])
    (problem,) = inspect(path).problems
    assert problem.endswith(' (they are in /t7; use --namespace)')
    assert 'ato/speed' not in inspect(path, '/t7').missing


@pytest.mark.parametrize(
    ('kind', 'change', 'problem'),
    [
        (SpeedRecord, {'speed': 0.0}, 'the train does not move'),
        (ForceRecord, {'stamp_ns': START_NS + 3600 * NS_PER_S}, 'the stamps of the required topics do not overlap'),
        (ForceRecord, {'force': math.nan}, 'ato/force: no message can be used'),
    ],
)
def test_a_topic_of_no_use_makes_a_bag_unusable(
    tmp_path: Path, short: list[Record], kind: type[Record], change: dict[str, Any], problem: str
) -> None:
    assert inspect(write_bag(tmp_path / 'bag', altered(short, kind, lambda _: change))).problems == (problem,)


def test_an_empty_bag_is_read_and_unusable(tmp_path: Path) -> None:
    info = inspect(write_bag(tmp_path / 'bag', []))
    assert (info.messages, info.duration_s, info.usable) == (0, 0.0, False)
    assert len(info.missing) == 4


@pytest.mark.parametrize('held_s', [1.0, 5.0])
def test_brake_commands_published_only_on_change_are_noticed(
    tmp_path: Path, short: list[Record], held_s: float
) -> None:
    commands = [
        BrakeRecord(START_NS + 1 + round(k * held_s * NS_PER_S), -0.5 * (k % 2), emergency=False)
        for k in range(int(9.0 / held_s) + 2)
    ]
    info = inspect(write_bag(tmp_path / 'bag', [*without(short, BrakeRecord), *commands]))
    text = 'ato/brake_command: published only on change: set alignment.command_hold'
    assert any(line.startswith(text) and '5 s or more' in line for line in info.warnings) == (held_s > 2.0)


@pytest.mark.parametrize(
    ('factor', 'warnings'),
    [
        (1.0, []),
        (1.03, []),
        (1.1, ['ato/speed: 1.10 times as fast as its positions change']),
        (3.6, ['ato/speed: 3.60 times as fast as its positions change, so it looks like km/h']),
    ],
)
def test_a_speed_that_does_not_fit_its_positions_is_noticed(
    tmp_path: Path, short: list[Record], factor: float, warnings: list[str]
) -> None:
    # At 80 s the position is corrected by 300 m, at 90 s it is not known.
    speeds = [
        SpeedRecord(START_NS + k * NS_PER_S // 5, 10.0 * factor, 2.0 * k + 300.0 * (k > 400) if k != 450 else math.nan)
        for k in range(500)
    ]
    info = inspect(write_bag(tmp_path / 'bag', [*without(short, SpeedRecord), *speeds]))
    assert [line for line in info.warnings if 'positions' in line] == warnings


METRO = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001), line=Line(stops=(0.0, 900.0, 1900.0)))


@pytest.fixture(scope='module')
def drive() -> list[Record]:
    return list(simulate(Scenario(METRO, runs=1), np.random.default_rng(5003)).records)


def checked(records: Iterable[Record], train: TrainFile | None, alignment: AlignmentConfig | None = None) -> Findings:
    return check_inputs((record.row() for record in records), alignment or AlignmentConfig(), train)


@pytest.mark.parametrize('train', [None, METRO])
def test_inputs_as_they_should_be(drive: list[Record], train: TrainFile | None) -> None:
    assert checked(drive, train) == ((), ())


@pytest.mark.parametrize('train', [None, METRO])
@pytest.mark.parametrize(
    ('kind', 'name', 'change', 'found'),
    [
        (ForceRecord, 'force', neg, 'ato/force has the wrong sign'),
        (ForceRecord, 'force', abs, 'ato/force drives while ato/brake_command brakes: its sign is missing or wrong'),
        (BrakeRecord, 'target_acceleration', neg, 'ato/brake_command looks as if it had the wrong sign'),
    ],
)
def test_a_forgotten_sign_is_named(
    drive: list[Record],
    kind: type[Record],
    name: str,
    change: Callable[[float], float],
    found: str,
    train: TrainFile | None,
) -> None:
    records = altered(drive, kind, lambda record: {name: change(getattr(record, name))})
    assert found in '; '.join(checked(records, train).problems)


@pytest.mark.parametrize(('offset', 'named'), [(0.0, False), (50e3, True), (-50e3, True)])
def test_positions_off_the_line_are_a_warning(drive: list[Record], offset: float, named: bool) -> None:
    found = checked(altered(drive, SpeedRecord, lambda r: {'position': r.position + offset}), METRO)
    assert found.problems == ()
    text = 'ato/speed has a position off the line of the train file, -118 to 2018 m'
    assert any(warning.startswith(text) for warning in found.warnings) is named


def test_a_unit_is_named_where_the_mass_is_known(drive: list[Record]) -> None:
    in_kn = altered(drive, ForceRecord, lambda r: {'force': r.force / 1e3})
    assert 'ato/force is in kN' in '; '.join(checked(in_kn, METRO).problems)


def thinned(records: Iterable[Record], period_s: float) -> list[Record]:
    last: dict[type[Record], int] = {}
    kept = []
    for record in records:
        if record.stamp_ns - last.get(type(record), 0) >= (period_s - 0.1) * NS_PER_S:
            last[type(record)] = record.stamp_ns
            kept.append(record)
    return kept


def test_a_bag_below_1_hz_is_not_usable(tmp_path: Path, drive: list[Record]) -> None:
    found = inspect(write_bag(tmp_path / 'bag', thinned(drive, 2.0))).problems
    assert 'ato/speed: comes every 2 s, and slower than 1.25 s is not used' in found
    # Such commands hold for 2 s.
    assert [line.partition(':')[0] for line in found] == ['ato/force', 'ato/gradient', 'ato/speed']
    slow = inspect(write_bag(tmp_path / 'slow', thinned(drive, 1.0)))
    assert slow.usable
    assert not any('gaps' in line for line in slow.warnings)


def test_a_mass_now_and_then_is_no_gap(tmp_path: Path, drive: list[Record]) -> None:
    masses = [MassRecord(drive[0].stamp_ns + k * NS_PER_S, 194e3) for k in (0, 1, 2, 3, 60, 61)]
    assert inspect(write_bag(tmp_path / 'bag', [*without(drive, MassRecord), *masses])).warnings == ()


def on_change(records: Iterable[Record]) -> list[Record]:
    last, kept = 1.0, []
    for record in records:
        if isinstance(record, BrakeRecord):
            if record.target_acceleration == last:
                continue
            last = record.target_acceleration
        kept.append(record)
    return kept


def test_commands_on_change_hold_where_the_mapping_says_so(
    tmp_path: Path, drive: list[Record], capsys: pytest.CaptureFixture[str]
) -> None:
    steps = altered(drive, BrakeRecord, lambda r: {'target_acceleration': round(r.target_acceleration)})
    whole = inspect(write_bag(tmp_path / 'whole', steps))
    sparse = inspect(write_bag(tmp_path / 'sparse', on_change(steps)))
    assert 0.05 < whole.braking_share < 0.95
    assert any('BRAKE_COMMAND_MISSING' in line for line in sparse.problems)
    held = tmp_path / 'map.yaml'
    held.write_text(
        'brake_command: {topic: ato/brake_command, field: target_acceleration, unit: m/s^2, on_change: true}\n',
        encoding='utf-8',
    )
    capsys.readouterr()
    assert main(['info', str(tmp_path / 'sparse'), '--map', str(held)]) == 0
    out = capsys.readouterr().out
    assert 'warning' not in out
    assert f'braking {whole.braking_share:.0%} of the time' in out
    assert checked(on_change(steps), METRO, AlignmentConfig(command_hold=3600.0)).problems == ()


def test_what_is_out_of_range_is_counted(drive: list[Record]) -> None:
    steep = [replace(r, gradient=300.0) if isinstance(r, GradientRecord) and not k % 100 else r
             for k, r in enumerate(drive)]  # fmt: skip
    count = sum(isinstance(r, GradientRecord) and r.gradient == 300.0 for r in steep)
    assert checked(steep, METRO).warnings == (f'ato/gradient: {count} messages out of range, the first with 300',)
    assert count > 0
    assert SpeedRecord in map(type, steep)


BAGS = Path(__file__).resolve().parents[2] / 'bags'
DRIVES = (('metro', 2, 71), ('emu', 2, 72), ('freight', 2, 73), ('tram', 4, 74))


@cache
def scenario(world: str, runs: int, seed: int) -> tuple[Scenario, TrainFile]:
    """Return a drive on a hilly line, and the train file that an engineer has, without a line."""
    stated = world_train(WORLDS[world])
    rng = np.random.default_rng((6_112, seed))
    case = make_case(WORLDS[world], stated, unknowns_of('field', [], stated), runs, rng)
    return case.scenario, replace(case.stated, line=replace(case.stated.line, gradient=()))


@cache
def world_drive(world: str, runs: int, seed: int) -> tuple[Record, ...]:
    return simulate(scenario(world, runs, seed)[0], np.random.default_rng((6_113, seed))).records


def scaled(inputs: Iterable[Record], factor: float) -> list[Record]:
    return altered(inputs, GradientRecord, lambda r: {'gradient': factor * r.gradient})


def found(inputs: list[Record], train: TrainFile | None = None) -> list[str]:
    return [text for text in checked(inputs, train).problems if text.startswith('ato/gradient')]


@pytest.mark.parametrize('case', DRIVES)
@pytest.mark.parametrize(
    ('factor', 'text'),
    [
        (0.1, 'looks like per cent: the train is slowed '),
        (-0.1, 'looks like per cent, with the wrong sign: '),
        (math.pi / 180.0, 'looks too small: '),
        (0.18 / math.pi, 'looks like degrees: '),
        (0.001, 'looks like a ratio or radians: '),
        (10.0, 'looks ten times too large: '),
        (-1.0, 'looks as if it had the wrong sign: '),
    ],
)
def test_a_wrong_unit_is_named(case: tuple[str, int, int], factor: float, text: str) -> None:
    assert len(problems := found(scaled(world_drive(*case), factor))) == 1
    assert problems[0].startswith(f'ato/gradient {text}')


@pytest.mark.parametrize('case', DRIVES)
def test_the_mass_need_not_be_known(case: tuple[str, int, int]) -> None:
    train = scenario(*case)[1]
    assert found(scaled(world_drive(*case), 1.0), train) == []
    assert found(scaled(world_drive(*case), 0.1), train)[0].startswith('ato/gradient looks like per cent')


@pytest.mark.parametrize('case', DRIVES)
def test_a_right_gradient_is_not_named(case: tuple[str, int, int]) -> None:
    inputs = world_drive(*case)
    assert found(scaled(inputs, 1.0)) == []
    assert found(altered(inputs, SpeedRecord, lambda r: {'speed': 3.6 * r.speed})) == []


@pytest.mark.parametrize('noise', [0.0, 0.05, 1.0])
def test_nothing_is_said_on_a_flat_line(noise: float) -> None:
    hilly = scenario('metro', 2, 71)[0]
    rng = np.random.default_rng(6_114)
    for share in (0.0, 0.02):
        line = replace(
            hilly.train_file.line, gradient=tuple((at, share * value) for at, value in hilly.train_file.line.gradient)
        )
        flat = simulate(replace(hilly, train_file=replace(hilly.train_file, line=line)), np.random.default_rng(6_115))
        noisy = altered(flat.records, GradientRecord, lambda r: {'gradient': r.gradient + rng.normal(0.0, noise)})
        assert found(noisy) == []


@pytest.mark.parametrize('name', ['altrios_manifest', 'tiny', 'yizhuang_day'])
def test_the_bags_are_in_order(name: str) -> None:
    with BagReader(BAGS / name) as reader:
        inputs = list(reader.records())
    assert found(inputs) == []


@pytest.mark.skipif(not FOLDER.is_dir(), reason='the measured data are not beside the repository')
def test_noise_of_a_measured_gradient_is_no_unit() -> None:
    inputs = list(records_of(load_trip(FOLDER, 'TripA30')))
    assert found(inputs) == []
    assert found(scaled(inputs, 0.1))[0].startswith('ato/gradient looks like per cent')
