# SPDX-License-Identifier: Apache-2.0
"""Without the optional packages for bags, a command that needs them says so in one line; the others work."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from trainid_ros.bag import PACKAGES
from trainid_ros.interface.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

NEED_BAGS = {
    'replay': ['replay', 'bag', '--train', 'T.yaml'],
    'play': ['play', 'bag'],
    'simulate': ['simulate', 'out', '--train', 'T.yaml'],
    'fit': ['fit', 'bag', '--train', 'T.yaml'],
    'explain': ['explain', 'bag', '--train', 'T.yaml'],
    'info': ['info', 'bag'],
    'import': ['import', 'x.csv', 'out', '--map', 'm.yaml'],
    'demo': ['demo', '--only', 'yizhuang'],
}
HINT = "pip install 'trainid_ros[bags]'"


def trainid(folder: Path, *arguments: str, hidden: frozenset[str] = PACKAGES) -> subprocess.CompletedProcess[str]:
    """Run the command line in a fresh interpreter in which packages cannot be imported."""
    code = (
        'import sys\n'
        f'sys.modules.update(dict.fromkeys({sorted(hidden)!r}))\n'
        'from trainid_ros.cli.main import main\n'
        f'sys.exit(main({list(arguments)!r}))\n'
    )
    return subprocess.run([sys.executable, '-c', code], cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize('verb', NEED_BAGS)
def test_a_command_on_bags_says_what_to_install(verb: str, tmp_path: Path) -> None:
    done = trainid(tmp_path, *NEED_BAGS[verb])
    assert done.returncode == 2
    assert done.stdout == ''
    (line,) = done.stderr.splitlines()
    assert line.startswith('trainid: error: ')
    assert line.endswith(HINT)


@pytest.mark.parametrize('package', sorted(PACKAGES))
def test_each_package_is_named(package: str, tmp_path: Path) -> None:
    verb = 'simulate' if package == 'rosbags' else 'info'  # rosbags writes
    done = trainid(tmp_path, *NEED_BAGS[verb], hidden=frozenset({package}))
    assert done.returncode == 2
    assert done.stderr == f'trainid: error: bags need the Python package {package}: {HINT}\n'


def test_parquet_is_named(driven_bag: Path, tmp_path: Path) -> None:
    (tmp_path / 'x.parquet').touch()
    (tmp_path / 'm.yaml').write_text('{time: {field: t}, speed: {field: v}}', encoding='utf-8')
    train = str(driven_bag / 'train.yaml')
    for arguments in (
        ['import', 'x.parquet', 'out', '--map', 'm.yaml'],
        ['replay', str(driven_bag), '--train', train, '--out', 'e.parquet'],
    ):
        done = trainid(tmp_path, *arguments, hidden=frozenset({'pyarrow'}))
        assert done.returncode == 2
        hint = "pip install 'trainid_ros[tables]'"
        assert done.stderr == f'trainid: error: Parquet needs the Python package pyarrow: {hint}\n'
    assert sorted(path.name for path in tmp_path.iterdir()) == ['m.yaml', 'x.parquet']


@pytest.mark.parametrize('arguments', [('--help',), ('--version',), ('run', '-h'), ('monitor', '-h')], ids=' '.join)
def test_other_commands_work(arguments: tuple[str, ...], tmp_path: Path) -> None:
    assert trainid(tmp_path, *arguments).returncode == 0


@pytest.mark.parametrize('arguments', [('monitor',), ('run', '--train', 'T.yaml')], ids=' '.join)
def test_without_ros_live_commands_say_so(arguments: tuple[str, ...], driven_bag: Path, tmp_path: Path) -> None:
    (tmp_path / 'T.yaml').write_bytes((driven_bag / 'train.yaml').read_bytes())
    done = trainid(tmp_path, *arguments, hidden=frozenset({'rclpy'}))
    hint = 'source the setup file of ROS first'
    assert done.stderr == f'trainid: error: this command needs ROS 2, but rclpy is not found: {hint}\n'
    assert done.returncode == 2
    if 'run' in arguments:  # it gets as far as its train file
        (tmp_path / 'T.yaml').unlink()
        assert 'T.yaml: cannot be read' in trainid(tmp_path, *arguments).stderr


def test_reading_needs_no_rosbags(driven_bag: Path, tmp_path: Path) -> None:
    assert trainid(tmp_path, 'info', str(driven_bag), hidden=frozenset({'rosbags'})).returncode == 0


def test_the_player_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from trainid_ros.ros.playback import BagPlayer  # noqa: PLC0415

    monkeypatch.setitem(sys.modules, 'mcap', None)
    for name in [name for name in sys.modules if name.startswith(('mcap.', 'trainid_ros.bag.'))]:
        monkeypatch.delitem(sys.modules, name)
    node: Any = SimpleNamespace(parameters=SimpleNamespace(value=lambda _: 'bag'))
    with pytest.raises(InputError, match=r'mcap: pip install'):
        BagPlayer.open_timeline(node)
