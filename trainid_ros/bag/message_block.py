# SPDX-License-Identifier: Apache-2.0
"""The messages in a block of bytes, without a copy of any of them.

Record layout: MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.bag.record_file import values_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Channel, sequence, log time and publish time of a message.
_MESSAGE: Final = np.dtype([('channel', '<u2'), ('sequence', '<u4'), ('log_ns', '<u8'), ('publish_ns', '<u8')])
_LENGTH: Final = np.dtype('<i8')


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """The messages of one segment, in the order of the file."""

    data: NDArray[np.uint8]  # The bytes they lie in, shape (m,)
    start: NDArray[np.intp]  # Where their payloads start in ``data``, shape (n,)
    end: NDArray[np.intp]  # Where they end, shape (n,)
    channel: NDArray[np.uint16]  # Numbers of their channels, shape (n,)
    log_ns: NDArray[np.uint64]  # Log times, shape (n,)


def messages_at(data: bytes, starts: NDArray[np.intp]) -> MessageBlock:
    """Return the messages whose records, without opcode and length, start at these places."""
    heads = values_at(data, starts, _MESSAGE)
    ends = starts + lengths_at(data, starts)
    content = np.frombuffer(data, dtype=np.uint8)
    return MessageBlock(content, starts + _MESSAGE.itemsize, ends, heads['channel'], heads['log_ns'])


def lengths_at(data: bytes, starts: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the lengths of records, which stand before their starts."""
    return values_at(data, starts - _LENGTH.itemsize, _LENGTH)


def channels_at(data: bytes, starts: NDArray[np.intp]) -> NDArray[np.uint16]:
    """Return the channels of messages; their records must have the length of a message at least."""
    channels: NDArray[np.uint16] = values_at(data, starts, _MESSAGE)['channel']
    return channels
