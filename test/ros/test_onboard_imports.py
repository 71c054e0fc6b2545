# SPDX-License-Identifier: Apache-2.0
"""The live nodes load only packages that Ubuntu 24.04 and ROS 2 Jazzy offer through apt."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest

from trainid_ros.compiled import SWITCH

ROOT = Path(__file__).resolve().parents[2]
# Python package and the deb that holds it.
UBUNTU = {'numpy': 'python3-numpy', 'scipy': 'python3-scipy', 'yaml': 'python3-yaml', '_yaml': 'python3-yaml'}
# Packages of ROS, in debs such as ros-jazzy-action-msgs.
JAZZY = {
    *('action_msgs', 'ament_index_python', 'builtin_interfaces', 'diagnostic_msgs', 'lifecycle_msgs', 'rcl_interfaces'),
    *('rclpy', 'rosgraph_msgs', 'rosidl_parser', 'rosidl_pycommon', 'rpyutils', 'service_msgs', 'std_msgs', 'std_srvs'),
    *('type_description_interfaces', 'unique_identifier_msgs'),
}
OURS = {'trainid_ros', 'trainid_msgs'}
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
from trainid_ros.setup.pipelines import KINDS, EstimatorSettings
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.train.train_file import load_train_file
file = load_train_file({str(ROOT / 'config/trains/yizhuang.yaml')!r})
pipelines = [kind.pipeline(file, EstimatorSettings()) for kind in KINDS]
for record in simulate(Scenario(file, runs=1), numpy.random.default_rng(1)).records:
    for pipeline in pipelines:
        pipeline.push(record)
assert all(pipeline.used for pipeline in pipelines)
"""


@cache
def loaded(work: str, compiled: str = '0') -> set[str]:
    """Return the third-party packages that code loads in a fresh interpreter, by default with uncompiled modules."""
    command, env = [sys.executable, '-c', CODE.format(work=work)], os.environ | {SWITCH: compiled}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split()) - OURS


@pytest.mark.parametrize('work', [IMPORTS, DRIVE], ids=['imports', 'drive'])
def test_nodes_load_only_packages_from_apt(work: str) -> None:
    found = loaded(work)
    assert {'rclpy', 'numpy'} <= found <= {*UBUNTU, *JAZZY}


def test_compiled_modules_need_only_the_library_of_mypyc_besides() -> None:
    assert loaded(IMPORTS, compiled='1') <= {*UBUNTU, *JAZZY, 'librt', 'mypy_extensions'}


def test_package_xml_names_the_packages_of_ubuntu() -> None:
    named = {item.text for item in ElementTree.parse(ROOT / 'package.xml').iter('exec_depend')}
    assert {UBUNTU[name] for name in loaded(IMPORTS) & set(UBUNTU)} <= named
