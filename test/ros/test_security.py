# SPDX-License-Identifier: Apache-2.0
"""With SROS 2 enforced nothing runs unprotected, whether the keys are missing or what is needed to use them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros
TRAIN = Path(__file__).parents[2] / 'bags' / 'tiny' / 'train.yaml'
NODE = 'import sys; from trainid_ros.ros.estimator_node import resistance_main; sys.exit(resistance_main())'
COMMANDS = {
    'resistance_estimator': ('-c', NODE),
    'run': ('-m', 'trainid_ros.cli.main', 'run', '--train', str(TRAIN)),
    'monitor': ('-m', 'trainid_ros.cli.main', 'monitor'),
}


@pytest.mark.parametrize('has_enclave', [True, False])
@pytest.mark.parametrize('name', COMMANDS)
def test_without_keys_nothing_starts_and_the_last_line_says_why(tmp_path: Path, name: str, has_enclave: bool) -> None:
    folder = tmp_path / 'enclaves' / 'trainid'
    (folder if has_enclave else tmp_path).mkdir(parents=True, exist_ok=True)
    secure = {
        'ROS_SECURITY_KEYSTORE': str(tmp_path),
        'ROS_SECURITY_ENABLE': 'true',
        'ROS_SECURITY_STRATEGY': 'Enforce',
    }
    command = [sys.executable, *COMMANDS[name], '--ros-args', '--enclave', '/trainid']
    done = subprocess.run(command, env=os.environ | secure, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    # Before it, ROS itself may say where it looks for keys, and what it cannot close.
    assert 'ROS cannot start' in done.stderr.splitlines()[-1]
    assert 'Traceback' not in done.stderr
