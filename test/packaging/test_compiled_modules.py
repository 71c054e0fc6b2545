# SPDX-License-Identifier: Apache-2.0
"""Compiled modules are used where they were built and fit their sources, and can be switched off."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from trainid_ros.compiled import MODULES, SWITCH

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / 'trainid_ros'
PROGRAM = f'import trainid_ros.{MODULES[0].replace("/", ".")} as module; print(module.__file__)'
built = pytest.mark.skipif(SWITCH in os.environ, reason='the sources were asked for')


def imported(root: Path, **variables: str) -> tuple[Path, str]:
    """Return the file from which another process imports the first compiled module, and what it warns of."""
    env = {name: value for name, value in os.environ.items() if name not in {SWITCH, 'PYTHONPATH'}}
    done = subprocess.run(
        [sys.executable, '-c', PROGRAM],
        cwd=root,
        env=env | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    return Path(done.stdout.strip()), done.stderr


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the repository that holds only the package."""
    shutil.copytree(PACKAGE, tmp_path / 'trainid_ros', symlinks=True)
    shutil.copy(ROOT / 'setup.py', tmp_path)
    return tmp_path


def test_the_list_names_sources_in_order() -> None:
    assert list(MODULES) == sorted(set(MODULES))
    assert all((PACKAGE / f'{name}.py').is_file() for name in MODULES)


@built
def test_compiled_modules_are_used() -> None:
    file, warning = imported(ROOT)
    assert (file.suffix, warning) == ('.so', '')


@built
def test_the_switch_selects_the_sources() -> None:
    file, warning = imported(ROOT, **{SWITCH: '0'})
    assert (file, warning) == (PACKAGE / f'{MODULES[0]}.py', '')


@built
def test_changed_sources_are_used_with_a_warning(copy: Path) -> None:
    changed = copy / 'trainid_ros' / f'{MODULES[-1]}.py'
    text, times = changed.read_text(encoding='utf-8'), changed.stat()
    changed.write_text(f'{text}\n# changed\n', encoding='utf-8')
    os.utime(changed, ns=(times.st_atime_ns, times.st_mtime_ns))
    file, warning = imported(copy)
    assert file == copy / 'trainid_ros' / f'{MODULES[0]}.py'
    assert 'sources differ from their compiled form' in warning
    changed.write_text(text, encoding='utf-8')
    file, warning = imported(copy)
    assert (file.suffix, warning) == ('.so', '')


@built
def test_sources_are_used_where_one_module_was_not_compiled(copy: Path) -> None:
    next((copy / 'trainid_ros').glob(f'{MODULES[-1]}.*.so')).unlink()
    file, warning = imported(copy)
    assert (file, warning) == (copy / 'trainid_ros' / f'{MODULES[0]}.py', '')


def test_sources_are_used_where_nothing_was_compiled(copy: Path) -> None:
    for library in copy.rglob('*.so'):
        library.unlink()
    file, warning = imported(copy)
    assert (file, warning) == (copy / 'trainid_ros' / f'{MODULES[0]}.py', '')
