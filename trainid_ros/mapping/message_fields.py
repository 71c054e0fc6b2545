# SPDX-License-Identifier: Apache-2.0
"""Type and fields of messages of any class, for errors."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any


def type_of(message: Any) -> str:
    """Return the type of a message as a bag names it, such as ``std_msgs/msg/Float64``."""
    kind = type(message)
    if name := getattr(message, '__msgtype__', ''):  # of rosbags
        return str(name)
    package, _, rest = kind.__module__.partition('.')
    return f'{package}/msg/{kind.__name__}' if rest.startswith('msg.') else kind.__name__


def names_of(value: Any) -> tuple[str, ...]:
    """Return the names of the fields of a message or of a part of it, none of a number."""
    if hasattr(value, 'get_fields_and_field_types'):  # of rclpy
        return tuple(value.get_fields_and_field_types())
    names = (item.name for item in fields(value)) if is_dataclass(value) else ()
    return tuple(name for name in names if not name.startswith('_'))
