# SPDX-License-Identifier: Apache-2.0
"""Columns of the table of a fleet: one row per bag."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from trainid_ros.results import Reason, Status

Row = dict[str, Any]
"""Values by name of the column; None where a value is not known. Times are in seconds since 1970 (UTC)."""

SPEEDS: Final = (10, 15, 20)
"""Speeds at which the resistance is stated [m/s]."""


class Column(NamedTuple):
    """One column.

    Attributes:
        name: Name.
        kind: 'text', 'float', 'int' or 'time'.
        unit: Unit, '' for text; '1' for ratios and counts.
        text: What it is.

    """

    name: str
    kind: str
    unit: str
    text: str


def reason_column(reason: Reason) -> str:
    """Return the column with the number of rejections for a reason."""
    return f'rejected_{reason.name.lower()}'


def share_column(status: Status) -> str:
    """Return the column with the share of outputs that had a status."""
    return f'share_{status.name.lower()}'


_PARAMETERS: Final = (('a', 'N/kN'), ('b', 'N/kN per m/s'), ('c', 'N/kN per (m/s)^2'))
_REASONS: Final = tuple(reason for reason in Reason if reason not in (Reason.NONE, Reason.THINNED))


def _with_std(name: str, unit: str, text: str) -> tuple[Column, Column]:
    return Column(name, 'float', unit, text), Column(f'{name}_std', 'float', unit, f'standard deviation of {name}')


COLUMNS: Final = (
    Column('bag', 'text', '', 'absolute path of the bag'),
    Column('train', 'text', '', 'train, from --label, --namespace or the custom data of the bag'),
    Column('line', 'text', '', 'line, from --label or the custom data of the bag'),
    Column('day', 'text', '', 'day, YYYY-MM-DD: as line, or that of the start in UTC'),
    Column('weather', 'text', '', 'weather, as line'),
    Column('start', 'time', 's', 'log time of the first message'),
    Column('duration_s', 'float', 's', 'time covered by the samples'),
    Column('status', 'text', '', 'status of the resistance at the end; empty if the bag was not replayed'),
    Column('error', 'text', '', 'why there is no estimate'),
    *(Column(name, 'float', unit, f'Davis parameter {name}') for name, unit in _PARAMETERS),
    *(Column(f'{name}_std', 'float', unit, f'standard deviation of {name}') for name, unit in _PARAMETERS),
    *(column for speed in SPEEDS for column in _with_std(f'w{speed}', 'N/kN', f'running resistance at {speed} m/s')),
    Column('speed_min', 'float', 'm/s', 'slowest speed learned from'),
    Column('speed_max', 'float', 'm/s', 'fastest speed learned from'),
    *_with_std('brake_rate', '1', 'brake rate, 1 = nominal'),
    Column('brake_status', 'text', '', 'status of the brake rate at the end'),
    *_with_std('dead_time', 's', 'dead time of the brake; empty where none was learned'),
    *_with_std('force_scale', '1', 'actual over reported specific force'),
    *_with_std('force_delay', 's', 'delay of the stamps of the force'),
    *_with_std('wheel_ratio', '1', 'distance by the speed over that by the position, from stop to stop'),
    Column('mass_factor', 'float', '1', 'true over stated mass, with rotating masses, from the speed model'),
    Column('used', 'int', '1', 'samples that the resistance was learned from'),
    Column('brake_used', 'int', '1', 'samples that the brake rate was learned from'),
    Column('rejected', 'int', '1', 'records and samples that the resistance was not learned from'),
    *(Column(reason_column(reason), 'int', '1', f'of these: {reason.name}') for reason in _REASONS),
    *(Column(share_column(status), 'float', '1', f'share of outputs that were {status.name}') for status in Status),
    Column('contradiction', 'text', '', 'last contradiction between the inputs: no estimate of this run is compared'),
    Column('finding', 'text', '', 'errors of the force and of the brake that were found'),
    Column('warnings', 'text', '', 'faults of the bag that do not prevent reading'),
    Column('revision', 'text', '', 'version of trainid_ros and digest of the modules that compute'),
)
NAMES: Final = tuple(column.name for column in COLUMNS)


def empty_row() -> Row:
    """Return a row without values."""
    return dict.fromkeys(NAMES)
