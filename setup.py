# SPDX-License-Identifier: Apache-2.0
"""Build of the ament_python package trainid_ros."""

from __future__ import annotations

import os
import runpy
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = 'trainid_ros'
# Folders that go to the share directory as they are; the bags stay in the source tree.
SHARED_FOLDERS = ('config', 'launch')
# Commands that build; others, which only read metadata, must not wait for a compiler.
BUILDING = {'build', 'build_ext', 'bdist_wheel', 'develop', 'editable_wheel', 'install'}


def say(text: str) -> None:
    """Write what takes long to standard error, which colcon shows."""
    sys.stderr.write(f'{NAME}: {text}\n')


def shared_files() -> list[tuple[str, list[str]]]:
    """List the files of the shared folders by their place under the share directory."""
    root = Path(__file__).parent
    groups: dict[str, list[str]] = defaultdict(list)
    for folder in SHARED_FOLDERS:
        for path in sorted((root / folder).rglob('*')):
            if path.is_file() and '__pycache__' not in path.parts:
                relative = path.relative_to(root)
                groups[f'share/{NAME}/{relative.parent}'].append(str(relative))
    return list(groups.items())


def check_messages() -> None:
    """End with what to do if colcon builds this package, and the messages are neither built nor installed."""
    prefixes = [path for path in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if path]
    is_colcon = not {'--record', '--editable'}.isdisjoint(sys.argv)  # without and with --symlink-install
    if is_colcon and prefixes and not any((Path(path) / 'share' / 'trainid_msgs').is_dir() for path in prefixes):
        sys.exit(
            f'{NAME}: trainid_msgs is not built. It lies in msg_defs, inside this package, where colcon does not look. '
            f'In src of the workspace: ln -s {Path(__file__).resolve().parent}/msg_defs trainid_msgs'
        )


class BuildModules(build_ext):
    """Compiles on all cores, then states beside the library what it was made of."""

    def build_extensions(self) -> None:
        """Build all extensions; the files of one are compiled side by side."""
        self.parallel = self.parallel or True
        compile_some = self.compiler.compile

        def compile_all(sources: list[str], **options: Any) -> list[str]:
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                objects = pool.map(lambda source: compile_some([source], **options), sources)
                return [name for names in objects for name in names]

        self.compiler.compile = compile_all
        super().build_extensions()

    def run(self) -> None:
        """Build all extensions."""
        if self.extensions:
            say(f'compiling {len(self.extensions) - 1} modules on {os.cpu_count()} cores, which takes a minute or two')
        super().run()
        if self.extensions:
            compiled = runpy.run_path(f'{NAME}/compiled.py')
            folder = Path('.' if self.inplace else self.build_lib) / NAME
            (folder / compiled['DIGEST']).write_text(compiled['digest'](Path(NAME)), encoding='utf-8')


def has_mypyc() -> bool:
    """Return whether modules can be compiled; without mypyc the same modules run as they are."""
    return os.environ.get('TRAINID_COMPILED') != '0' and find_spec('mypyc') is not None


def compiled_modules() -> list[Extension]:
    """Return the modules to compile."""
    if not (has_mypyc() and BUILDING.intersection(sys.argv)):
        return []
    from mypyc.build import mypycify  # noqa: PLC0415 - optional

    # No fused multiply-add: compiled modules give the same numbers as their sources, on every processor.
    os.environ['CFLAGS'] = f'{os.environ.get("CFLAGS", "")} -ffp-contract=off'
    names = runpy.run_path(f'{NAME}/compiled.py')['MODULES']
    paths = [f'{NAME}/{name}.py' for name in names]
    say(f'translating {len(paths)} modules to C, which takes half a minute (TRAINID_COMPILED=0 does without)')
    extensions: list[Extension] = mypycify(
        paths, opt_level='2', debug_level='0', multi_file=True, group_name=f'{NAME}.modules'
    )
    # A group in a package has its header there.
    for extension in extensions:
        extension.include_dirs.append(f'build/{NAME}')
    return extensions


check_messages()
setup(
    name=NAME,
    version='0.1.0',
    description='Streaming identification of train resistance, speed model and brake rate',
    license='Apache-2.0',
    maintainer='trainid maintainers',
    maintainer_email='maintainers@trainid.example',
    # By name: build and install folders of a workspace may lie beside the package.
    cmdclass={'build_ext': BuildModules},
    ext_modules=compiled_modules(),
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed'], f'{NAME}.bag': ['msg/*.msg'], f'{NAME}.report': ['*.html.j2']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *shared_files(),
    ],
    python_requires='>=3.11',
    install_requires=[
        'setuptools',
        'Jinja2',
        'PyYAML',
        'matplotlib',
        'numpy',
        'rich',
        'scipy',
        # The run-time library of compiled modules.
        *(['librt>=0.16', 'mypy_extensions'] if has_mypyc() else []),
    ],
    extras_require={
        # Reading and writing bags: replay, fit, explain, info, play, simulate, demo. The live nodes need none of it.
        'bags': ['mcap', 'rosbags', 'zstandard'],
        # Parquet files in and out.
        'tables': ['pyarrow'],
        # trainid fleet --scheduler.
        'fleet': ['distributed'],
        # trainid view.
        'view': ['rerun-sdk'],
        # colcon test takes pytest if an extra of this name asks for it.
        'test': ['hypothesis', 'pytest', 'pytest-timeout', 'pytest-xdist'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'trainid = trainid_ros.cli.main:main',
            'resistance_estimator = trainid_ros.ros.estimator_node:resistance_main',
            'speed_model_estimator = trainid_ros.ros.estimator_node:speed_model_main',
            'brake_rate_estimator = trainid_ros.ros.estimator_node:brake_rate_main',
            'train_simulator = trainid_ros.ros.playback:train_simulator_main',
            'bag_player = trainid_ros.ros.playback:bag_player_main',
        ],
    },
)
