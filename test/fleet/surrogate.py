# SPDX-License-Identifier: Apache-2.0
"""Rows of a made-up fleet: levels of the trains, common days, independent errors."""

from __future__ import annotations

import numpy as np

from trainid_ros.fleet.mixed_model import CHANNELS
from trainid_ros.fleet.table_file import Row, empty_row

MEAN = np.array([3.7, 0.98, 1.0, 1.0])
LEVEL = np.array([0.15, 0.03, 0.02, 0.003])
DAY = np.array([0.4, 0.01, 0.0005, 0.0])
ERROR = np.array([0.12, 0.005, 0.004, 0.0002])
# The estimators state more than what changes from day to day.
STATED = 4.0 * ERROR


def fleet_rows(
    seed: int,
    trains: int,
    days: int,
    steps: dict[int, tuple[int, np.ndarray]] | None = None,
    lines: int = 1,
    lasts: int | None = None,
) -> list[Row]:
    """Return one row per train and day; steps are added to the channels of a train from a day on, for some days."""
    rng = np.random.default_rng(seed)
    level, common = LEVEL * rng.standard_normal((trains, 4)), DAY * rng.standard_normal((lines, days, 4))
    rows = []
    for k in range(trains):
        for d in range(days):
            value = MEAN + level[k] + common[k % lines, d] + ERROR * rng.standard_normal(4)
            if steps and k in steps and 0 <= d - steps[k][0] < (lasts or days):
                value = value + steps[k][1]
            row = empty_row() | {'bag': f'{k}/{d}', 'train': f'T{k:02d}', 'day': f'2026-03-{d + 1:02d}'}
            row |= {'status': 'VALID', 'line': f'L{k % lines}', 'start': 1.7e9 + 86400.0 * d}
            for i, channel in enumerate(CHANNELS):
                row |= {channel.name: float(value[i]), f'{channel.name}_std': float(STATED[i])}
            rows.append(row)
    return rows
