# SPDX-License-Identifier: Apache-2.0
"""Algorithms of other distributions: found by name, never read for a built-in one, and not needed."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest

import trainid_ros
from trainid_ros.bag.writer import BagWriter
from trainid_ros.estimators import algorithm_registry
from trainid_ros.estimators.algorithm_registry import Algorithm, Algorithms
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S, Record
from trainid_ros.resistance.vmils import VMils
from trainid_ros.setup.params_file import parameter_file
from trainid_ros.setup.pipelines import KINDS, chosen_algorithms

PACKAGE = Path(trainid_ros.__file__).parent
METRO = PACKAGE.parent / 'config' / 'trains' / 'yizhuang.yaml'
JOB = 'wheel_wear'
PRELUDE = """
import importlib.metadata, sys
read = importlib.metadata.entry_points
importlib.metadata.entry_points = lambda **wanted: read(**(wanted | {'group': 'none'}))
sys.modules['trainid_lab'] = None  # an import of it fails
"""
FOUND = """
from trainid_ros.estimators.algorithm_registry import Algorithm
from trainid_ros.estimators.settings import VMilsConfig
from trainid_ros.resistance.vmils import VMils
ALGORITHMS = (Algorithm('NAME', 'a plug-in', VMilsConfig(), lambda train, config, _: VMils(train, config)),)
"""

Install = Callable[..., None]


def built_in() -> Algorithms[Any]:
    made: Algorithm[Any] = Algorithm('known', '', VMilsConfig(), lambda train, config, _: VMils(train, config))
    return Algorithms(JOB, made)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that installs a distribution with one module and one entry point."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(name: str, code: str, job: str = JOB) -> None:
        module = f'plug_in_{name}'
        monkeypatch.delitem(sys.modules, module, raising=False)
        (tmp_path / f'{module}.py').write_text(code, encoding='utf-8')
        info = tmp_path / f'{name}-1.dist-info'
        info.mkdir()
        (info / 'METADATA').write_text(f'Metadata-Version: 2.1\nName: {name}\nVersion: 1\n', encoding='utf-8')
        text = f'[trainid_ros.algorithms]\n{job} = {module}:ALGORITHMS\n'
        (info / 'entry_points.txt').write_text(text, encoding='utf-8')

    return make


def test_an_algorithm_of_a_plug_in_is_found_by_name(install: Install) -> None:
    install('good', FOUND.replace('NAME', 'new'))
    algorithms = built_in()
    assert 'new' in algorithms
    assert algorithms.choose('new', hop=3).algorithm == 'new'
    assert algorithms.names == ('known', 'new')
    assert (algorithms.built_in, algorithms.default) == (('known',), 'known')
    with pytest.raises(InputError, match=r"^algorithm = 'nonsense' must be one of known, new$"):
        algorithms['nonsense']


@pytest.mark.parametrize(
    ('code', 'reason'),
    [
        ('import no_such_module', "cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'"),
        ('1 / 0', 'cannot be loaded: ZeroDivisionError: division by zero'),
        ('', "cannot be loaded: AttributeError: module 'plug_in_bad' has no attribute 'ALGORITHMS'"),
        ('ALGORITHMS = ["new"]', 'must be a tuple of Algorithm, not list'),
        (FOUND.replace('NAME', 'known'), ": there are two algorithms 'known'"),
    ],
)
def test_a_broken_plug_in_is_named_once_another_name_is_wanted(install: Install, code: str, reason: str) -> None:
    install('bad', code)
    algorithms = built_in()
    assert algorithms['known'].name == 'known'
    for wanted in ('new', 'nonsense'):
        with pytest.raises(InputError) as caught:
            algorithms[wanted]
        assert str(caught.value).startswith(f'plug-in bad ({JOB} = plug_in_bad:ALGORITHMS)')
        assert str(caught.value).endswith(reason)


@pytest.mark.parametrize('given', ['known', 'twice'])
def test_only_a_name_that_two_plug_ins_have_cannot_be_used(install: Install, given: str) -> None:
    install('good', FOUND.replace('NAME', 'twice').replace(',)', ", Algorithm('new', '', VMilsConfig(), VMils))"))
    install('bad', FOUND.replace('NAME', given))
    algorithms = built_in()
    assert set(algorithms.names) == {'known', 'twice', 'new'} - ({given} - {'known'})
    assert f'there are two algorithms {given!r}' in algorithms.problem


def test_a_broken_plug_in_does_not_hide_the_algorithms_of_others(
    install: Install, request: pytest.FixtureRequest
) -> None:
    install('bad', '1 / 0', 'resistance')
    install('good', FOUND.replace('NAME', 'new'), 'speed_model')
    forget_plug_ins()
    request.addfinalizer(forget_plug_ins)
    assert chosen_algorithms(['new']) == {'speed_model': 'new'}
    for wanted in ('nonsense', 'resistance=new'):
        with pytest.raises(InputError, match=r'^plug-in bad \(resistance = plug_in_bad:ALGORITHMS\) cannot be loaded'):
            chosen_algorithms([wanted])
    install('worse', '1 / 0', 'speed_model')
    forget_plug_ins()
    assert chosen_algorithms(['new']) == {'speed_model': 'new'}


def test_without_plug_ins_the_built_in_names_are_listed_and_where_others_come_from() -> None:
    with pytest.raises(InputError, match=r"^algorithm = 'KF' must be one of known; others come with research/lab$"):
        built_in()['KF']


def forget_plug_ins() -> None:
    for kind in KINDS:
        vars(kind.algorithms).pop('_plug_ins', None)


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every reading of plug-ins fail."""

    def fail(kind: str) -> NoReturn:
        pytest.fail(f'plug-ins for {kind} are read')

    monkeypatch.setattr(algorithm_registry, 'plugged_in', fail)
    forget_plug_ins()


@pytest.mark.usefixtures('unread')
def test_built_in_algorithms_and_the_parameter_file_need_no_plug_in() -> None:
    for kind in KINDS:
        for name in kind.algorithms.built_in:
            assert chosen_algorithms([name]) == {kind.name: name}
            assert kind.algorithms.choose(name).algorithm == name
    assert 'V-MILS' in parameter_file()


def imported(path: Path) -> set[str]:
    """Return the packages that a file imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split('.')[0])
    return found


def test_the_package_does_not_import_the_laboratory() -> None:
    files = set(PACKAGE.rglob('*.py'))
    assert [path for path in sorted(files) if 'trainid_lab' in imported(path)] == []


@pytest.fixture(scope='module')
def minute(tmp_path_factory: pytest.TempPathFactory, day: tuple[Record, ...]) -> Path:
    path = tmp_path_factory.mktemp('minute') / 'bag'
    with BagWriter(path) as writer:
        for record in day:
            if record.stamp_ns < day[0].stamp_ns + 60 * NS_PER_S:
                writer.write_record(record)
    return path


def replay(bag: Path, *options: str, prelude: str = PRELUDE) -> subprocess.CompletedProcess[str]:
    """Run ``trainid replay`` in a fresh interpreter, without research/lab unless the prelude is replaced."""
    command = ['trainid', 'replay', str(bag), '--train', str(METRO), *options]
    code = f'{prelude}\nimport sys\nfrom trainid_ros.cli.main import main\nsys.argv = {command!r}\nstatus = main()\n'
    code += "assert not sys.modules.get('trainid_lab')\nsys.exit(status)\n"
    return subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize('prelude', [PRELUDE, ''], ids=['without lab', 'with lab'])
def test_replay_of_built_in_algorithms_neither_needs_nor_loads_the_laboratory(minute: Path, prelude: str) -> None:
    done = replay(minute, '--json', '--algorithm', 'V-MILS', prelude=prelude)
    assert done.returncode == 0, done.stderr
    assert '"resistance": "V-MILS"' in done.stdout


@pytest.mark.parametrize('wanted', ['KF', 'brake_rate=KF'])
def test_without_the_laboratory_its_names_are_rejected_with_the_built_in_ones(minute: Path, wanted: str) -> None:
    done = replay(minute, '--algorithm', wanted)
    assert done.returncode != 0
    assert "algorithm 'KF' is unknown; there are " in done.stderr
    assert 'brake_rate: GSMA; others come with research/lab' in ' '.join(done.stderr.split())
