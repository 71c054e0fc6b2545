# SPDX-License-Identifier: Apache-2.0
"""Channels and message definitions of an MCAP file, of which some may be lost and repeated at its end."""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

DEFINITIONS: Final = (Opcode.SCHEMA, Opcode.CHANNEL)
"""Records that define something."""
UNREADABLE: Final = (McapError, struct.error, UnicodeDecodeError, OverflowError, KeyError)
"""What reading the content of a damaged record raises."""


class Definitions:
    """What the file defines before its messages, and in spare what it repeats at its end.

    Attributes:
        channels: Channels by number.
        schemas: Message definitions by number.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self._spare: Definitions | None = None

    @property
    def spare(self) -> Definitions:
        """Those that are used where one is lost."""
        self._spare = self._spare or Definitions()
        return self._spare

    def add(self, opcode: int, content: bytes) -> None:
        """Add a schema or a channel; one of UNREADABLE if it cannot be read."""
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas[schema.id] = schema
        else:
            channel = Channel.read(stream)
            self.channels[channel.id] = channel

    def use_spare(self, number: int) -> bool:
        """Take the definition of a channel from those in spare; return whether it is there."""
        channel = self.spare.channels.get(number)
        if channel is None:
            return False
        self.channels[number] = channel
        if channel.schema_id in self.spare.schemas:
            self.schemas.setdefault(channel.schema_id, self.spare.schemas[channel.schema_id])
        return True
