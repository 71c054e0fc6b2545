# SPDX-License-Identifier: Apache-2.0
"""What setup.py and package.xml promise is there."""

from __future__ import annotations

import ast
import os
import re
import runpy
from importlib.metadata import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tools import setup_env
from tools.setup_env import SHARED, link_shared
from trainid_ros.bag import PACKAGES

ROOT = Path(__file__).resolve().parents[2]


def setup_value(name: str) -> Any:
    """Return a constant of setup.py without running it."""
    for node in ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8')).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == name:
            return ast.literal_eval(node.value)
    raise AssertionError(name)


def test_shared_folders_exist_and_are_those_of_the_set_up() -> None:
    folders = setup_value('SHARED_FOLDERS')
    assert all(any((ROOT / folder).iterdir()) for folder in folders)
    assert {*folders, 'package.xml', 'bags'} == set(SHARED)  # in the source tree, bags too


def test_every_data_file_is_packaged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    given: dict[str, Any] = {}
    monkeypatch.setattr('setuptools.setup', given.update)
    runpy.run_path('setup.py')
    declared: dict[str, list[str]] = given['package_data']
    folders = {name: ROOT / name.replace('.', '/') for name in declared}
    packaged = {path for name, patterns in declared.items() for text in patterns for path in folders[name].glob(text)}
    made = {'.py', '.pyc', '.so', '.sha256'}
    found = {path for path in (ROOT / 'trainid_ros').rglob('*') if path.is_file() and path.suffix not in made}
    assert found <= packaged
    assert ROOT / 'trainid_ros' / 'report' / 'page.html.j2' in packaged


def test_packages_for_bags_are_an_extra() -> None:
    required = metadata('trainid_ros').get_all('Requires-Dist') or []
    always = {line.split()[0].strip(';') for line in required if 'extra ==' not in line}
    bags = {line.partition(';')[0].strip() for line in required if 'extra ==' in line and 'bags' in line}
    assert bags == set(PACKAGES)
    assert not always & PACKAGES


def test_colcon_test_is_told_of_pytest() -> None:
    """It runs pytest only if an extra of this name requires it."""
    required = metadata('trainid_ros').get_all('Requires-Dist') or []
    assert any(re.fullmatch(r'pytest ?; extra == .test.', line) for line in required)


def test_a_former_state_is_taken_back_without_the_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, store = tmp_path / 'trainid_ros', tmp_path / 'store'
    (package / 'folder').mkdir(parents=True)
    store.mkdir()
    runs: list[str] = []

    def compiler(command: list[str | Path], *_: object, **__: object) -> None:
        built = Path(command[-1]) / 'trainid_ros' / 'folder'
        built.mkdir(parents=True)
        text = (package / 'source.py').read_text()
        (built / 'module.cpython-311-x86_64-linux-gnu.so').write_text(text)
        (built.parent / 'modules.sha256').write_text(text)
        runs.append(text)

    for name, value in {'ROOT': tmp_path, 'COMPILED': store, 'run': compiler}.items():
        monkeypatch.setattr(setup_env, name, value)
    for text in ('one', 'two', 'one'):
        (package / 'source.py').write_text(text)
        setup_env.compile_modules(text)
        assert (package / 'modules.sha256').read_text() == text
        assert next(package.rglob('*.so')).read_text() == text
    assert runs == ['one', 'two']


def test_the_set_up_of_the_repository_installs_them() -> None:
    wanted = (ROOT / 'tools' / 'requirements' / 'runtime.in').read_text(encoding='utf-8').split('\n')
    assert set(wanted) >= PACKAGES | {'pyarrow'}


def test_package_xml_needs_nothing_from_pip() -> None:
    names = [item.text or '' for item in ElementTree.parse(ROOT / 'package.xml').iter('exec_depend')]
    assert {'rclpy', 'python3-numpy', 'python3-yaml'} <= set(names)
    assert not [name for name in names if name.endswith('-pip')]


def test_launch_files_are_found_without_following_links_to_folders(tmp_path: Path) -> None:
    """``ros2 launch`` walks through the share folder like this."""
    for name in SHARED:
        link_shared(ROOT / name, tmp_path / name)
    found = {name for _, _, names in os.walk(tmp_path) for name in names}
    assert {path.name for path in (ROOT / 'launch').iterdir() if path.is_file()} <= found
    assert (tmp_path / 'launch' / 'trainid.launch.py').read_text(encoding='utf-8')
