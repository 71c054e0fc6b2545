# SPDX-License-Identifier: Apache-2.0
"""Errors a caller may catch, and settings declared once: default, unit, range and description in one place.

Every message names the file, topic or field at fault. Configurations are frozen dataclasses with fields made by
:func:`setting`; the same metadata validates a configuration, declares the ROS parameters and documents them.
"""

from __future__ import annotations

import math
from dataclasses import Field, dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


class TrainIdError(Exception):
    """Base class of all errors raised deliberately by this package."""


class InputError(TrainIdError):
    """A file, a field or an argument cannot be used (exit code 2 on the command line)."""


class NoAnswerError(TrainIdError):
    """The command ran, but the data do not determine a result (exit code 1 on the command line)."""


@dataclass(frozen=True, slots=True)
class SettingInfo:
    """Description, unit and closed range of one setting."""

    description: str
    unit: str
    low: float
    high: float


def setting(default: Any, description: str, unit: str, low: float, high: float) -> Any:
    """Declare a numeric dataclass field: default (MISSING without), description, unit and closed range."""
    return field(default=default, metadata={SettingInfo: SettingInfo(description, unit, low, high)})


def setting_info(item: Field[Any]) -> SettingInfo | None:
    """Return the metadata that :func:`setting` attached to a dataclass field, None for other fields."""
    info: SettingInfo | None = item.metadata.get(SettingInfo)
    return info


def check_settings(config: DataclassInstance) -> None:
    """Raise InputError, naming the field, if a setting is not finite or out of its range."""
    for item in fields(config):
        if (info := setting_info(item)) is not None:
            check_value(item.name, float(getattr(config, item.name)), info)


def check_value(name: str, value: float, info: SettingInfo) -> None:
    """Raise InputError if a value is not finite or outside the range of its setting."""
    if not (math.isfinite(value) and info.low <= value <= info.high):
        raise InputError(f'{name} = {value:g} {info.unit} is outside [{info.low:g}, {info.high:g}]')
