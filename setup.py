# SPDX-License-Identifier: Apache-2.0
"""Build of the ament_python package trainid_ros."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'trainid_ros'
# Folders that go to the share directory as they are.
SHARED_FOLDERS = ('bags', 'config', 'launch')


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


setup(
    name=NAME,
    version='0.1.0',
    description='Streaming identification of train resistance, speed model and brake rate',
    license='Apache-2.0',
    maintainer='trainid maintainers',
    maintainer_email='maintainers@trainid.example',
    # By name: build and install folders of a workspace may lie beside the package.
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed'], f'{NAME}.bag': ['msg/*.msg']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *shared_files(),
    ],
    python_requires='>=3.11',
    install_requires=[
        'setuptools',
        'PyYAML',
        'matplotlib',
        'numpy',
        'rich',
        'scipy',
    ],
    extras_require={
        # Reading and writing bags: replay, fit, explain, info, play, simulate, demo. The live nodes need none of it.
        'bags': ['mcap', 'rosbags', 'zstandard'],
        # Compiles the kernels of the estimators; they give the same numbers without it.
        'fast': ['numba'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'trainid = trainid_ros.cli.main:main',
            'resistance_estimator = trainid_ros.ros.resistance_node:main',
            'speed_model_estimator = trainid_ros.ros.speed_model_node:main',
            'brake_rate_estimator = trainid_ros.ros.brake_rate_node:main',
            'train_simulator = trainid_ros.ros.train_simulator:main',
            'bag_player = trainid_ros.ros.bag_player:main',
        ],
    },
)
