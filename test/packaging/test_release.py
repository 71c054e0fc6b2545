# SPDX-License-Identifier: Apache-2.0
"""What a ROS distribution asks of a package: licence headers, valid package.xml, one version, messages found."""

from __future__ import annotations

import re
import runpy
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from trainid_ros import __version__

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (ROOT, ROOT / 'msg_defs')
# Packages of Python that rosdep does not know, or from pip, for which bloom names a package that apt lacks.
WITHOUT_KEY = {'python3-mcap', 'python3-rosbags', 'python3-rosbags-pip', 'python3-zstandard', 'python3-rerun-sdk'}


def sources() -> list[Path]:
    """Return the files in git that have comments."""
    names = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    kinds = {'.py', '.sh', '.cmake', '.cpp', '.hpp', '.service'}
    return [ROOT / name for name in names.split('\0') if Path(name).suffix in kinds]


@pytest.mark.skipif(not (ROOT / '.git').exists(), reason='not a git repository')
def test_every_source_states_its_licence() -> None:
    found = sources()
    assert len(found) > 300
    lacking = [path for path in found if path.is_file() and 'SPDX-License-Identifier' not in path.read_text()[:200]]
    assert not [path for path in lacking if path.stat().st_size]


@pytest.mark.parametrize('folder', PACKAGES, ids=lambda folder: folder.name)
def test_package_xml_is_valid(folder: Path) -> None:
    package = pytest.importorskip('catkin_pkg.package')
    warnings: list[str] = []
    found = package.parse_package(str(folder), warnings=warnings)
    found.validate(warnings=warnings)
    assert not warnings
    assert {item.type for item in found.urls} == {'website', 'bugtracker', 'repository'}
    assert found.licenses == ['Apache-2.0']
    assert not WITHOUT_KEY & {item.name for item in (*found.exec_depends, *found.test_depends)}


def test_there_is_one_version() -> None:
    texts = [(folder / 'package.xml').read_text(encoding='utf-8') for folder in PACKAGES]
    found = {re.findall(r'<version>(\d+\.\d+\.\d+)</version>', text)[0] for text in texts}
    assert found == {__version__, version('trainid_ros')}
    assert f"version='{__version__}'" in (ROOT / 'setup.py').read_text(encoding='utf-8')


@pytest.mark.filterwarnings('ignore::DeprecationWarning')  # of catkin_pkg itself
def test_bloom_finds_the_entries_of_a_version(tmp_path: Path) -> None:
    changelog = pytest.importorskip('catkin_pkg.changelog')
    text = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')
    text = re.sub(r'^Forthcoming\n-+$', f'{__version__} (2026-12-01)\n------------------', text, flags=re.MULTILINE)
    (tmp_path / 'CHANGELOG.rst').write_text(text, encoding='utf-8')
    found = changelog.get_changelog_from_path(str(tmp_path)).get_content_of_version(__version__)
    assert len(found[0].bullets) == len(re.findall(r'^\* ', text, re.MULTILINE))


@pytest.mark.parametrize('option', ['--record', '--editable'])
def test_colcon_says_how_it_finds_the_messages(option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    given: dict[str, object] = {}
    monkeypatch.setattr('setuptools.setup', given.update)
    monkeypatch.setattr('sys.argv', ['setup.py', 'egg_info', option])
    with pytest.raises(SystemExit, match=f'ln -s {ROOT}/msg_defs trainid_msgs'):
        runpy.run_path('setup.py')
    (tmp_path / 'share' / 'trainid_msgs').mkdir(parents=True)
    runpy.run_path('setup.py')
    assert given['name'] == 'trainid_ros'
