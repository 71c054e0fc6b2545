# SPDX-License-Identifier: Apache-2.0
"""Files shipped with the package are found from any working directory."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.interface.errors import InputError
from trainid_ros.interface.files import shared_path


def test_files_of_the_source_tree_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert shared_path('config/trains/yizhuang.yaml').is_file()


def test_a_missing_file_is_named_with_the_places_searched() -> None:
    with pytest.raises(InputError, match=r'config/none: not found \(looked in .*\)'):
        shared_path('config/none')
