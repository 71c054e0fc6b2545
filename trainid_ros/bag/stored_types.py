# SPDX-License-Identifier: Apache-2.0
"""Message types by the definitions that a bag holds, without their packages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.records import Schema

_IDL_LINE: Final = '=' * 80 + '\n'


class StoredType:
    """A message type with its definition; without one it must be a standard type of ROS 2."""

    def __init__(self, path: Path, schema: Schema) -> None:
        """Read the definition; InputError, naming the file, if it cannot be read."""
        self.name = schema.name
        text = schema.data.decode('utf-8', errors='replace')
        self._store = get_typestore(Stores.EMPTY if text.strip() else Stores.ROS2_JAZZY)
        try:
            if schema.encoding == 'ros2msg':
                self._store.register(get_types_from_msg(text, schema.name))
            else:
                for part in text.split(_IDL_LINE):
                    idl = part.partition('\n')[2] if part.startswith('IDL: ') else part
                    if idl.strip():
                        self._store.register(get_types_from_idl(idl))
            self._store.get_msgdef(schema.name)
        except (TypesysError, KeyError) as error:
            raise InputError(
                f'{path}: unreadable definition of {schema.name} ({" ".join(str(error).split())})'
            ) from None

    @property
    def digest(self) -> str:
        """RIHS01 digest of the type."""
        return str(self._store.hash_rihs01(self.name))

    def decode(self, payload: bytes) -> Any:
        """Return a message; SerdeError if it cannot be read."""
        return self._store.deserialize_cdr(payload, self.name)
