# SPDX-License-Identifier: Apache-2.0
"""Files shipped with the package, and files written as a whole: a killed run never leaves half of one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from trainid_ros.interface.errors import InputError


def shared_path(relative: str) -> Path:
    """Return a file or folder of the package, in the source tree or the share directory; InputError without it."""
    places = [Path(__file__).parents[2]]
    with suppress(ImportError, KeyError):  # without ROS, or not installed there
        from ament_index_python.packages import get_package_share_directory  # noqa: PLC0415

        places.append(Path(get_package_share_directory('trainid_ros')))
    for place in places:
        if (place / relative).exists():
            return place / relative
    raise InputError(f'{relative}: not found (looked in {", ".join(map(str, places))})')


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let a function write another file, and rename that; InputError if it cannot be written."""
    part = path.with_name(f'{path.name}.part')
    try:
        write(part)
        part.replace(path)
    except OSError as error:
        with suppress(OSError):  # half a file
            part.unlink(missing_ok=True)
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None


@contextmanager
def new_place(path: Path) -> Iterator[Path]:
    """Yield a place beside a path, and move what is there to the path once it is complete; InputError if it exists."""
    if path.exists() or path.is_symlink():
        raise InputError(f'{path}: exists already and is not overwritten')
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f'.{path.name}.', dir=path.parent) as folder:
        yield Path(folder) / path.name
        (Path(folder) / path.name).rename(path)


def write_text(text: str, path: str | Path) -> None:
    """Write a text and create missing folders; InputError if it cannot be written."""
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Names of files may hold bytes that are no text.
        target.write_text(text, encoding='utf-8', errors='backslashreplace')
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror})') from None
