# SPDX-License-Identifier: Apache-2.0
"""Messages of ``trainid_msgs`` for rosbags, and their conversion from and to the records of the core.

The definitions are the packaged ``.msg`` files, the same ones that ROS compiles, so a RIHS01 digest
computed here equals the type hash that ROS uses. rosbags is imported only to write, and to read messages or
definitions that are not in the usual form.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Record, input_topic, output_topic, output_values, record_values

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from trainid_ros.interface.records import OutputLike


PACKAGE: Final = 'trainid_msgs'
_FOLDER: Final = Path(__file__).parent / 'msg'
_INT32_MAX: Final = 2**31 - 1
# The messages that ours contain.
_CONTAINED: Final = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
}
_SEPARATOR: Final = '=' * 80 + '\n'
_CONSTANT: Final = re.compile(r'\S+\s+[A-Z][A-Z0-9_]*\s*=')


def full_type(name: str) -> str:
    """Return the full name of one of our messages, such as ``trainid_msgs/msg/AtoSpeed``."""
    return f'{PACKAGE}/msg/{name}'


@cache
def definition(message: str) -> str:
    """Return the text of the packaged definition of one of our messages, given its short name."""
    return (_FOLDER / f'{message}.msg').read_text(encoding='utf-8')


def fields_of(text: str) -> list[str]:
    """Return the fields in the text of a definition, such as ``float64 speed``, without constants and comments."""
    lines = (' '.join(line.partition('#')[0].split()) for line in text.splitlines())
    return [line for line in lines if line and not _CONSTANT.match(line)]


def is_packaged(text: str, message: str) -> bool:
    """Return whether the text of a definition, followed by those it contains, has the fields of the packaged one.

    Other texts may mean the same: compare their digest.
    """
    first, *others = text.split(_SEPARATOR)
    bodies = dict(part.removeprefix('MSG: ').split('\n', 1) for part in others if '\n' in part)
    contained = {name: fields_of(body) for name, body in bodies.items()}
    expected = {name: fields_of(body) for name, body in _CONTAINED.items()}
    return fields_of(first) == fields_of(definition(message)) and contained == expected


@cache
def typestore() -> Typestore:
    """Return a typestore of the packaged messages and those they contain."""
    # Imported here because reading a bag rarely needs it.
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

    ours = {full_type(path.stem): definition(path.stem) for path in sorted(_FOLDER.glob('*.msg'))}
    contained = {name.replace('/', '/msg/'): text for name, text in _CONTAINED.items()}
    store = get_typestore(Stores.EMPTY)
    for name, text in (contained | ours).items():
        store.register(get_types_from_msg(text, name))
    return store


@cache
def full_definition(message: str) -> str:
    """Return the packaged definition of one of our messages with its comments, followed by those it contains."""
    contained = [f'MSG: {name}\n{text}' for name, text in reversed(_CONTAINED.items())]
    return _SEPARATOR.join((definition(message), *contained))


@cache
def digest(message: str) -> str:
    """Return the RIHS01 digest of one of our messages, given its short name."""
    return str(typestore().hash_rihs01(full_type(message)))


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Return the seconds and nanoseconds of a stamp [ns].

    Raises:
        InputError: ``builtin_interfaces/Time`` cannot hold the stamp.
    """
    sec, nanosec = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= sec <= _INT32_MAX:
        raise InputError(f'stamp {stamp_ns} ns does not fit a ROS time')
    return sec, nanosec


def header(stamp_ns: int) -> Any:
    """Return a ``std_msgs/Header`` with a stamp [ns] and an empty frame."""
    types = typestore().types
    sec, nanosec = split_stamp(stamp_ns)
    stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    return types['std_msgs/msg/Header'](stamp=stamp, frame_id='')


def message_from_record(record: Record) -> Any:
    """Return the message of a record, as the rosbags class of its type."""
    return _build(input_topic(record).message, record.stamp_ns, record_values(record))


def estimate_message(output: OutputLike) -> Any:
    """Return the message of an estimator output, as the rosbags class of its type."""
    return _build(output_topic(output.estimate).message, output.stamp_ns, output_values(output))


def _build(name: str, stamp_ns: int, values: dict[str, Any]) -> Any:
    arrays = {key: np.array(value, dtype=np.float64) for key, value in values.items() if isinstance(value, list)}
    return typestore().types[full_type(name)](header=header(stamp_ns), **(values | arrays))
