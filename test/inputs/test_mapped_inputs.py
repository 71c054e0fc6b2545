# SPDX-License-Identifier: Apache-2.0
"""Messages of other topics become records."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from test.own_bag import START_NS, at
from trainid_ros.inputs.mapped_inputs import JoinedSeries, MappedInputs
from trainid_ros.inputs.mapping import parse_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import (
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    GradientRecord,
    MassRecord,
    Record,
    SpeedRecord,
)
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile

LINE = Line(gradient=((0.0, 0.0), (1000.0, 10.0)), curve=((0.0, 0.0), (1000.0, 400.0)), tunnel=((1500.0, 1600.0),))
TRAIN = TrainFile(Train(mass=194e3, length=100.0), Davis(1.5, 0.02, 0.001), line=LINE)


def message(data: float, stamp_ns: int | None = None) -> Any:
    if stamp_ns is None:
        return SimpleNamespace(data=data)
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return SimpleNamespace(data=data, header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)))


def inputs(text: str, train_file: TrainFile = TRAIN) -> MappedInputs:
    return MappedInputs(parse_mapping(text, 'map.yaml'), train_file)


def test_each_quantity_becomes_a_record_of_its_own() -> None:
    mapped = inputs("""
        speed: {topic: v, field: data, unit: km/h}
        force: {topic: f, field: data, unit: kN}
        gradient: {topic: i, field: data, unit: percent}
        brake_command: {topic: z, field: data, sign: -1}
        mass: {topic: m, field: data, unit: t}
    """)
    found = [mapped.take(topic, message(36.0, START_NS), 7) for topic in ('v', 'f', 'i', 'z', 'm')]
    (speed,), *others = found
    assert isinstance(speed, SpeedRecord)
    assert (speed.stamp_ns, speed.speed) == (START_NS, 10.0)
    assert math.isnan(speed.position)
    assert others == [
        [ForceRecord(START_NS, 36e3)],
        [GradientRecord(START_NS, 360.0, 0.0, tunnel=False)],
        [BrakeRecord(START_NS, -36.0, emergency=False)],
        [MassRecord(START_NS, 36e3)],
    ]


def test_a_message_without_a_header_has_the_time_of_its_arrival() -> None:
    text = 'mass: {topic: m, field: data, stamp: receive}'
    assert inputs(text).take('m', message(5.0), START_NS) == [MassRecord(START_NS, 5.0)]
    with pytest.raises(InputError, match=r'topic m: .* has no header; set stamp: receive'):
        inputs(text.replace(', stamp: receive', '')).take('m', message(5.0), START_NS)


def test_a_reversing_train_has_a_positive_speed() -> None:
    (record,) = inputs('speed: {topic: v, field: data}').take('v', message(-3.0, START_NS), 0)
    assert record.row()[2] == 3.0


def drive(mapped: MappedInputs, fixes: dict[int, float]) -> list[Record]:
    """Drive 100 s at 10 m/s, with positions measured at some samples."""
    found: list[Record] = []
    for k in range(500):
        if k in fixes:
            found += mapped.take('x', message(fixes[k], at(k)), 0)
        found += mapped.take('v', message(10.0, at(k)), 0)
    return found


@pytest.mark.parametrize('direction', [1, -1])
def test_positions_are_integrated_from_the_start(direction: int) -> None:
    position = f'{{from: speed, start: 1200.0, direction: {direction}}}'
    mapped = inputs(f'{{speed: {{topic: v, field: data}}, position: {position}}}')
    records = drive(mapped, {})
    assert [record.position for record in records if isinstance(record, SpeedRecord)] == pytest.approx(
        [1200.0 + direction * 2.0 * k for k in range(500)]
    )


def test_between_balises_positions_are_integrated_and_the_direction_follows() -> None:
    mapped = inputs('{speed: {topic: v, field: data}, position: {topic: x, field: data}}')
    positions = [r.position for r in drive(mapped, {100: 5000.0, 200: 4803.0}) if isinstance(r, SpeedRecord)]
    assert all(math.isnan(position) for position in positions[:100])
    # Until the second balise it is not known that positions fall.
    assert positions[199] == pytest.approx(5198.0)
    assert positions[200] == pytest.approx(4803.0)
    assert positions[300] == pytest.approx(4603.0)


@pytest.mark.parametrize(
    ('steps', 'expected'),
    [
        ((0, 1, 2, -20, -19), [800.0, 802.0, 804.0, 800.0, 802.0]),  # a loop begins anew
        ((0, 1, 90, 2, 3), [800.0, 802.0, 802.0, 802.0, 804.0]),  # one stamp is wrong
    ],
)
def test_positions_follow_stamps_that_jump(steps: tuple[int, ...], expected: list[float]) -> None:
    mapped = inputs('{speed: {topic: v, field: data}, position: {from: speed, start: 800.0}}')
    found = [record for step in steps for record in mapped.take('v', message(10.0, at(step)), 0)]
    assert [record.position for record in found if isinstance(record, SpeedRecord)] == pytest.approx(expected)


def test_a_position_that_comes_first_after_a_jump_is_kept() -> None:
    mapped = inputs('gradient: {from: line}')
    made = [mapped.take_record(SpeedRecord(at(step), 10.0, 1000.0 + 2.0 * step)) for step in (0, 1, 2, -20)]
    assert [len(records) for records in made] == [2, 2, 2, 2]


def test_noise_at_standstill_is_no_change_of_direction() -> None:
    mapped = inputs('{speed: {topic: v, field: data}, position: {topic: x, field: data}, gradient: {from: line}}')
    found = []
    for k, position in enumerate((1990.0, 2000.0, 2000.1, 1999.9, 2000.0, 1999.5, 1985.0)):
        mapped.take('x', message(position, at(k)), 0)
        _, gradient = mapped.take('v', message(float(k > 5), at(k)), 0)
        found.append(gradient.row()[2])
    assert found == [10.0] * 6 + [-10.0]


def test_the_line_gives_gradient_curve_and_tunnel_by_position() -> None:
    mapped = inputs('{speed: {topic: v, field: data}, position: {from: speed, start: 800.0}, gradient: {from: line}}')
    track = [record for record in drive(mapped, {}) if isinstance(record, GradientRecord)]
    assert [record.stamp_ns for record in track] == [at(k) for k in range(500)]
    assert (track[0].gradient, track[0].curve_radius, track[0].tunnel) == (0.0, 0.0, False)
    assert track[125].gradient == pytest.approx(5.0)  # half of the train is past 1000 m
    assert track[125].curve_radius == pytest.approx(800.0)
    assert track[375].tunnel


def test_the_line_is_looked_up_for_our_own_speed_topic_too() -> None:
    mapped = inputs('gradient: {from: line}')
    assert mapped.take_record(SpeedRecord(START_NS, 10.0, 1200.0)) == [
        SpeedRecord(START_NS, 10.0, 1200.0),
        GradientRecord(START_NS, 10.0, 400.0, tunnel=False),
    ]
    assert mapped.take_record(SpeedRecord(START_NS + 1, 10.0, math.nan))[0].stamp_ns == START_NS + 1
    assert len(mapped.take_record(SpeedRecord(START_NS + 2, 10.0, math.nan))) == 1
    force = ForceRecord(START_NS, 1.0)
    assert mapped.take_record(force) == [force]


def test_constants_come_with_each_speed() -> None:
    mapped = inputs('{speed: {topic: v, field: data}, gradient: {value: 2.0}, brake_command: {value: 0.0}}')
    _, *others = mapped.take('v', message(3.0, START_NS), 0)
    assert others == [GradientRecord(START_NS, 2.0, 0.0, False), BrakeRecord(START_NS, 0.0, False)]


def test_a_function_gets_the_numbers_of_several_topics(tmp_path: Path) -> None:
    (tmp_path / 'code.py').write_text('def force(power, speed): return power / speed', encoding='utf-8')
    text = 'force: {function: code.py:force, of: [{topic: P, field: data}, {topic: v, field: data}], unit: kN}'
    mapped = MappedInputs(parse_mapping(text, str(tmp_path / 'map.yaml')), TRAIN)
    assert mapped.take('v', message(10.0, at(0)), 0) == []
    assert mapped.take('P', message(300.0, at(1)), 0) == []
    assert mapped.take('v', message(20.0, at(2)), 0) == [ForceRecord(at(1), 20e3)]


def test_a_line_without_gradients_is_rejected() -> None:
    with pytest.raises(InputError, match='gradient'):
        inputs('gradient: {from: line}', TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001)))
    with pytest.raises(InputError, match='no train file is given'):
        MappedInputs(parse_mapping('gradient: {from: line}', 'map.yaml'), None)


def test_numbers_that_are_not_in_the_table_are_counted() -> None:
    text = 'brake_command: {topic: /notch, field: data, table: {0: 0.0, 1: -0.3}, stamp: receive}'
    inputs = MappedInputs(parse_mapping(text, 'map.yaml'), None)
    problems = []
    for stamp_ns, notch in enumerate((0, 50, 1, 50, 7), 1):
        inputs.take('/notch', SimpleNamespace(data=notch), stamp_ns)
        problems.append(inputs.problem('/notch'))
    assert problems == ['', '/notch: 50 is not in table', '', '/notch: 50 is not in table', '/notch: 7 is not in table']
    assert inputs.warnings == ['/notch: 7 is not in table (1 message)', '/notch: 50 is not in table (2 messages)']


S = NS_PER_S


def test_others_are_interpolated_to_the_stamps_of_the_first() -> None:
    series = JoinedSeries(2)
    assert series.add(1, 0, 10.0) == []
    assert series.add(0, S // 4, 1.0) == []
    assert series.add(1, S // 2, 20.0) == [(S // 4, [1.0, 15.0])]


@pytest.mark.parametrize(
    ('added', 'last', 'at_ns'),
    [
        ([(0, 0), (0, S)], (0, 3 * S // 2), 0),  # one is missing for a second
        ([(1, 0), (0, S // 2)], (1, 3 * S), S // 2),  # a long gap
    ],
)
def test_what_is_not_known_is_nan(added: list[tuple[int, int]], last: tuple[int, int], at_ns: int) -> None:
    series = JoinedSeries(2)
    assert all(series.add(*item, 1.0) == [] for item in added)
    ((stamp_ns, (_, value)),) = series.add(*last, 1.0)
    assert stamp_ns == at_ns
    assert math.isnan(value)


def test_numbers_go_on_after_stamps_that_begin_anew_or_a_wrong_one() -> None:
    series = JoinedSeries(2)
    found = []
    for stamp_ns in (100 * S, 101 * S, 900 * S, 102 * S, 103 * S, 5 * S, 6 * S):
        for index in (0, 1):
            found += series.add(index, stamp_ns, 1.0)
    assert found == [(k * S, [1.0, 1.0]) for k in (100, 101, 900, 102, 103, 5, 6)]


@given(st.permutations([0, 1] * 10))
def test_which_series_arrives_first_within_a_second_does_not_matter(order: list[int]) -> None:
    series, found, numbers = JoinedSeries(2), [], [0, 1]
    for index in order:
        k = numbers[index]
        found += series.add(index, k * S // 25, float(k))
        numbers[index] += 2
    # Even numbers are of the first series; before the first odd one nothing is known.
    assert [stamp_ns for stamp_ns, _ in sorted(found)] == [k * S // 25 for k in range(0, 20, 2)]
    assert [sum(values) for _, values in sorted(found)][1:] == pytest.approx([2.0 * k for k in range(2, 20, 2)])


POSTS = 'speed: {topic: v, field: data}\nposition: {topic: x, field: data}\nchainage: '


def measured(jumps: str, posts: list[float]) -> list[float]:
    """Return the positions of a train at 10 m/s that reads a post once a second."""
    mapped, found = inputs(f'{POSTS}{jumps}'), []
    for k, post in enumerate(posts):
        mapped.take('x', message(post, at(5 * k)), 0)
        (record,) = mapped.take('v', message(10.0, at(5 * k)), 0)[:1]
        assert isinstance(record, SpeedRecord)
        found.append(record.position)
    return found


@pytest.mark.parametrize('direction', [1, -1])
@pytest.mark.parametrize(
    ('jumps', 'shift'), [('[[1250.0, 500.0]]', 500.0), ('[[1250.0, -100.0], [1350.0, 40.0]]', 0.0)]
)
def test_posts_that_jump_give_a_distance_without_jumps(jumps: str, shift: float, direction: int) -> None:
    line = [1000.0 + 10.0 * k for k in range(80)]
    ends = [x + shift if x > 1250.0 else x for x in line]
    if not shift:  # 1150 to 1250 is there twice, and 1350 to 1390 not at all
        ends = [x if x <= 1250.0 else x - 100.0 if x <= 1450.0 else x - 60.0 for x in line]
    assert measured(jumps, ends[::direction]) == pytest.approx(line[::direction])


@pytest.mark.parametrize('direction', [1, -1])
@pytest.mark.parametrize('jump', [150.0, -100.0])
def test_a_jump_of_the_wrong_sign_is_doubted(jump: float, direction: int) -> None:
    posts, doubts = [x + jump * (x > 1250.0) for x in (1000.0 + 10.0 * k for k in range(80))], []
    for stated in (jump, -jump):
        mapped = inputs(f'{POSTS}[[1250.0, {stated}]]')
        for k, post in enumerate(posts[::direction] + posts[::-direction]):  # there and back
            mapped.take('x', message(post, at(5 * k)), 0)
            mapped.take('v', message(10.0, at(5 * k)), 0)
        doubts.append(mapped.warnings)
    size = f'{4.0 * abs(jump):.0f} m'
    text = f'chainage: is [1250, {-jump:g}] of the right sign? Position and speed disagree there by {size}'
    assert doubts == [[], [text]]


def test_a_post_that_is_there_twice_says_nothing_of_the_place() -> None:
    found = measured('[[1250.0, -100.0]]', [1200.0, 1210.0])
    assert [math.isnan(position) for position in found] == [True, True]
    assert math.isnan(measured('[[1250.0, 500.0]]', [1400.0])[0])
