# SPDX-License-Identifier: Apache-2.0
"""A wrong stamp is left out, and a pause of any length is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.bag.bag_replay import Pipelines, replay_through
from trainid_ros.bag.observers import TraceObserver
from trainid_ros.bag.plausible_stamps import PlausibleStamps
from trainid_ros.bag.reader import BagReader
from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import NS_PER_S, SpeedRecord
from trainid_ros.setup.pipelines import (
    EstimatorSettings,
    brake_rate_pipeline,
    resistance_pipeline,
    speed_model_pipeline,
)
from trainid_ros.train.train_file import load_train_file
from trainid_ros.view.tracks import Tracks

BAG = Path(__file__).parents[2] / 'bags' / 'tiny'
START = 1_700_000_000 * NS_PER_S
DRIVEN_S = 160


@pytest.fixture
def paused(tmp_path: Path) -> Path:
    """Return a bag with a pause of a quarter of an hour."""
    with BagReader(BAG) as reader:
        records = list(reader.records())
    end_ns = records[0].stamp_ns + DRIVEN_S * NS_PER_S
    with BagWriter(tmp_path / 'paused') as writer:
        for record in records:
            later = record.stamp_ns + (900 * NS_PER_S if record.stamp_ns > end_ns else 0)
            writer.write_record(replace(record, stamp_ns=later), later)
    return tmp_path / 'paused'


def test_inputs_after_a_pause_are_shown(paused: Path) -> None:
    file, settings = load_train_file(BAG / 'train.yaml'), EstimatorSettings()
    factories: Any = (resistance_pipeline, speed_model_pipeline, brake_rate_pipeline)
    pipelines = Pipelines(*(make(file, settings) for make in factories))
    tracks, traces = Tracks(pipelines), TraceObserver()
    with BagReader(paused) as reader:
        stamps = [record.stamp_ns for record in reader.records() if isinstance(record, SpeedRecord)]
        replay_through(pipelines, reader, None, (tracks, traces))
    shown = tracks.inputs['speed'].stamps
    assert shown[-1] == stamps[-1]
    assert len(stamps) - 10 < len(shown) <= len(stamps)
    drive = traces.finish().drive
    assert drive.time_s[-1] == pytest.approx((stamps[-1] - stamps[0]) / NS_PER_S, abs=0.2)
    assert len(drive.time_s) == len(shown)


def test_a_step_is_followed_once_a_sample_has_shown_it() -> None:
    stamps, later = PlausibleStamps(), START + 900 * NS_PER_S
    assert [stamps.accept(ns) for ns in (START, 0, later, START + NS_PER_S)] == [True, False, False, True]
    stamps.follow(later)
    assert stamps.accept(later + NS_PER_S)
    assert not stamps.accept(later + 10**15)
