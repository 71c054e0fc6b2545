# SPDX-License-Identifier: Apache-2.0
"""Files shipped with the package are found from any working directory; files are written as a whole."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import shared_path, write_whole


def test_files_of_the_source_tree_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert shared_path('config/trains/yizhuang.yaml').is_file()


def test_a_missing_file_is_named_with_the_places_searched() -> None:
    with pytest.raises(InputError, match=r'config/none: not found \(looked in .*\)'):
        shared_path('config/none')


def test_a_full_disk_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / 'table.csv'
    path.write_text('old', encoding='utf-8')

    def write(part: Path) -> None:
        part.write_text('half of', encoding='utf-8')
        raise OSError(errno.ENOSPC, 'No space left on device')

    with pytest.raises(InputError, match=r'table.csv: cannot be written \(No space left on device\)'):
        write_whole(path, write)
    assert [item.name for item in tmp_path.iterdir()] == ['table.csv']
    assert path.read_text(encoding='utf-8') == 'old'


def test_a_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match=r'x\.csv: cannot be written'):
        write_whole(tmp_path / 'file' / 'x.csv', lambda part: part.write_bytes(b'x'))
