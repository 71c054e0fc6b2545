# SPDX-License-Identifier: Apache-2.0
"""``trainid replay --out``: the estimates of the bag, as Parquet and CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet

from test.own_bag import messages_of
from trainid_ros.cli.main import main
from trainid_ros.inputs.mapping import date_time_ns
from trainid_ros.interface.records import stamp_of
from trainid_ros.interface.results import Status


@pytest.fixture(scope='module')
def outputs(driven_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('outputs')
    replay = ['replay', str(driven_bag), '--train', str(driven_bag / 'train.yaml'), '--out']
    for name in ('bag', 'e.parquet', 'e.csv'):
        assert main([*replay, str(folder / name)]) == 0
    return folder


@pytest.fixture(scope='module')
def expected(outputs: Path) -> dict[int, Any]:
    """Return the resistances of the bag by stamp."""
    return {stamp_of(message): message for message in messages_of(outputs / 'bag', 'trainid/resistance')}


def test_parquet_holds_the_estimates_with_units_and_covariance(outputs: Path, expected: dict[int, Any]) -> None:
    table = parquet.read_table(outputs / 'e.parquet')
    assert table.schema.field('resistance_b').metadata == {b'unit': b'N/kN per m/s'}
    columns = ('resistance_a', 'resistance_covariance', 'resistance_status', 'resistance_used')
    rows = zip(table['time'].cast('int64').to_pylist(), *(table[name].to_pylist() for name in columns), strict=True)
    assert list(rows) == [
        (stamp_ns, message.a, message.covariance.tolist(), Status(message.status).name, message.used)
        for stamp_ns, message in expected.items()
    ]
    assert sum(column.null_count for column in table.columns) == 0


def test_csv_holds_the_estimates_with_units_in_its_header(outputs: Path, expected: dict[int, Any]) -> None:
    with (outputs / 'e.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    assert [date_time_ns(row['time']) for row in rows] == list(expected)
    for row, message in zip(rows, expected.values(), strict=True):
        assert float(row['resistance_a [N/kN]']) == message.a
        assert float(row['resistance_a_std [N/kN]']) ** 2 == pytest.approx(message.covariance[0])
        assert row['resistance_status'] == Status(message.status).name
