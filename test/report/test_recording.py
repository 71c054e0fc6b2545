# SPDX-License-Identifier: Apache-2.0
"""A recording keeps the data that a plot needs, for drives of any length; wrong stamps do not stretch it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from test.report.conftest import RESISTANCE, START_NS
from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import NS_PER_S, ForceRecord, SpeedRecord
from trainid_ros.interface.results import Output, Reason, Rejection, Status
from trainid_ros.report.recording import CAPACITY, CONTRADICTED, GAP, REJECTED, Recorder
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.train.train_file import load_train_file

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
DRIVEN_S = 160
ESTIMATE = replace(RESISTANCE, covariance=tuple(map(float, range(9))), speed_min=1.0, speed_max=9.0)


def outputs(count: int, **changes: Callable[[int], float]) -> Recorder:
    recorder = Recorder()
    for i in range(count):
        values: dict[str, Any] = {name: change(i) for name, change in changes.items()}
        estimate = replace(ESTIMATE, **({'innovation': float(i)} | values))
        recorder.on_output(Output(START_NS + i * NS_PER_S // 5, estimate, Status.VALID, i, 0, None))
    return recorder


def test_short_track_is_kept_unthinned() -> None:
    track = outputs(100, a=float).finish().resistance
    np.testing.assert_array_equal(track.theta[:, 0], np.arange(100.0))
    np.testing.assert_allclose(track.time_s, 0.2 * np.arange(100), atol=1e-9)
    np.testing.assert_array_equal(track.covariance[0], np.arange(9.0).reshape(3, 3))
    assert track.usable.all()
    assert track.speed_range == (1.0, 9.0)


def test_long_track_is_thinned_evenly_and_ends_with_the_newest() -> None:
    count = 5 * CAPACITY + 7
    track = outputs(count, a=float).finish().resistance
    assert CAPACITY // 2 <= len(track.time_s) <= CAPACITY
    assert track.theta[-1, 0] == count - 1
    steps = np.diff(track.time_s[:-1])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)


def test_contradictions_gaps_and_rejections_are_spans_of_time() -> None:
    reasons = [Reason.NONE, Reason.BRAKING, Reason.CONTRADICTION, Reason.CONTRADICTION, Reason.NONE, Reason.GAP]
    recorder = Recorder()
    for i, reason in enumerate((*reasons, Reason.OUTLIER, Reason.STANDSTILL)):
        stamp_ns = START_NS + i * NS_PER_S
        rejection = Rejection(stamp_ns, reason, math.nan, math.nan)
        recorder.on_output(Output(stamp_ns, ESTIMATE, Status.VALID, i, 0, rejection))
    old = Rejection(START_NS, Reason.OUTLIER, math.nan, math.nan)
    recorder.on_output(Output(START_NS + 9 * NS_PER_S, ESTIMATE, Status.VALID, 9, 0, old))
    spans = recorder.finish().resistance.faults
    assert spans == ((2.0, 4.0, CONTRADICTED), (4.0, 5.0, GAP), (6.0, 7.0, REJECTED))


def test_of_the_test_ratios_the_greatest_is_kept_and_repeated_ones_are_not() -> None:
    track = outputs(4 * CAPACITY, test_ratio=lambda i: 50.0 if i == 1234 else 0.1).finish().resistance
    assert track.ratios.values.max() == 50.0
    assert track.ratios.time_s[track.ratios.values.argmax()] == pytest.approx(1234 / 5)
    assert len(outputs(50, innovation=lambda i: float(i // 10)).finish().resistance.ratios.values) == 5


@pytest.mark.parametrize(
    'record',
    [
        SpeedRecord(0, 5.0, 0.0),
        SpeedRecord(START_NS + 10**15, 5.0, 0.0),
        SpeedRecord(START_NS + NS_PER_S, math.nan, 0.0),
    ],
    ids=['no stamp', 'stamp far ahead', 'no speed'],
)
def test_implausible_speed_does_not_extend_the_time_axis(record: SpeedRecord) -> None:
    recorder = outputs(10)
    recorder.add_record(SpeedRecord(START_NS, 5.0, 0.0))
    recorder.add_record(record)
    recording = recorder.finish()
    assert recording.duration_s == pytest.approx(1.8)
    assert recording.drive()[1].tolist() == [5.0]


def test_another_time_base_of_another_input_does_not_hide_the_speed() -> None:
    recorder = Recorder()
    recorder.add_record(ForceRecord(START_NS + 10**15, 1.0))
    recorder.add_record(SpeedRecord(START_NS, 5.0, 0.0))
    assert recorder.finish().drive()[1].tolist() == [5.0]


def test_an_unknown_speed_is_a_gap() -> None:
    recorder = Recorder()
    for i, speed in enumerate((5.0, math.nan, 6.0)):
        recorder.add_record(SpeedRecord(START_NS + i * NS_PER_S, speed, 0.0))
    recording = recorder.finish()
    np.testing.assert_array_equal(recording.speed.values[:, 0], [5.0, math.nan, 6.0])
    assert recording.drive()[1].tolist() == [5.0, 6.0]


def test_inputs_may_be_recorded_after_the_outputs_or_not_at_all() -> None:
    recorder = outputs(10_000)
    for i in range(10):
        recorder.add_record(SpeedRecord(START_NS + i * NS_PER_S, 5.0, 0.0))
    assert len(recorder.finish().drive()[0]) == 10
    recording = Recorder().finish()
    assert recording.resistance.theta.shape == (0, 3)
    assert recording.resistance.covariance.shape == (0, 3, 3)
    assert (recording.modes, recording.duration_s) == ((), 0.0)


def test_inputs_after_a_pause_are_shown(tmp_path: Path) -> None:
    with BagReader(BAG) as reader:
        records = list(reader.records())
    end_ns = records[0].stamp_ns + DRIVEN_S * NS_PER_S
    with BagWriter(tmp_path / 'paused') as writer:
        for record in records:
            later = record.stamp_ns + (900 * NS_PER_S if record.stamp_ns > end_ns else 0)
            writer.write_record(replace(record, stamp_ns=later), later)
    file, settings = load_train_file(BAG / 'train.yaml'), EstimatorSettings()
    pipelines = Pipelines.of(file, settings)
    recorder = Recorder()
    with BagReader(tmp_path / 'paused') as reader:
        stamps = [record.stamp_ns for record in reader.records() if isinstance(record, SpeedRecord)]
        replay_through(pipelines, reader, None, (recorder,))
    recording = recorder.finish()
    shown = recording.start_ns + recording.speed.time_ns
    assert shown[-1] == stamps[-1]
    assert len(stamps) - 10 < len(shown) <= len(stamps)
    assert recording.duration_s == pytest.approx((stamps[-1] - stamps[0]) / NS_PER_S, abs=0.2)
