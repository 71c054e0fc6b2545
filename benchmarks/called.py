# SPDX-License-Identifier: Apache-2.0
"""A plug-in of pytest that notes which functions of trainid_ros each test calls, and its CPU time."""

from __future__ import annotations

import cProfile
import json
import time
from collections import Counter, defaultdict
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from types import CodeType

_PACKAGE: Final = 'trainid_ros'


@dataclass(frozen=True, slots=True)
class Called:
    """A test, and what it calls; what a fixture calls counts for all tests of the file, which may share it."""

    name: str
    cpu_s: float
    functions: frozenset[tuple[str, int]]  # File and first line of each function


def read_calls(path: Path) -> list[Called]:
    """Read what the plug-in has written."""
    rows = [json.loads(line) for line in path.read_text(encoding='utf-8').splitlines()]
    by_fixtures = defaultdict[str, set[tuple[str, int]]](set)
    cpu_s, called = Counter[str](), defaultdict[str, set[tuple[str, int]]](set)
    for name, phase, seconds, found in rows:
        cpu_s[name] += seconds
        (by_fixtures[_file(name)] if phase == 'setup' else called[name]).update(map(tuple, found))
    return [Called(name, cpu_s[name], frozenset(called[name] | by_fixtures[_file(name)])) for name in cpu_s]


def _file(name: str) -> str:
    return name.partition('::')[0]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that names the file to write."""
    parser.addoption('--called', type=Path, required=True, help='file in which to note what each test calls')


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, None, None]:
    """Note what the fixtures of a test call."""
    with _noted(item, 'setup'):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Note what a test itself calls."""
    with _noted(item, 'call'):
        yield


@contextmanager
def _noted(item: pytest.Item, phase: str) -> Iterator[None]:
    """Write a line on a phase of a test."""
    profile = cProfile.Profile(subcalls=False, builtins=False)
    begin = time.process_time()
    profile.enable()
    try:
        yield
    finally:
        profile.disable()
        codes = (entry.code for entry in profile.getstats())
        found = [place for code in codes if (place := _place(code, item.config.rootpath))]
        line = json.dumps([item.nodeid, phase, time.process_time() - begin, found])
        with item.config.getoption('--called').open('a', encoding='utf-8') as file:
            file.write(line + '\n')


def _place(code: CodeType | str, root: Path) -> tuple[str, int] | None:
    """Return file and first line of a function of the package, None of any other."""
    if isinstance(code, str):  # of an extension
        return None
    path = Path(code.co_filename)
    inside = path.is_relative_to(root / _PACKAGE)
    return (str(path.relative_to(root)), code.co_firstlineno) if inside else None
