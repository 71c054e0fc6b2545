# SPDX-License-Identifier: Apache-2.0
"""Estimates of several estimators become rows of one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from trainid_ros.bag.types import definition, fields_of
from trainid_ros.inputs.estimate_table import COLUMNS, EstimateTable, Row, estimate_table
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import OUTPUT_TOPICS
from trainid_ros.interface.results import BrakeRateEstimate, Output, ResistanceEstimate, Status
from trainid_ros.setup.pipelines import EstimatorSettings, brake_rate_pipeline, resistance_pipeline
from trainid_ros.train.train_file import Davis, Train, TrainFile

TRAIN = TrainFile(Train(mass=194e3), Davis(1.5, 0.02, 0.001))
RESISTANCE = resistance_pipeline(TRAIN, EstimatorSettings()).current().estimate
BRAKE_RATE = brake_rate_pipeline(TRAIN, EstimatorSettings()).current().estimate
A = [column.name for column in COLUMNS].index('resistance_a') + 1
B = [column.name for column in COLUMNS].index('brake_rate_brake_rate') + 1


class Rows:
    """Keeps what is written."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def write(self, rows: Sequence[Row]) -> None:
        self.rows += rows

    def close(self) -> None:
        pass


def resistance(stamp_ns: int) -> Output[ResistanceEstimate]:
    return Output(stamp_ns, RESISTANCE, Status.VALID, 1, 0, None)


def brake_rate(stamp_ns: int) -> Output[BrakeRateEstimate]:
    return Output(stamp_ns, BRAKE_RATE, Status.VALID, 1, 0, None)


def test_each_field_of_each_message_has_a_column() -> None:
    for topic in OUTPUT_TOPICS:
        names = {text.split()[-1] for text in fields_of(definition(topic.message))} - {'header', 'last_reject_text'}
        assert names <= {column.field for column in COLUMNS if column.topic == topic.name}
        assert {item.name for item in fields(topic.estimate)} <= names
    assert len({column.name for column in COLUMNS}) == len(COLUMNS)


def test_estimates_of_one_stamp_share_a_row_whatever_their_order() -> None:
    kept = Rows()
    table = EstimateTable(kept)
    for output in (resistance(1), resistance(2), brake_rate(1), brake_rate(2), brake_rate(3)):
        table.on_output(output, 0)
    table.finish()
    assert [row[0] for row in kept.rows] == [1, 2, 3]
    assert [row[A] for row in kept.rows] == [1.5, 1.5, None]
    assert [row[B] for row in kept.rows] == [1.0, 1.0, 1.0]


def test_no_row_stays_open_for_long() -> None:
    kept = Rows()
    table = EstimateTable(kept)
    for stamp_ns in range(10_000):
        table.on_output(resistance(stamp_ns), 0)
    assert len(kept.rows) >= 5000
    assert len(table._open) < 500


@pytest.mark.parametrize('suffix', ['.csv', '.parquet'])
def test_a_table_is_there_when_it_is_complete(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f'e{suffix}'

    def write(error: Exception | None) -> None:
        with estimate_table(path) as table:
            table.on_output(resistance(1), 0)
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
