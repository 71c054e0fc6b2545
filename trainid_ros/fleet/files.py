# SPDX-License-Identifier: Apache-2.0
"""Write files as a whole: a killed run leaves the old one or the new one, never half of it."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from trainid_ros.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let a function write another file, and rename that.

    Raises:
        InputError: It cannot be written.

    """
    part = path.with_name(f'{path.name}.part')
    try:
        write(part)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):  # half a file
            part.unlink(missing_ok=True)
        msg = f'{path}: cannot be written ({error.strerror})'
        raise InputError(msg) from None
