# SPDX-License-Identifier: Apache-2.0
"""Rows as they come, one JSON object a line: what a killed run leaves, and the next run goes on from."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final, Self

from trainid_ros.errors import InputError

_START: Final = '["'

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import TextIO

    from trainid_ros.fleet.columns import Row


def read_journal(path: Path) -> dict[str, Row]:
    """Return the rows by key; lines that a killed run left unfinished are no rows. Empty without a file.

    Raises:
        InputError: It cannot be read, or is something else.

    """
    rows: dict[str, Row] = {}
    try:
        text = path.read_text(encoding='utf-8', errors='replace')
    except FileNotFoundError:
        return rows
    except OSError as error:
        msg = f'{path}: cannot be read ({error})'
        raise InputError(msg) from None
    *lines, _ = text.split('\n')
    for line in lines:
        try:
            key, row = json.loads(line)
            rows[str(key)] = dict(row)
        except (ValueError, TypeError):
            continue  # a kill, or a loss of power, may leave anything
    if lines and not rows and not lines[0].startswith(_START):
        msg = f'{path}: holds no row of a fleet; remove the file or choose another --out'
        raise InputError(msg)
    return rows


class Journal:
    """Appends rows; use as a context manager."""

    def __init__(self, path: Path) -> None:
        """Name the file."""
        self._path = path
        self._file: TextIO | None = None

    def __enter__(self) -> Self:
        """Open the file; a line that was left unfinished is ended.

        Raises:
            InputError: It cannot be written.

        """
        try:
            self._file = self._path.open('a', encoding='utf-8')
            if self._file.tell() and not self._path.read_bytes().endswith(b'\n'):
                self._file.write('\n')
        except OSError as error:
            msg = f'{self._path}: cannot be written ({error.strerror})'
            raise InputError(msg) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def add(self, key: str, row: Row) -> None:
        """Append a row; it survives the end of this process."""
        if self._file is not None:
            json.dump((key, row), self._file, allow_nan=False, ensure_ascii=True)
            self._file.write('\n')
            self._file.flush()
