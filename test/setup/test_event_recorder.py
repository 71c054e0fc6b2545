# SPDX-License-Identifier: Apache-2.0
"""The last inputs go to a bag after a fault, a contradiction, a step or a request; not too often, not too many."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import write_rows
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, Record, Row, SpeedRecord
from trainid_ros.interface.results import Output, ResistanceEstimate, Status
from trainid_ros.setup.event_recorder import MAX_RECORDINGS, MAX_ROWS, MIN_PAUSE_NS, SEGMENTS, EventRecorder
from trainid_ros.train.train_file import load_train_file

ROW: Row = (1, 17, 2.5, 0.0, False)


def estimate_of(resistance: float) -> ResistanceEstimate:
    covariance = (0.01, *[0.0] * 8)
    return ResistanceEstimate(resistance, 0.0, 0.0, covariance, resistance, 0.1, 10.0, 0.0, 0.01, 0.0, 5.0, 20.0, 0.1)


@dataclass
class Stream:
    finding: str = ''


@dataclass
class Pipeline:
    """What the recorder sees of a pipeline."""

    status: Status = Status.VALID
    resistance: float = 1.5
    samples: int = 0
    stream: Stream = field(default_factory=Stream)

    def current(self) -> Output[ResistanceEstimate]:
        return Output(0, estimate_of(self.resistance), self.status, 0, 0, None)


class Recorded:
    """A recorder of ten minutes with a clock that stands, and what it wrote."""

    def __init__(self, folder: Path) -> None:
        self.now_ns = 0
        self.bags: dict[str, int] = {}
        self.said: list[str] = []
        self.warned: list[str] = []
        self.files: dict[str, str] = {}
        self.recorder = EventRecorder(
            folder, 10.0, self.write, self.said.append, self.warned.append, lambda: self.now_ns
        )
        self.recorder.files['train.yaml'] = lambda: 'the train'
        self.recorder.files['node.json'] = str  # nothing learned
        self.pipeline = Pipeline()
        self.recorder.take(ROW)

    def write(self, path: Path, rows: Iterable[tuple[int, Row]], files: Mapping[str, str]) -> None:
        path.mkdir()
        self.bags[path.name.partition('_')[2]] = len(list(rows))
        self.files = dict(files)

    def at(self, time_s: float, **changes: object) -> list[str]:
        """Let a sample come at a time, and be looked at then and half a minute later; return the events written."""
        self.now_ns = round(time_s * NS_PER_S)
        self.pipeline = replace(self.pipeline, samples=self.pipeline.samples + 1, **changes)  # type: ignore[arg-type]
        self.recorder.take(ROW)
        self.recorder.look('node', self.pipeline)  # type: ignore[arg-type]
        self.now_ns += 30 * NS_PER_S
        self.recorder.look('node', self.pipeline)  # type: ignore[arg-type]
        if self.recorder._writing is not None:
            self.recorder._writing.result()
        return list(self.bags)


@pytest.fixture
def recorded(tmp_path: Path) -> Recorded:
    return Recorded(tmp_path / 'a' / 'b')


@pytest.mark.parametrize(
    ('kind', 'changes', 'text'),
    [
        ('fault', {'status': Status.FAULT}, 'node: the estimator cannot continue\n'),
        ('contradiction', {'stream': Stream('ato/force')}, 'node: inputs contradict each other: ato/force\n'),
        ('step', {'resistance': 2.3}, 'node: resistance [N/kN] from 1.50 ± 0.10 to 2.30 ± 0.10\n'),
    ],
)
def test_an_event_is_recorded_once(recorded: Recorded, kind: str, changes: dict[str, object], text: str) -> None:
    assert not recorded.at(1.0)
    assert recorded.at(2.0, **changes) == [f'node_{kind}']
    assert recorded.files == {'train.yaml': 'the train', 'event.txt': text}
    assert recorded.at(100.0) == [f'node_{kind}']  # it lasts
    assert len(recorded.said) == 1


@pytest.mark.parametrize(
    'changes', [{'resistance': 2.1}, {'resistance': 9.0, 'status': Status.CONVERGING}], ids=['noise', 'not fit']
)
def test_no_step_without_significance(recorded: Recorded, changes: dict[str, object]) -> None:
    recorded.at(1.0)
    assert not recorded.at(2.0, **changes)


def test_slow_changes_are_no_step(recorded: Recorded) -> None:
    for k in range(20):
        recorded.at(400.0 * k, resistance=1.5 + 0.3 * k)
    assert not recorded.bags


def test_an_event_within_a_minute_waits(recorded: Recorded) -> None:
    recorded.at(1.0, status=Status.FAULT)
    assert recorded.at(32.0, stream=Stream('ato/force')) == ['node_fault']
    assert recorded.at(2.0 + MIN_PAUSE_NS / NS_PER_S) == ['node_fault', 'node_contradiction']


def test_what_is_due_is_written_at_the_end(recorded: Recorded) -> None:
    recorded.pipeline.status = Status.FAULT
    recorded.recorder.look('node', recorded.pipeline)  # type: ignore[arg-type]
    assert not recorded.bags
    recorded.recorder.flush()
    assert recorded.recorder._writing is not None
    recorded.recorder._writing.result()
    assert list(recorded.bags) == ['node_fault']


def test_a_request_does_not_wait(recorded: Recorded) -> None:
    recorded.at(1.0, status=Status.FAULT)
    assert '10 min' in recorded.recorder.request('node')
    assert recorded.at(2.0) == ['node_fault', 'node_request']


def test_only_the_last_minutes_are_kept(recorded: Recorded) -> None:
    for k in range(1, 2000):
        recorded.now_ns = k * NS_PER_S
        recorded.recorder.take(ROW)
    recorded.recorder.request('node')
    recorded.at(2000.0)
    assert 601 <= recorded.bags['node_request'] <= 601 + 120  # a segment lasts 120 s


def test_the_number_of_messages_is_limited(recorded: Recorded) -> None:
    for _ in range(MAX_ROWS + 10):
        recorded.recorder.take(ROW)
    recorded.recorder.request('node')
    recorded.at(1.0)
    assert MAX_ROWS * (SEGMENTS - 1) // SEGMENTS <= recorded.bags['node_request'] <= MAX_ROWS


def test_files_are_as_of_the_first_message(recorded: Recorded) -> None:
    recorded.recorder.files['node.json'] = lambda: f'{recorded.now_ns / NS_PER_S:g} s'
    for k in range(1, 2000):
        recorded.now_ns = k * NS_PER_S
        recorded.recorder.take(ROW)
    recorded.recorder.request('node')
    recorded.at(2000.0)
    begin_s = 2000 + 1 - recorded.bags['node_request']
    assert recorded.files['node.json'] == f'{begin_s} s'


def test_old_recordings_make_room_and_other_folders_stay(recorded: Recorded) -> None:
    folder = recorded.recorder._folder
    (folder / 'mine').mkdir()
    for k in range(MAX_RECORDINGS + 5):
        (folder / f'20200101T0000{k:02d}Z_node_fault').mkdir()
    recorded.recorder.request('node')
    recorded.at(1.0)
    left = sorted(path.name for path in folder.iterdir())
    assert len(left) == MAX_RECORDINGS + 1
    assert left[-1] == 'mine'
    assert left[0] == '20200101T000006Z_node_fault'


def test_a_full_disk_is_told(recorded: Recorded) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(28, 'No space left on device')

    recorded.recorder._write = fail
    recorded.at(1.0, status=Status.FAULT)
    assert 'No space left on device' in recorded.warned[0]


def test_an_impossible_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match=r'record_folder = .*file/x.*cannot be created: Not a directory'):
        Recorded(tmp_path / 'file' / 'x')


def test_the_bag_holds_what_was_taken(tmp_path: Path) -> None:
    records: list[Record] = [SpeedRecord(NS_PER_S, 20.0, 5.0), ForceRecord(NS_PER_S, -3e4), BrakeRecord(5, -0.5, True)]
    said: list[str] = []
    recorder = EventRecorder(tmp_path, 10.0, write_rows, said.append, said.append)
    recorder.files['train.yaml'] = lambda: 'train: {mass: 1.0e+5}\nresistance: {a: 1.0, b: 0.0, c: 0.0}\n'
    for record in records:
        recorder.take(record.row())
    recorder.request('node')
    recorder.flush()
    assert recorder._writing is not None
    recorder._writing.result()
    (bag,) = tmp_path.iterdir()
    with BagReader(bag) as reader:
        assert list(reader.records()) == records
    assert load_train_file(bag / 'train.yaml').train.mass == 1e5
    assert (bag / 'event.txt').read_text() == 'node: requested\n'
    assert said[0].startswith(f'{bag}: 3 messages recorded')
