# SPDX-License-Identifier: Apache-2.0
"""A plug-in of pytest that notes which functions of trainid_ros each test calls, and its CPU time."""

from __future__ import annotations

import cProfile
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Generator
    from types import CodeType

_PACKAGE: Final = 'trainid_ros'


@dataclass(frozen=True, slots=True)
class Called:
    """A test, and what it calls."""

    name: str
    cpu_s: float
    functions: frozenset[tuple[str, int]]  # File and first line of each function

    @property
    def file(self) -> str:
        """The file of the test."""
        return self.name.partition('::')[0]


def read_calls(path: Path) -> list[Called]:
    """Read what the plug-in has written."""
    rows = map(json.loads, path.read_text(encoding='utf-8').splitlines())
    return [Called(name, cpu_s, frozenset(map(tuple, found))) for name, cpu_s, found in rows]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that names the file to write."""
    parser.addoption('--called', type=Path, required=True, help='file in which to note what each test calls')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test, and write a line on it."""
    profile = cProfile.Profile(subcalls=False, builtins=False)
    begin = time.process_time()
    profile.enable()
    try:
        return (yield)
    finally:
        profile.disable()
        codes = (entry.code for entry in profile.getstats())
        found = [place for code in codes if (place := _place(code, item.config.rootpath))]
        line = json.dumps([item.nodeid, time.process_time() - begin, found])
        with item.config.getoption('--called').open('a', encoding='utf-8') as file:
            file.write(line + '\n')


def _place(code: CodeType | str, root: Path) -> tuple[str, int] | None:
    """Return file and first line of a function of the package, None of any other."""
    if isinstance(code, str):  # of an extension
        return None
    path = Path(code.co_filename)
    inside = path.is_relative_to(root / _PACKAGE)
    return (str(path.relative_to(root)), code.co_firstlineno) if inside else None
