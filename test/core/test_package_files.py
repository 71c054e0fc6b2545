# SPDX-License-Identifier: Apache-2.0
"""Files that come with the package are found from anywhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainid_ros.core.errors import InputError
from trainid_ros.core.package_files import shared_path


def test_files_of_the_source_tree_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert shared_path('config/trains/yizhuang.yaml').is_file()


def test_what_is_missing_is_named_with_the_places() -> None:
    with pytest.raises(InputError, match=r'config/none: not found \(looked in .*\)'):
        shared_path('config/none')
