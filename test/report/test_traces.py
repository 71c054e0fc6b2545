# SPDX-License-Identifier: Apache-2.0
"""Traces keep the data that a plot needs, for drives of any length."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.interface.results import Output, ResistanceEstimate, Status
from trainid_ros.report.traces import CAPACITY, TraceRecorder

START_NS = 1_700_000_000 * NS_PER_S
ESTIMATE = ResistanceEstimate(
    a=1.0, b=2.0, c=3.0, covariance=tuple(map(float, range(9))), resistance=0.0, resistance_std=0.0, speed=4.0,
    innovation=0.0, innovation_variance=1.0, test_ratio=0.0, speed_min=1.0, speed_max=9.0, resistance_std_max=0.3,
)  # fmt: skip


def outputs(count: int, **changes: Callable[[int], float]) -> TraceRecorder:
    recorder = TraceRecorder()
    for i in range(count):
        values: dict[str, Any] = {name: change(i) for name, change in changes.items()}
        estimate = replace(ESTIMATE, **({'innovation': float(i)} | values))
        recorder.on_output(Output(START_NS + i * NS_PER_S // 5, estimate, Status.VALID, i, 0, None))
    return recorder


def test_short_trace_is_kept_unthinned() -> None:
    trace = outputs(100, a=float).finish().resistance
    np.testing.assert_array_equal(trace.theta[:, 0], np.arange(100.0))
    np.testing.assert_allclose(trace.time_s, 0.2 * np.arange(100), atol=1e-9)
    np.testing.assert_array_equal(trace.covariance[0], np.arange(9.0).reshape(3, 3))
    assert trace.usable.all()
    assert trace.speed_range == (1.0, 9.0)


def test_long_trace_is_thinned_evenly_and_ends_with_the_newest() -> None:
    count = 5 * CAPACITY + 7
    trace = outputs(count, a=float).finish().resistance
    assert CAPACITY // 2 <= len(trace.time_s) <= CAPACITY
    assert trace.theta[-1, 0] == count - 1
    steps = np.diff(trace.time_s[:-1])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)


def test_greatest_test_ratio_is_kept_by_thinning() -> None:
    trace = outputs(4 * CAPACITY, test_ratio=lambda i: 50.0 if i == 1234 else 0.1).finish().resistance
    assert trace.ratio.max() == 50.0
    assert trace.ratio_time_s[trace.ratio.argmax()] == pytest.approx(1234 / 5)


def test_repeated_innovation_is_plotted_once() -> None:
    trace = outputs(50, innovation=lambda i: float(i // 10)).finish().resistance
    assert len(trace.ratio) == 5


def test_modes_follow_force_brake_and_speed(make_chapter: Callable[..., Any]) -> None:
    modes = make_chapter(240).traces.drive.modes
    assert [span.label for span in modes] == ['traction', 'coast', 'brake', 'standstill'] * 2
    assert all(first.end_s == second.start_s for first, second in pairwise(modes))
    assert [span.end_s - span.start_s for span in modes[:-1]] == [30.0] * 7


def test_statuses_and_observability_are_spans(make_chapter: Callable[..., Any]) -> None:
    traces = make_chapter(240).traces
    assert [span.label for span in traces.resistance.statuses[:3]] == ['CONVERGING', 'VALID', 'HOLDING']
    assert [(span.start_s, span.end_s) for span in traces.brake_rate.observable] == [(60.0, 90.0), (180.0, 210.0)]
    assert traces.duration_s == 239.0


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
    recorder.on_record(SpeedRecord(START_NS, 5.0, 0.0))
    recorder.on_record(record)
    traces = recorder.finish()
    assert traces.duration_s == pytest.approx(1.8)
    assert traces.drive.speed.tolist() == [5.0]


def test_inputs_may_be_recorded_after_the_outputs() -> None:
    recorder = outputs(10_000)
    for i in range(10):
        recorder.on_record(SpeedRecord(START_NS + i * NS_PER_S, 5.0, 0.0))
    assert len(recorder.finish().drive.time_s) == 10


def test_no_input_gives_empty_traces() -> None:
    traces = TraceRecorder().finish()
    assert traces.resistance.theta.shape == (0, 3)
    assert traces.resistance.covariance.shape == (0, 3, 3)
    assert traces.drive.modes == ()
    assert traces.duration_s == 0.0
