# SPDX-License-Identifier: Apache-2.0
"""A replay gives the outputs of the pipelines, passes all records in order, and rejects a bag that lacks a topic.

Estimates of several estimators become rows of one table.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from test.own_bag import messages_of, write_bag
from trainid_ros.bag.bag_replay import (
    COLUMNS,
    EstimateTable,
    Odometer,
    Pipelines,
    TableRow,
    estimate_table,
    replay_through,
)
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.types import definition, fields_of, table_of
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, OUTPUT_TOPICS, ForceRecord, Record, SpeedRecord
from trainid_ros.interface.results import AdhesionEstimate, Output, Reason, Status
from trainid_ros.setup.pipelines import (
    RESISTANCE,
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.stream.sample_stream import Contradiction
from trainid_ros.train.train_file import Davis, Line, Train, TrainFile

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.bag.bag_replay import AnyOutput, Replay
    from trainid_ros.bag.reader import LoggedRecord

TRAIN = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001), line=Line(stops=(0.0, 900.0)))


class Log:
    """Records all inputs and outputs of a replay."""

    def __init__(self) -> None:
        self.records: list[Record] = []
        self.outputs: list[AnyOutput] = []
        self.entries: list[object] = []

    def on_record(self, entry: LoggedRecord) -> None:
        self.records.append(entry.record)
        self.entries.append(entry.log_ns)

    def on_output(self, output: AnyOutput, log_ns: int) -> None:
        assert log_ns == self.entries[-1]
        self.outputs.append(output)


@pytest.fixture(scope='module')
def drive() -> tuple[Record, ...]:
    return simulate(Scenario(TRAIN, runs=1), np.random.default_rng(3)).records


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory, drive: tuple[Record, ...]) -> Path:
    return write_bag(tmp_path_factory.mktemp('replay') / 'bag', drive)


def run(bag: Path, *observers: Any, duration_s: float = float('inf')) -> Replay:
    with BagReader(bag) as reader:
        return replay_through(
            Pipelines.of(TRAIN, EstimatorSettings()), reader, observers=observers, duration_s=duration_s
        )


@pytest.fixture(scope='module')
def replayed(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Replay, Log, Path]:
    """Return the outcome of a replay, its inputs and outputs, and the bag they were recorded to."""
    log, path = Log(), tmp_path_factory.mktemp('recorded') / 'out'
    with BagWriter(path) as writer:
        return run(bag, log, writer), log, path


def test_outputs_are_those_of_the_pipelines_driven_by_hand(
    replayed: tuple[Replay, Log, Path], drive: tuple[Record, ...]
) -> None:
    outcome, log, _ = replayed
    pipelines: tuple[Any, ...] = tuple(
        make(TRAIN, EstimatorSettings()) for make in (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    )
    expected = [output for record in drive for pipeline in pipelines for output in pipeline.push(record)]
    assert log.records == list(drive)
    estimates = [output for output in log.outputs if not isinstance(output.estimate, AdhesionEstimate)]
    assert list(map(repr, estimates)) == list(map(repr, expected))  # NaN equals no NaN
    assert repr(log.outputs[-1]) == repr(outcome.adhesion)
    assert 4 * len(estimates) == 3 * len(log.outputs)  # one adhesion with each brake rate
    results: tuple[Any, ...] = (outcome.resistance, outcome.speed_model, outcome.brake_rate)
    for pipeline, result in zip(pipelines, results, strict=True):
        assert repr(result.output) == repr(pipeline.current())
        assert dict(result.rejections) == dict(pipeline.rejections)
        assert result.samples == pipeline.samples
        assert repr(result.consistency) == repr(pipeline.consistency)
        pipeline.reset()
        assert repr(result.prior) == repr(pipeline.current().estimate)
    assert outcome.records == len(drive)


def test_the_estimators_use_the_samples_of_the_whole_bag(
    replayed: tuple[Replay, Log, Path], drive: tuple[Record, ...]
) -> None:
    outcome = replayed[0]
    assert outcome.resistance.output.used > 50
    assert outcome.brake_rate.output.used > 20
    assert dict(outcome.resistance.rejections)[Reason.BRAKING] > 20
    # The first and last samples lie at the first and last speeds, both within a period of 0.2 s.
    assert outcome.duration_s == pytest.approx((drive[-1].stamp_ns - drive[0].stamp_ns) / NS_PER_S, abs=0.5)


def test_progress_adds_up_to_all_inputs_read(bag: Path, drive: tuple[Record, ...]) -> None:
    steps: list[float] = []
    taken = [r for r in drive if r.stamp_ns <= drive[0].stamp_ns + 60 * NS_PER_S]
    with BagReader(bag) as reader:
        replay_through(Pipelines.of(TRAIN, EstimatorSettings()), reader, steps.append, duration_s=60.0)
    assert sum(steps) == len(taken)
    assert len(steps) > 2


def test_a_limited_duration_reads_only_the_start(bag: Path, drive: tuple[Record, ...]) -> None:
    log = Log()
    run(bag, log, duration_s=20.0)
    assert log.records == [r for r in drive if r.stamp_ns <= drive[0].stamp_ns + 20 * NS_PER_S]


def test_stamps_that_start_over_count_twice(tmp_path: Path, drive: tuple[Record, ...]) -> None:
    later_ns = 8000 * NS_PER_S
    # A clock that is set back by less than an hour loses nothing: the first drive is stamped later.
    first = [replace(record, stamp_ns=record.stamp_ns + later_ns) for record in drive]
    log_ns = [record.stamp_ns + start_ns for start_ns in (0, later_ns) for record in drive]
    path = write_bag(tmp_path / 'twice', (*first, *drive), log_ns)
    once_s = (drive[-1].stamp_ns - drive[0].stamp_ns) / NS_PER_S
    outcome = run(path)
    assert outcome.resistance.resets == 1
    # The aligner needs some records to accept that the stamps jumped back.
    assert outcome.duration_s == pytest.approx(2.0 * once_s, abs=2.0)


def test_missing_topic_is_named_with_the_bag(tmp_path: Path, drive: tuple[Record, ...]) -> None:
    path = write_bag(tmp_path / 'no_force', (r for r in drive[:200] if not isinstance(r, ForceRecord)))
    with pytest.raises(InputError, match=r'no_force.*ato/force'):
        run(path)


def test_recorded_bag_replays_to_the_same_outputs(replayed: tuple[Replay, Log, Path]) -> None:
    _, log, path = replayed
    again = Log()
    run(path, again)
    assert again.records == log.records
    assert repr(again.outputs) == repr(log.outputs)  # NaN equals no NaN


def test_recorded_bag_holds_estimates_and_latched_copies(replayed: tuple[Replay, Log, Path]) -> None:
    _, log, path = replayed
    with BagReader(path) as reader:
        counts = {topic.name: topic.count for topic in reader.topics()}
    outputs: list[Any] = [output for output in log.outputs if type(output.estimate).__name__ == 'ResistanceEstimate']
    assert counts['trainid/resistance'] == counts['trainid/speed_model'] == counts['trainid/brake_rate'] == len(outputs)
    valid = sum(o.status.name == 'VALID' for o in log.outputs if type(o.estimate).__name__ == 'BrakeRateEstimate')
    assert counts.get('trainid/last_valid/brake_rate', 0) == valid
    messages = messages_of(path, 'trainid/resistance')
    assert [(m.a, m.used) for m in messages] == [(o.estimate.a, o.used) for o in outputs]


def test_why_nothing_was_learned_is_said_with_the_most_frequent_rejection(
    replayed: tuple[Replay, Log, Path],
) -> None:
    outcome = replayed[0]
    last = outcome.resistance.output

    def said(used: int, speed_max: float) -> str:
        output = Output(last.stamp_ns, replace(last.estimate, speed_max=speed_max), last.status, used, 9, None)
        rejections = ((Reason.BRAKING, 7), (Reason.STANDSTILL, 2))
        result = replace(outcome.resistance, output=output, rejections=rejections)
        return replace(outcome, resistance=result, contradiction=Contradiction()).why_no_resistance()

    assert said(5, 0.5) == ''
    for used in (0, 5):
        assert f'{used} used, most often rejected: BRAKING (7 times)' in said(used, 0.0)


def test_settings_reach_the_estimators(bag: Path) -> None:
    strict = EstimatorSettings(resistance=RESISTANCE.choose(min_speed=50.0))
    with BagReader(bag) as reader:
        outcome = replay_through(Pipelines.of(TRAIN, strict), reader, duration_s=40.0)
    assert dict(outcome.resistance.rejections)[Reason.STANDSTILL] > 50
    assert outcome.resistance.output.used == 0


ESTIMATE_OF = {
    name: make(TRAIN, EstimatorSettings()).current().estimate
    for name, make in (('resistance', resistance_pipeline), ('brake_rate', brake_rate_pipeline))
}
NAMES = [column.name for column in COLUMNS]


def output(name: str, stamp_ns: int) -> Output[Any]:
    return Output(stamp_ns, ESTIMATE_OF[name], Status.VALID, 1, 0, None)


def test_each_field_of_each_message_has_a_column() -> None:
    for topic in OUTPUT_TOPICS:
        names = {text.split()[-1] for text in fields_of(definition(topic.message))} - {'header', 'last_reject_text'}
        assert names <= {column.field for column in COLUMNS if column.topic == topic.name}
        assert {item.name for item in fields(topic.estimate)} <= names
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)


def test_estimates_of_one_stamp_share_a_row_whatever_their_order() -> None:
    kept: list[TableRow] = []
    table = EstimateTable(kept.extend)
    for name, stamp_ns in (('resistance', 1), ('resistance', 2), *(('brake_rate', k) for k in (1, 2, 3))):
        table.on_output(output(name, stamp_ns), 0)
    table.finish()
    assert [row[0] for row in kept] == [1, 2, 3]
    assert [row[NAMES.index('resistance_a') + 1] for row in kept] == [1.5, 1.5, None]
    assert [row[NAMES.index('brake_rate_brake_rate') + 1] for row in kept] == [1.0, 1.0, 1.0]


def test_no_row_stays_open_for_long() -> None:
    kept: list[TableRow] = []
    table = EstimateTable(kept.extend)
    for stamp_ns in range(10_000):
        table.on_output(output('resistance', stamp_ns), 0)
    assert len(kept) >= 5000
    assert len(table._open) < 500


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_table_is_there_when_it_is_complete(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f'e{suffix}'

    def write(error: Exception | None) -> None:
        with estimate_table(path) as table:
            table.on_output(output('resistance', 1), 0)
            assert not path.exists()
            if error:
                raise error

    with pytest.raises(RuntimeError):
        write(RuntimeError())
    assert list(tmp_path.iterdir()) == []
    write(None)
    assert list(tmp_path.iterdir()) == [path]
    before: Any = path.read_bytes()
    with pytest.raises(InputError, match='exists already and is not overwritten'):
        write(None)
    assert path.read_bytes() == before


RATIO = 1.02


def ride(legs: int, ratio: float, lost: float = 0.0) -> Odometer:
    """Return an odometer after legs of 1 km, there and back, at 10 m/s measured as ``ratio`` times that."""
    speed = np.concatenate([np.r_[np.zeros(5), np.full(100, 10.0)] for _ in range(legs)] + [np.zeros(5)])
    position = np.cumsum(speed) * 1.0
    folded = 1000.0 - np.abs(position % 2000.0 - 1000.0)
    rows = [
        SpeedRecord((k + 1) * NS_PER_S + round(lost * NS_PER_S * (k > 50)), ratio * v, s)
        for k, (v, s) in enumerate(zip(speed.tolist(), folded.tolist(), strict=True))
    ]
    odometer, table = Odometer(), table_of([(record.stamp_ns, record.row()) for record in rows])
    for first in range(0, len(table), 37):
        odometer.add(table[first : first + 37])
    return odometer


@pytest.mark.parametrize(('legs', 'lost', 'max_std'), [(6, 0.0, 1e-3), (2, 10.0, 1e-2)])
def test_the_ratio_is_that_of_the_distances(legs: int, lost: float, max_std: float) -> None:
    found = ride(legs, RATIO, lost).ratio
    assert found is not None
    assert found[0] == pytest.approx(RATIO, abs=1e-9)
    assert 0.0 < found[1] < max_std


def test_legs_with_a_gap_or_in_another_unit_do_not_count() -> None:
    assert ride(1, RATIO, lost=10.0).ratio is None
    assert ride(4, 3.6).ratio is None
