# SPDX-License-Identifier: Apache-2.0
"""Small bags created for the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from trainid_ros.bag.writer import BagWriter
from trainid_ros.interface.records import NS_PER_S, BrakeRecord, ForceRecord, GradientRecord, Record, SpeedRecord

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_700_000_000 * NS_PER_S
PERIOD_NS = NS_PER_S // 5
COUNT = 50


def drive(count: int = COUNT) -> list[Record]:
    """Return the four required topics at 5 Hz, each with its own stamps, in stamp order."""
    records: list[Record] = []
    for i in range(count):
        stamp = START_NS + i * PERIOD_NS
        records += [
            SpeedRecord(stamp, 0.1 * i, 100.0 + i),
            ForceRecord(stamp + 1, 1e5 - i),
            GradientRecord(stamp + 2, -3.0 + 0.1 * i, 400.0, tunnel=i % 2 == 0),
            BrakeRecord(stamp + 3, -0.5 if i >= count // 2 else 0.0, emergency=i == count - 1),
        ]
    return records


@pytest.fixture(scope='session')
def records() -> list[Record]:
    return drive()


@pytest.fixture
def bag(tmp_path: Path, records: list[Record]) -> Path:
    with BagWriter(tmp_path / 'bag') as writer:
        for record in records:
            writer.write_record(record)
    return tmp_path / 'bag'
