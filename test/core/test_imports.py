# SPDX-License-Identifier: Apache-2.0
"""The core imports fast and pulls in neither ROS nor bag nor plot libraries."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import trainid_ros

PACKAGE = Path(trainid_ros.__file__).parent
PURE = ('core', 'physics', 'estimators', 'simulation')
FOREIGN = ('rclpy', 'rosbags', 'mcap', 'matplotlib', 'trainid_msgs', 'std_msgs')
MOST_CPU_S = 0.6


def run(code: str) -> str:
    """Run code in a fresh interpreter, where nothing is imported yet."""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout


def modules() -> list[str]:
    found = (path for folder in PURE for path in sorted((PACKAGE / folder).rglob('*.py')))
    parts = (path.relative_to(PACKAGE.parent).with_suffix('').parts for path in found if path.stem != '__init__')
    return ['.'.join(names) for names in parts]


def test_pure_modules_load_neither_ros_nor_bags_nor_plots() -> None:
    names = modules()
    assert 'trainid_ros.estimators.brake_rate.gsma' in names
    code = f'import importlib, sys\nfor n in {names!r}: importlib.import_module(n)\n'
    loaded = run(code + 'print(*{n.split(".")[0] for n in sys.modules})').split()
    assert not set(loaded) & set(FOREIGN)


def test_the_pipeline_imports_within_its_budget() -> None:
    """CPU time, not wall time, and the best of three: other work on the machine must not decide."""
    code = (
        'import time\n'
        'start = time.process_time()\n'
        'import trainid_ros.estimators.pipeline\n'
        'print(time.process_time() - start)\n'
    )
    best = min(float(run(code)) for _ in range(3))
    print(f'trainid_ros.estimators.pipeline: {best:.3f} s of CPU')
    assert best <= MOST_CPU_S
