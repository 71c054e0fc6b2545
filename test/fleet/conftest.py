# SPDX-License-Identifier: Apache-2.0
"""The smallest shipped bag, and how it is replayed."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.bag.mcap_file import MAX_CHUNK
from trainid_ros.fleet.table_file import Setup


@pytest.fixture
def tiny() -> Path:
    return Path(__file__).resolve().parents[2] / 'bags' / 'tiny'


@pytest.fixture
def setup(tiny: Path) -> Setup:
    return Setup(tiny / 'train.yaml', None, None, '/', MAX_CHUNK)
