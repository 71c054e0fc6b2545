# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from trainid_ros.bag.types import message_from_record
from trainid_ros.bag.writer import BagWriter
from trainid_ros.inspection.bag_info import BagInfo, TopicInfo, inspect
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

PERIOD_NS = NS_PER_S // 5


def write(path: Path, records: Iterable[Record]) -> Path:
    with BagWriter(path) as writer:
        for record in records:
            writer.write_record(record)
    return path


def topic(info: BagInfo, name: str) -> TopicInfo:
    return next(topic for topic in info.topics if topic.name == name)


def test_numbers_of_a_plain_bag(bag: Path, records: list[Record]) -> None:
    info = inspect(bag)
    assert info.usable
    assert (info.problems, info.warnings, info.missing) == ((), (), ())
    assert info.messages == len(records)
    assert info.duration_s == pytest.approx(49 * 0.2 + 3e-9, abs=1e-9)
    stamps = topic(info, 'ato/speed').stamps
    assert stamps is not None
    assert stamps.rate == pytest.approx(5.0)
    assert (stamps.first_ns, stamps.last_ns) == (records[0].stamp_ns, records[-4].stamp_ns)
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


def test_faults_of_stamps_and_values_are_counted(tmp_path: Path, records: list[Record]) -> None:
    speeds = [record for record in records if isinstance(record, SpeedRecord)]
    others = [record for record in records if not isinstance(record, SpeedRecord)]
    kept = [*speeds[:10], *speeds[20:]]  # a gap of 2.2 s
    kept[3] = replace(kept[3], speed=math.nan)
    kept[5] = replace(kept[5], position=math.nan)  # unknown is allowed
    bad: list[Record] = [*others, *kept, kept[7], replace(kept[0], stamp_ns=0)]
    with BagWriter(tmp_path / 'bag') as writer:
        for i, record in enumerate(bad):
            name = {SpeedRecord: 'AtoSpeed', ForceRecord: 'AtoForce', GradientRecord: 'TrackGradient'}.get(
                type(record), 'BrakeCommand'
            )
            where = {'AtoSpeed': 'speed', 'AtoForce': 'force', 'TrackGradient': 'gradient'}.get(name, 'brake_command')
            log_ns = records[-1].stamp_ns + i
            writer.write_message(f'ato/{where}', name, log_ns, message_from_record(record))
    info = inspect(tmp_path / 'bag')
    speed = topic(info, 'ato/speed')
    assert speed.stamps is not None
    assert (speed.count, speed.not_finite) == (42, 1)
    assert speed.stamps.gaps == 1
    assert speed.stamps.longest_gap_s == pytest.approx(2.2)
    assert (speed.stamps.duplicates, speed.stamps.out_of_order, speed.stamps.zero) == (1, 1, 1)
    assert info.usable
    assert len(info.warnings) == 5
    assert all(line.startswith('ato/speed: ') for line in info.warnings)


def test_a_log_time_behind_the_stamps_is_reported(tmp_path: Path, records: list[Record]) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for record in records:
            if isinstance(record, ForceRecord):
                log_ns = record.stamp_ns + 30_000_000
                writer.write_message('ato/force', 'AtoForce', log_ns, message_from_record(record))
    stamps = topic(inspect(tmp_path / 'bag'), 'ato/force').stamps
    assert stamps is not None
    assert stamps.log_offset_s == pytest.approx(0.03)


def test_missing_topics_make_a_bag_unusable(tmp_path: Path, records: list[Record]) -> None:
    path = write(tmp_path / 'bag', [record for record in records if not isinstance(record, ForceRecord | BrakeRecord)])
    info = inspect(path)
    assert not info.usable
    assert info.missing == ('ato/force', 'ato/brake_command')
    assert info.problems == ('no messages on ato/force, ato/brake_command',)


def test_topics_in_another_namespace_are_suggested(tmp_path: Path, records: list[Record]) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for record in records:
            if isinstance(record, SpeedRecord):
                writer.write_message('/t7/ato/speed', 'AtoSpeed', record.stamp_ns, message_from_record(record))
    (problem,) = inspect(tmp_path / 'bag').problems
    assert problem.endswith(' (they are in /t7; use --namespace)')
    assert 'ato/speed' not in inspect(tmp_path / 'bag', '/t7').missing


def test_a_train_at_rest_makes_a_bag_unusable(tmp_path: Path, records: list[Record]) -> None:
    still = [replace(record, speed=0.0) if isinstance(record, SpeedRecord) else record for record in records]
    assert inspect(write(tmp_path / 'bag', still)).problems == ('the train does not move',)


def test_topics_without_overlap_make_a_bag_unusable(tmp_path: Path, records: list[Record]) -> None:
    hour = 3600 * NS_PER_S
    moved = [
        replace(record, stamp_ns=record.stamp_ns + hour) if isinstance(record, ForceRecord) else record
        for record in records
    ]
    assert inspect(write(tmp_path / 'bag', moved)).problems == ('the stamps of the required topics do not overlap',)


def test_a_topic_without_valid_messages_makes_a_bag_unusable(tmp_path: Path, records: list[Record]) -> None:
    broken = [replace(record, force=math.nan) if isinstance(record, ForceRecord) else record for record in records]
    assert inspect(write(tmp_path / 'bag', broken)).problems == ('ato/force: no message can be used',)


def test_an_empty_bag_is_read_and_unusable(tmp_path: Path) -> None:
    info = inspect(write(tmp_path / 'bag', []))
    assert (info.messages, info.duration_s, info.usable) == (0, 0.0, False)
    assert len(info.missing) == 4


@pytest.mark.parametrize('held_s', [1.0, 5.0])
def test_brake_commands_published_only_on_change_are_noticed(
    tmp_path: Path, records: list[Record], held_s: float
) -> None:
    others = [record for record in records if not isinstance(record, BrakeRecord)]
    start_ns = records[0].stamp_ns
    commands = [
        BrakeRecord(start_ns + 1 + round(k * held_s * NS_PER_S), -0.5 * (k % 2), emergency=False)
        for k in range(int(9.0 / held_s) + 2)
    ]
    info = inspect(write(tmp_path / 'bag', [*others, *commands]))
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
    tmp_path: Path, records: list[Record], factor: float, warnings: list[str]
) -> None:
    others = [record for record in records if not isinstance(record, SpeedRecord)]
    start_ns = records[0].stamp_ns
    # At 80 s the position is corrected by 300 m, at 90 s it is not known.
    speeds = [
        SpeedRecord(start_ns + k * NS_PER_S // 5, 10.0 * factor, 2.0 * k + 300.0 * (k > 400) if k != 450 else math.nan)
        for k in range(500)
    ]
    info = inspect(write(tmp_path / 'bag', [*others, *speeds]))
    assert [line for line in info.warnings if 'positions' in line] == warnings
