# SPDX-License-Identifier: Apache-2.0
"""Small bags created for the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from test.own_bag import short_drive, write_bag

if TYPE_CHECKING:
    from pathlib import Path

    from trainid_ros.interface.records import Record


@pytest.fixture(scope='session')
def records() -> list[Record]:
    return short_drive()


@pytest.fixture
def bag(tmp_path: Path, records: list[Record]) -> Path:
    return write_bag(tmp_path / 'bag', records)
