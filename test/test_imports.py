# SPDX-License-Identifier: Apache-2.0
"""The core imports fast and loads neither ROS nor bag nor plot libraries."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import trainid_ros

PACKAGE = Path(trainid_ros.__file__).parent
PURE = (
    'client',
    'interface',
    'inputs',
    'stream',
    'train',
    'estimators',
    'resistance',
    'speed_model',
    'brake_rate',
    'setup',
    'sim',
    'explain',
    'monitor',
)
FOREIGN = ('rclpy', 'rosbags', 'mcap', 'matplotlib', 'trainid_msgs', 'std_msgs')
# The folders of the package, each row built on those above it alone.
LAYERS = (
    ('interface',),
    ('train',),
    ('stream', 'sim'),
    ('estimators', 'inputs'),
    ('resistance',),
    ('speed_model', 'brake_rate', 'explain'),
    ('setup',),
    ('bag', 'monitor'),
    ('inspection', 'fleet', 'ros'),
    ('client',),
    ('report',),
    ('cli',),
)
# Loaded only where needed, not by the core.
SLOW = ('scipy', 'yaml')
# Importing it takes 0.2 s of CPU time on a fast machine.
MAX_MODULES = 150
MAX_CALLS = 120_000


def run(code: str, bytecode: Path | None = None) -> str:
    """Run code in a fresh interpreter with nothing imported; keep its bytecode in a folder."""
    env = {name: value for name, value in os.environ.items() if name != 'PYTHONDONTWRITEBYTECODE'}
    env['PYTHONPYCACHEPREFIX'] = str(bytecode or '')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True, env=env)
    return done.stdout


def modules() -> list[str]:
    inner = (path for folder in PURE for path in sorted((PACKAGE / folder).rglob('*.py')))
    found = {*PACKAGE.glob('*.py'), PACKAGE / 'report' / 'recording.py', *inner}
    parts = (
        path.relative_to(PACKAGE.parent).with_suffix('').parts for path in sorted(found) if path.stem != '__init__'
    )
    return ['.'.join(names) for names in parts]


def test_pure_modules_load_neither_ros_nor_bags_nor_plots() -> None:
    names = modules()
    assert 'trainid_ros.brake_rate.gsma' in names
    code = f'import importlib, sys\nfor n in {names!r}: importlib.import_module(n)\n'
    loaded = run(code + 'print(*{n.split(".")[0] for n in sys.modules})').split()
    assert not set(loaded) & set(FOREIGN)


def name_of(path: Path) -> str:
    """Return the name of a module; that of a package for its ``__init__.py``."""
    return '.'.join(path.relative_to(PACKAGE.parent).with_suffix('').parts).removesuffix('.__init__')


PATHS = {name_of(path): path for path in PACKAGE.rglob('*.py')}
PACKAGES = {name for name, path in PATHS.items() if path.name == '__init__.py'}
FOLDERS = {path.name for path in PACKAGE.iterdir() if any(path.glob('*.py'))}


def imported_modules(name: str, source: str) -> set[str]:
    """Return the modules of the package that a module imports, also within functions and for types only."""
    package, found = name.split('.') if name in PACKAGES else name.split('.')[:-1], set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            origin = '.'.join([*above, *filter(None, [node.module])])
            # A name imported from a package is a module in it, or comes from its file.
            inner = {f'{origin}.{alias.name}' for alias in node.names}
            found |= inner & PATHS.keys() or {origin}
    return found & PATHS.keys()


@cache
def imported() -> dict[str, set[str]]:
    """Return what each module of the package imports; not when tests are collected, as each process does that."""
    return {name: imported_modules(name, path.read_text(encoding='utf-8')) for name, path in PATHS.items()}


def imported_folders(name: str) -> set[str]:
    """Return the folders of the package that a module imports from."""
    return {parts[1] for parts in (other.split('.') for other in imported()[name]) if len(parts) > 1} & FOLDERS


@pytest.mark.parametrize(
    ('name', 'source', 'found'),
    [
        ('trainid_ros.train.line', 'from trainid_ros import cli', 'trainid_ros.cli'),
        ('trainid_ros.train.line', 'from ..bag import reader', 'trainid_ros.bag.reader'),
        ('trainid_ros.train.line', 'from . import forces', 'trainid_ros.train.forces'),
        ('trainid_ros.train', 'from .forces import davis', 'trainid_ros.train.forces'),
        ('trainid_ros.train.forces', 'import trainid_ros.train.effects', 'trainid_ros.train.effects'),
        ('trainid_ros.client.stopping', 'from trainid_ros.client import TrainModel', 'trainid_ros.client'),
        ('trainid_ros.client.stopping', 'def f():\n    from trainid_ros.cli import demo', 'trainid_ros.cli.demo'),
    ],
)
def test_every_form_of_import_is_seen(name: str, source: str, found: str) -> None:
    assert imported_modules(name, source) == {found}


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert 'trainid_ros.ros.diagnostics' in imported()['trainid_ros.ros.estimator_node']
    TopologicalSorter(imported()).prepare()  # a CycleError names the modules


def test_layers_are_all_folders() -> None:
    assert sorted(folder for layer in LAYERS for folder in layer) == sorted(FOLDERS)


@pytest.mark.parametrize('level', range(len(LAYERS)), ids=lambda level: '+'.join(LAYERS[level]))
def test_a_folder_imports_only_from_lower_ones(level: int) -> None:
    lower = {folder for layer in LAYERS[:level] for folder in layer}
    for folder in LAYERS[level]:
        modules = [name for name in PATHS if f'{name}.'.startswith(f'trainid_ros.{folder}.')]
        found = {name: imported_folders(name) - {folder} for name in modules}
        assert not {name: folders - lower for name, folders in found.items() if folders - lower}
        # No more lower than it has to be.
        used = set().union(*found.values())
        assert level == 0 or used & set(LAYERS[level - 1])


def test_the_pipeline_loads_nothing_slow() -> None:
    loaded = run('import sys, trainid_ros.setup.pipelines; print(*{n.split(".")[0] for n in sys.modules})').split()
    assert not set(loaded) & set(SLOW)


def test_the_pipeline_imports_within_its_budget(tmp_path: Path) -> None:
    """Modules and calls of functions beside those of NumPy, from bytecode."""
    code = (
        f'import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n'
        'from calls import count\n'
        'import importlib, numpy\n'
        'before = len(sys.modules)\n'
        'calls = count(lambda: importlib.import_module("trainid_ros.setup.pipelines"))\n'
        'print(len(sys.modules) - before, calls)\n'
    )
    run(code, tmp_path)
    loaded, calls = map(int, run(code, tmp_path).split())
    print(f'trainid_ros.setup.pipelines: {loaded} modules, {calls} calls')
    assert loaded <= MAX_MODULES
    assert calls <= MAX_CALLS
