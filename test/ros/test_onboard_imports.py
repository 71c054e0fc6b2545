# SPDX-License-Identifier: Apache-2.0
"""The live nodes load only packages that Ubuntu 24.04 and ROS 2 Jazzy offer through apt."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

from trainid_ros.compiled import SWITCH

ROOT = Path(__file__).resolve().parents[2]
# Python package and the deb that holds it.
UBUNTU = {
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'yaml': 'python3-yaml',
    '_yaml': 'python3-yaml',
}
JAZZY = {
    'action_msgs': 'ros-jazzy-action-msgs',
    'ament_index_python': 'ros-jazzy-ament-index-python',
    'builtin_interfaces': 'ros-jazzy-builtin-interfaces',
    'diagnostic_msgs': 'ros-jazzy-diagnostic-msgs',
    'lifecycle_msgs': 'ros-jazzy-lifecycle-msgs',
    'rcl_interfaces': 'ros-jazzy-rcl-interfaces',
    'rclpy': 'ros-jazzy-rclpy',
    'rosgraph_msgs': 'ros-jazzy-rosgraph-msgs',
    'rosidl_parser': 'ros-jazzy-rosidl-parser',
    'rosidl_pycommon': 'ros-jazzy-rosidl-pycommon',
    'rpyutils': 'ros-jazzy-rpyutils',
    'service_msgs': 'ros-jazzy-service-msgs',
    'std_msgs': 'ros-jazzy-std-msgs',
    'std_srvs': 'ros-jazzy-std-srvs',
    'type_description_interfaces': 'ros-jazzy-type-description-interfaces',
    'unique_identifier_msgs': 'ros-jazzy-unique-identifier-msgs',
}
OURS = {'trainid_ros', 'trainid_msgs'}
NEVER = {'rosbags', 'mcap', 'zstandard', 'matplotlib'}
# Modules without a specification are made by compiled extensions and belong to no package.
CODE = """
import sys
before = set(sys.modules)
{work}
found = {{name.partition('.')[0] for name in set(sys.modules) - before}}
found = {{name for name in found if getattr(sys.modules.get(name), '__spec__', None) is not None}}
print(*sorted(name for name in found - set(sys.stdlib_module_names) if not name.startswith('_sysconfigdata')))
"""
IMPORTS = 'import trainid_ros.ros.estimator_node'
# A run from stop to stop through the pipelines of all three nodes.
DRIVE = f"""
{IMPORTS}
import numpy
from trainid_ros.setup.pipelines import EstimatorSettings
from trainid_ros.setup.pipelines import KINDS
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import load_train_file
file = load_train_file({str(ROOT / 'config/trains/yizhuang.yaml')!r})
pipelines = [kind.pipeline(file, EstimatorSettings()) for kind in KINDS]
for record in simulate(Scenario(file, runs=1), numpy.random.default_rng(1)).records:
    for pipeline in pipelines:
        pipeline.push(record)
assert all(pipeline.used for pipeline in pipelines)
"""


def loaded(work: str, compiled: str = '0') -> set[str]:
    """Return the third-party packages that code loads in a fresh interpreter, by default with uncompiled modules."""
    command, env = [sys.executable, '-c', CODE.format(work=work)], os.environ | {SWITCH: compiled}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split()) - OURS


def test_nodes_import_only_packages_from_apt() -> None:
    found = loaded(IMPORTS)
    assert {'rclpy', 'numpy'} <= found
    assert not found & NEVER
    assert found <= {*UBUNTU, *JAZZY}


def test_driving_loads_nothing_more() -> None:
    found = loaded(DRIVE)
    assert not found & NEVER
    assert found <= {*UBUNTU, *JAZZY}


def test_compiled_modules_need_only_the_library_of_mypyc_besides() -> None:
    assert loaded(IMPORTS, compiled='1') <= {*UBUNTU, *JAZZY, 'librt', 'mypy_extensions'}


def test_package_xml_names_the_packages_of_ubuntu() -> None:
    named = {item.text for item in ElementTree.parse(ROOT / 'package.xml').iter('exec_depend')}
    assert {UBUNTU[name] for name in loaded(IMPORTS) & set(UBUNTU)} <= named
