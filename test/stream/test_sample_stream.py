# SPDX-License-Identifier: Apache-2.0
"""One stream of samples for all estimators."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from trainid_ros.estimators.pipeline import EstimatorPipeline, PipelineConfig, share_streams
from trainid_ros.interface.records import NS_PER_S, ForceRecord, Record, SpeedRecord
from trainid_ros.interface.results import Output, Reason
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.stream.alignment import AlignmentConfig, TimeJump
from trainid_ros.stream.input_faults import InputFaults
from trainid_ros.stream.known_force import KnownForce
from trainid_ros.stream.sample_stream import Contradiction, SampleStream, StreamConfig, TimeJumpPolicy
from trainid_ros.stream.samples import Sample
from trainid_ros.train.effects import parse_effects
from trainid_ros.train.train_file import TrainFile

MAKERS = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
SETTINGS = EstimatorSettings()


def with_effect(train_file: TrainFile, text: str) -> TrainFile:
    return replace(train_file, effects=parse_effects([text]))


def with_trouble(day: tuple[Record, ...]) -> list[Record]:
    """Return records with a stuck speed, a missing force and, in the middle, a jump back of the stamps."""
    first = day[0].stamp_ns
    records: list[Record] = []
    for record in day[: 2 * len(day) // 3]:
        t = (record.stamp_ns - first) / NS_PER_S
        if isinstance(record, SpeedRecord) and 60.0 < t < 75.0:
            records.append(replace(record, speed=14.0))
        elif not (isinstance(record, ForceRecord) and 100.0 < t < 104.0):
            records.append(record)
    return [*records, *records[: len(records) // 2]]


@pytest.mark.parametrize(
    'policy',
    [
        TimeJumpPolicy.RESET,
        pytest.param(TimeJumpPolicy.IGNORE, marks=pytest.mark.slow),
        pytest.param(TimeJumpPolicy.REFUSE, marks=pytest.mark.slow),
    ],
)
def test_estimators_on_one_stream_publish_what_they_publish_alone(
    policy: TimeJumpPolicy, metro: TrainFile, day: tuple[Record, ...]
) -> None:
    train_file = with_effect(metro, 'bearing_warmup:value=1,distance=3000')
    settings = replace(SETTINGS, pipeline=PipelineConfig(time_jump_policy=policy))
    alone: list[EstimatorPipeline[Any]] = [make(train_file, settings) for make in MAKERS]
    together: list[EstimatorPipeline[Any]] = [make(train_file, settings) for make in MAKERS]
    (stream,) = share_streams(together)
    expected: list[list[Output[Any]]] = [[], [], []]
    found: list[list[Output[Any]]] = [[], [], []]
    reasons = set()
    for record in with_trouble(day):
        events = stream.push(record)
        reasons |= {event.rejection.reason for event in events if isinstance(event, Sample) and event.rejection}
        for outputs, pipeline in zip(found, together, strict=True):
            pipeline.take(events, outputs.append)
        for outputs, pipeline in zip(expected, alone, strict=True):
            pipeline.take(pipeline.stream.push(record), outputs.append)
    assert repr(found) == repr(expected)
    assert Reason.SPEED_STUCK in reasons
    assert [pipeline.save() for pipeline in together] == [pipeline.save() for pipeline in alone]


def test_only_streams_of_equal_configurations_are_shared(metro: TrainFile) -> None:
    other = replace(SETTINGS, alignment=AlignmentConfig(max_lag=0.4))
    heavier = replace(metro, train=replace(metro.train, mass=2.0 * metro.train.mass))
    one, two, three, four = (
        resistance_pipeline(metro, SETTINGS),
        brake_rate_pipeline(metro, SETTINGS),
        speed_model_pipeline(metro, other),
        speed_model_pipeline(heavier, SETTINGS),
    )
    pipelines: list[EstimatorPipeline[Any]] = [one, two, three, four]
    assert share_streams(pipelines) == (one.stream, three.stream, four.stream)
    assert two.stream is one.stream


def events_of(stream: SampleStream, day: tuple[Record, ...]) -> list[Any]:
    return [event for record in with_trouble(day) for event in stream.push(record)]


def test_a_stuck_speed_is_marked_until_it_changes(metro: TrainFile, day: tuple[Record, ...]) -> None:
    samples = [event for event in events_of(SampleStream(StreamConfig(metro)), day) if isinstance(event, Sample)]
    first_ns = day[0].stamp_ns
    stuck_s = [
        (sample.stamp_ns - first_ns) / NS_PER_S
        for sample in samples
        if sample.rejection is not None and sample.rejection.reason is Reason.SPEED_STUCK
    ]
    assert 60.0 < min(stuck_s) < 70.0
    assert 74.0 < max(stuck_s) < 88.0  # ten seconds in which all is well


def test_a_stream_for_explain_uses_speeds_that_the_train_file_does_not_expect(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    events = events_of(SampleStream(StreamConfig(metro, rejects_faults=False)), day)
    assert not any(isinstance(event, Sample) and event.rejection for event in events)
    assert any(isinstance(event, TimeJump) for event in events)


def test_the_stream_evaluates_effects_once_for_all_estimators(metro: TrainFile, day: tuple[Record, ...]) -> None:
    file = with_effect(metro, 'bearing_warmup:value=4,distance=300')
    events = events_of(SampleStream(StreamConfig(file)), day)
    samples = [event for event in events if isinstance(event, Sample) and math.isfinite(event.force_mean)]
    known = KnownForce(file)
    assert [sample.extra for sample in samples] == [known.extra(replace(sample)) for sample in samples]
    samples[0].extra = 7.0
    assert known.extra(samples[0]) == 7.0
    assert KnownForce(metro).extra(samples[0]) == 0.0


def test_an_estimate_is_computed_once_a_sample_and_only_if_somebody_looks(
    metro: TrainFile, day: tuple[Record, ...]
) -> None:
    estimator = resistance_pipeline(metro, SETTINGS).estimator
    calls: list[float] = []

    class Counted:
        """The estimator, counting its estimates."""

        def __getattr__(self, name: str) -> Any:
            return getattr(estimator, name)

        def estimate(self, speed: float) -> Any:
            calls.append(speed)
            return estimator.estimate(speed)

    pipeline = EstimatorPipeline[Any](Counted(), SampleStream(StreamConfig(metro)), SETTINGS.pipeline)
    calls.clear()
    for record in day[:2000]:
        pipeline.take(pipeline.stream.push(record))
    assert pipeline.samples > 300
    assert calls == []
    assert pipeline.current().estimate is pipeline.current().estimate
    assert len(calls) == 1
    outputs = [output for record in day[2000:3000] for output in pipeline.push(record)]
    assert len(calls) == 1 + len(outputs)


def test_the_last_contradiction_counts_and_each_has_a_begin_and_an_end(metro: TrainFile) -> None:
    last, faults = Contradiction(), InputFaults(KnownForce(metro))
    last.follow(faults, 1.0)
    assert (last.finding, math.isnan(last.begin_s), math.isnan(last.end_s)) == ('', True, True)
    for now_s, finding in enumerate(['late by 1.0 s', 'late by 1.1 s', '', '', 'wrong sign'], start=2):
        faults.finding = finding
        last.follow(faults, float(now_s))
        if now_s == 5:
            assert (last.finding, last.begin_s, last.end_s) == ('late by 1.1 s', 2.0, 4.0)
    assert (last.finding, last.begin_s, math.isnan(last.end_s)) == ('wrong sign', 6.0, True)
