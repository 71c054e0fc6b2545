# SPDX-License-Identifier: Apache-2.0
"""Locate files shipped with the package: in the source tree, or in the share directory of an installation."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from trainid_ros.interface.errors import InputError


def shared_path(relative: str) -> Path:
    """Return the path of a file or folder shipped with the package.

    Raises:
        InputError: It is not found in either place.
    """
    places = [Path(__file__).parents[1], *_share()]
    for place in places:
        if (place / relative).exists():
            return place / relative
    raise InputError(f'{relative}: not found (looked in {", ".join(map(str, places))})')


def _share() -> list[Path]:
    if find_spec('ament_index_python') is None:
        return []
    from ament_index_python.packages import (  # noqa: PLC0415
        PackageNotFoundError,
        get_package_share_directory,
    )

    try:
        return [Path(get_package_share_directory('trainid_ros'))]
    except PackageNotFoundError:
        return []
