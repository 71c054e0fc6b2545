# SPDX-License-Identifier: Apache-2.0
"""Timeline, pace, and the two nodes that play records."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rosgraph_msgs.msg import Clock

from test.ros.graph import START_NS, Changed, Graph
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import (
    INPUT_TOPICS,
    NS_PER_S,
    BrakeRecord,
    ForceRecord,
    InputTopic,
    MassRecord,
    Record,
    SpeedRecord,
    record_from_message,
)
from trainid_ros.ros import playback
from trainid_ros.ros.playback import BagPlayer, Entry, Pacer, PlaybackNode, Timeline, TrainSimulator, with_ticks
from trainid_ros.ros.topics import message_class

MS = NS_PER_S // 1000


def timeline(*times_ms: int) -> Timeline:
    entries: list[Entry] = [(t * MS, 'ato/force', ForceRecord(t * MS, float(t))) for t in times_ms]
    return Timeline(times_ms[0] * MS, times_ms[-1] * MS, lambda: iter(entries))


def test_gaps_are_filled_with_ticks_and_records_stay_in_order() -> None:
    out = list(with_ticks(timeline(1000, 1000, 1170, 1200), 0.0, 0.0))
    assert [time_ns // MS for time_ns, _, _ in out] == [1000, 1000, 1050, 1100, 1150, 1170, 1200, 1200]
    assert [record is not None for _, _, record in out] == [True, True, False, False, False, True, True, False]


def test_start_and_duration_cut_the_timeline() -> None:
    out = list(with_ticks(timeline(1000, 1100, 1200, 1300), 0.1, 0.1))
    assert [time_ns // MS for time_ns, _, record in out if record is not None] == [1100, 1200]
    assert out[-1] == (1200 * MS, '', None)


def test_a_duration_beyond_the_end_adds_no_time() -> None:
    out = list(with_ticks(timeline(1000, 1100), 0.0, 100.0))
    assert out[-1] == (1100 * MS, '', None)


def test_the_pace_does_not_drift() -> None:
    pacer = Pacer(4.0)
    assert pacer.due_ns(1000 * MS, 50 * MS) == 50 * MS
    assert pacer.due_ns(9000 * MS, 51 * MS) == 2050 * MS
    # A late callback does not change when the next entry is due.
    assert pacer.due_ns(9400 * MS, 2080 * MS) == 2150 * MS


def test_after_a_long_stall_the_pacer_restarts_without_a_burst() -> None:
    pacer = Pacer(1.0)
    pacer.due_ns(0, 0)
    assert pacer.due_ns(100 * MS, 5000 * MS) == 5000 * MS
    assert pacer.due_ns(300 * MS, 5001 * MS) == 5200 * MS


def test_released_entries_are_due_at_once() -> None:
    pacer = Pacer(1.0)
    pacer.due_ns(0, 0)
    pacer.release()
    assert pacer.due_ns(7000 * MS, 20 * MS) == 20 * MS


TRAIN = str(Path(__file__).parents[2] / 'config' / 'trains' / 'yizhuang.yaml')
RECORDS: list[Record] = [
    record
    for k in range(60)
    for stamp in [START_NS + k * NS_PER_S // 5]
    for record in (ForceRecord(stamp, 1e3 * k), BrakeRecord(stamp, 0.0, False), SpeedRecord(stamp, 0.1 * k, 1.0 * k))
]


@pytest.fixture
def bag(tmp_path: Path) -> str:
    with BagWriter(tmp_path / 'bag') as writer:
        for record in RECORDS:
            writer.write_record(record)
    return str(tmp_path / 'bag')


class InputListener:
    """Subscribes to every input topic and the clock; its queues hold all messages if the player catches up."""

    def __init__(self, graph: Graph) -> None:
        node = graph.plain('listener')
        self.records: list[Record] = []
        self.clock: list[int] = []
        for topic in INPUT_TOPICS:
            node.create_subscription(message_class(topic), topic.name, partial(self._note, topic), 5000)
        node.create_subscription(
            Clock, '/clock', lambda m: self.clock.append(m.clock.sec * NS_PER_S + m.clock.nanosec), 5000
        )

    def _note(self, topic: InputTopic, message: Any) -> None:
        self.records.append(record_from_message(topic, message))


@pytest.fixture
def listener(graph: Graph) -> InputListener:
    return InputListener(graph)


def by_kind(records: list[Record]) -> dict[str, list[Record]]:
    kinds: dict[str, list[Record]] = {}
    for record in records:
        kinds.setdefault(type(record).__name__, []).append(record)
    return kinds


@pytest.mark.ros
def test_everything_is_played_in_order_with_a_clock_that_never_steps_back(
    graph: Graph, listener: InputListener, bag: str
) -> None:
    player = graph.up(BagPlayer, bag=bag, rate=20.0, wait=1)
    graph.until(lambda: player.finished)
    graph.until(lambda: len(listener.records) == len(RECORDS) and listener.clock[-1:] == [RECORDS[-1].stamp_ns])
    assert by_kind(listener.records) == by_kind(RECORDS)
    assert listener.clock == sorted(set(listener.clock))
    assert {record.stamp_ns for record in RECORDS} <= set(listener.clock)
    assert max(b - a for a, b in zip(listener.clock, listener.clock[1:], strict=False)) <= NS_PER_S // 20


@pytest.mark.ros
def test_the_player_waits_for_a_subscriber_that_acknowledges_nothing(
    graph: Graph, listener: InputListener, bag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playback, '_LOOK_EVERY', 4)
    monkeypatch.setattr(playback, '_MAX_UNACKNOWLEDGED', 40)
    player = graph.up(BagPlayer, bag=bag, rate=1000.0, wait=1)
    real = dict(player._outputs)
    player._outputs = {name: Changed(output, wait_for_all_acked=lambda _: False) for name, output in real.items()}
    graph.until(lambda: player.played == 40)
    graph.spin(20)
    assert player.played == 40
    player._outputs = real
    graph.until(lambda: player.finished)
    graph.until(lambda: len(listener.records) == len(RECORDS))


@pytest.mark.ros
def test_start_and_duration_choose_a_part(graph: Graph, listener: InputListener, bag: str) -> None:
    player = graph.up(BagPlayer, bag=bag, rate=50.0, wait=1, start=2.0, duration=4.0)
    graph.until(lambda: player.finished)
    expected = [r for r in RECORDS if 2.0 <= (r.stamp_ns - START_NS) / NS_PER_S <= 6.0]
    graph.until(lambda: len(listener.records) == len(expected))
    assert by_kind(listener.records) == by_kind(expected)


@pytest.mark.ros
def test_playback_waits_until_new_subscribers_have_discovered_the_player(
    graph: Graph, listener: InputListener, bag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playback, '_DISCOVERY_NS', 10**15)
    player = graph.up(BagPlayer, bag=bag, rate=50.0, wait=1)
    graph.until(lambda: player._complete_ns)
    graph.spin(20)
    assert player.played == 0
    monkeypatch.setattr(playback, '_DISCOVERY_NS', 0)
    graph.until(lambda: len(listener.records) == len(RECORDS))


@pytest.mark.ros
def test_a_long_wait_says_which_topics_lack_subscribers(
    graph: Graph, bag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playback, '_LONG_WAIT_NS', 0)
    InputListener(graph)
    player = graph.make(BagPlayer, bag=bag, rate=50.0, wait=2)
    said: list[str] = []
    monkeypatch.setattr(player.get_logger(), 'warning', said.append)
    player.bring_up()
    expected = ', '.join(f'/{name} has 1' for name in sorted(topic.name for topic in INPUT_TOPICS))
    graph.until(lambda: said[-1:] == [f'waiting for 2 subscribers on each topic: {expected}'])
    assert len(set(said)) == len(said)
    InputListener(graph)
    graph.until(lambda: player.finished)
    assert player.played == len(RECORDS)


@pytest.mark.ros
def test_deactivating_pauses_and_activating_resumes(graph: Graph, listener: InputListener, bag: str) -> None:
    player = graph.up(BagPlayer, bag=bag, rate=10.0, wait=1)
    graph.until(lambda: player.played > 30)
    player.trigger_deactivate()
    played = player.played
    graph.spin(20)
    assert player.played == played
    player.trigger_activate()
    graph.until(lambda: len(listener.records) == len(RECORDS))
    assert by_kind(listener.records) == by_kind(RECORDS)


@pytest.mark.ros
def test_a_loop_starts_over(graph: Graph, listener: InputListener, bag: str) -> None:
    player = graph.up(BagPlayer, bag=bag, rate=50.0, wait=1, loop=True)
    graph.until(lambda: any(b < a for a, b in zip(listener.clock, listener.clock[1:], strict=False)))
    assert player.played > len(RECORDS)
    assert not player.finished


@pytest.mark.ros
@pytest.mark.parametrize(
    ('kind', 'parameters', 'reason'),
    [
        (BagPlayer, {}, 'no bag: give the parameter bag'),
        (BagPlayer, {'bag': '/no/such/bag'}, '/no/such/bag'),
        (BagPlayer, {'bag': 'x', 'restamp': True, 'rate': 2.0}, 'restamp needs rate = 1'),
        (BagPlayer, {'bag': 'x', 'rate': 0.0}, 'rate = 0 is outside'),
        (TrainSimulator, {}, 'no train: give the parameter train_file or world'),
        (TrainSimulator, {'world': 'tramm'}, "world = 'tramm' must be one of"),
        (TrainSimulator, {'realism': 'field', 'train_file': TRAIN}, "realism = 'field' needs the parameter world"),
    ],
)
def test_unusable_parameters_fail_to_configure(
    graph: Graph, kind: type[PlaybackNode], parameters: dict[str, Any], reason: str
) -> None:
    player = graph.make(kind, **parameters)
    assert not player.bring_up()
    assert player.state == 'unconfigured'
    assert reason in player.failure


@pytest.mark.ros
def test_a_start_after_the_end_is_named_with_the_length(graph: Graph, bag: str) -> None:
    player = graph.make(BagPlayer, bag=bag, start=99999.0)
    assert not player.bring_up()
    length_s = (RECORDS[-1].stamp_ns - RECORDS[0].stamp_ns) / NS_PER_S
    assert player.failure == f'start = 99999 s: what is played is {length_s:.1f} s long'


@pytest.mark.ros
def test_a_player_can_be_configured_twice(graph: Graph, bag: str) -> None:
    player = graph.make(BagPlayer, bag=bag)
    for _ in range(2):
        assert player.bring_up(), player.failure
        player.trigger_deactivate()
        player.trigger_cleanup()
    assert not list(player.publishers) or all('/ato/' not in p.topic_name for p in player.publishers)


@pytest.mark.ros
def test_the_simulator_stamps_the_present_and_keeps_the_spacing(graph: Graph, listener: InputListener) -> None:
    simulator = graph.up(TrainSimulator, train_file=TRAIN, runs=1, wait=1, duration=1.0)
    before = simulator.get_clock().now().nanoseconds
    graph.until(lambda: simulator.finished)
    graph.until(lambda: len(listener.records) == simulator.played)
    after = simulator.get_clock().now().nanoseconds
    stamps = [record.stamp_ns for record in listener.records]
    assert before - NS_PER_S // 2 <= min(stamps) <= max(stamps) <= after + NS_PER_S // 2
    assert 0.7 * NS_PER_S < max(stamps) - min(stamps) < 1.3 * NS_PER_S
    assert listener.clock == []


@pytest.mark.ros
def test_the_simulator_drives_a_world(graph: Graph, listener: InputListener) -> None:
    simulator = graph.up(TrainSimulator, world='tram', realism='field', runs=1, wait=1, duration=0.5)
    graph.until(lambda: simulator.finished)
    graph.until(lambda: len(listener.records) == simulator.played)
    masses = [record.mass for record in listener.records if isinstance(record, MassRecord)]
    assert 54e3 * 0.98 < masses[0] < 1.3 * 54e3 * 1.02
