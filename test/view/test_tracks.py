# SPDX-License-Identifier: Apache-2.0
"""What is collected for a recording equals the replay."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trainid_ros.bag.bag_replay import AnyOutput, Pipelines, replay, replay_through
from trainid_ros.bag.reader import BagReader, LoggedRecord
from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, SpeedModelEstimate, Status
from trainid_ros.monitor.shown_estimates import resistance_at
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.train.train_file import load_train_file
from trainid_ros.view.tracks import USED, Series, Tracks

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
NAMES = {ResistanceEstimate: 'resistance', SpeedModelEstimate: 'speed model', BrakeRateEstimate: 'brake rate'}
START = 1_700_000_000 * NS_PER_S


class Outputs:
    """Collects the outputs of a replay."""

    def __init__(self) -> None:
        self.seen: list[AnyOutput] = []

    def on_record(self, entry: LoggedRecord) -> None: ...

    def on_output(self, output: AnyOutput, log_ns: int) -> None:  # noqa: ARG002
        self.seen.append(output)


@pytest.fixture(scope='module')
def tracks() -> Tracks:
    file, settings = load_train_file(BAG / 'train.yaml'), EstimatorSettings()
    factories: Any = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    pipelines = Pipelines(*(make(file, settings) for make in factories))
    collected = Tracks(pipelines)
    with BagReader(BAG) as reader:
        replay_through(pipelines, reader, None, (collected,))
    return collected


@pytest.fixture(scope='module')
def outputs() -> list[AnyOutput]:
    observer = Outputs()
    with BagReader(BAG) as reader:
        replay(reader, load_train_file(BAG / 'train.yaml'), EstimatorSettings(), None, (observer,))
    return [output for output in observer.seen if output.stamp_ns > 0]


def test_estimates_are_those_of_the_replay_to_the_bit(tracks: Tracks, outputs: list[AnyOutput]) -> None:
    for kind, name in NAMES.items():
        expected = [(item.stamp_ns, item.estimate) for item in outputs if isinstance(item.estimate, kind)]
        assert tracks.estimates[name] == expected


def test_the_band_is_that_of_one_speed(tracks: Tracks, outputs: list[AnyOutput]) -> None:
    series = tracks.series('resistance')
    assert tracks.title('resistance') == 'resistance: w at 45 km/h [N/kN]'
    last = [item.estimate for item in outputs if isinstance(item.estimate, ResistanceEstimate)][-1]
    assert tuple(series.values[-2:]) == resistance_at(last, 45.0 / 3.6)


def test_status_changes_are_states_and_events(tracks: Tracks, outputs: list[AnyOutput]) -> None:
    statuses = [item.status.name for item in outputs if isinstance(item.estimate, BrakeRateEstimate)]
    changes = [after for before, after in zip(['', *statuses], statuses, strict=False) if before != after]
    assert [text for _, text in tracks.status['brake rate'].changes] == changes
    events = [item.text for item in tracks.events if item.text.startswith('brake rate: ')]
    assert len(events) == len(changes) > 3
    assert events[0] == f'brake rate: {changes[0]}'
    assert events[1] == f'brake rate: {changes[0]} to {changes[1]}'


def test_samples_are_used_or_rejected_for_a_reason(tracks: Tracks) -> None:
    texts = {text for _, text in tracks.rejected['resistance'].changes}
    assert {USED, 'BRAKING', 'STANDSTILL'} <= texts


def test_inputs_have_the_units_of_the_plots(tracks: Tracks) -> None:
    assert 70.0 < max(tracks.inputs['speed'].values) < 90.0
    assert 100.0 < max(tracks.inputs['force'].values) < 400.0
    assert min(tracks.inputs['brake_command'].values) < -0.3


def empty(finding: str = '') -> tuple[Tracks, Any]:
    stream = SimpleNamespace(finding=finding)
    pipelines: Any = SimpleNamespace(resistance=SimpleNamespace(stream=stream))
    return Tracks(pipelines), stream


def test_wrong_stamps_do_not_stretch_the_axis() -> None:
    tracks, _ = empty()
    for stamp in (START, 0, START + 10**15, START + NS_PER_S):
        tracks.on_record(LoggedRecord(START, 'ato/speed', SpeedRecord(stamp, 10.0, math.nan)))
    assert list(tracks.inputs['speed'].stamps) == [START, START + NS_PER_S]


def test_findings_are_events() -> None:
    tracks, stream = empty()
    estimate = BrakeRateEstimate(0.9, 0.05, 0.0, 10.0, 0.0, 0.0, 100.0, False, 0.0, 0.0, 0.0)
    for k, finding in enumerate(('', 'ato/speed looks like km/h', 'ato/speed looks like km/h', '')):
        stream.finding = finding
        tracks.on_output(Output(START + k, estimate, Status.CONVERGING, 0, 0, None), START)
    found = [(item.stamp_ns - START, item.is_bad, item.text) for item in tracks.events[1:]]
    assert found == [
        (1, True, 'inputs contradict each other: ato/speed looks like km/h'),
        (3, False, 'inputs agree again: ato/speed looks like km/h'),
    ]


def test_without_estimates_there_is_no_line() -> None:
    assert empty()[0].series('resistance') == Series()
    assert empty()[0].title('resistance') == 'resistance'
