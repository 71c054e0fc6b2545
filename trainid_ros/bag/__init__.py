# SPDX-License-Identifier: Apache-2.0
"""Read and write rosbag2 bags (MCAP) without ROS."""

from __future__ import annotations

from typing import Final

from trainid_ros.interface.errors import InputError

PACKAGES: Final = frozenset({'rosbags', 'mcap', 'zstandard'})
"""Python packages of the extra ``trainid_ros[bags]``; the live nodes need none of them."""
_OTHERS: Final = {
    'pyarrow': ('Parquet needs', 'tables'),
    'distributed': ('a scheduler needs', 'fleet'),
    'rerun': ('the viewer needs', 'view'),
}
"""Packages of other extras: what needs it, and the extra."""
_ROS: Final = frozenset({'rclpy', 'trainid_msgs', 'diagnostic_msgs', 'rosgraph_msgs', 'builtin_interfaces'})
"""Python packages of ROS, which live commands need."""


def missing_package_error(error: ModuleNotFoundError) -> InputError:
    """Return the error to report instead of a failed import of an extra; raises that of another module."""
    package = (error.name or '').partition('.')[0]
    if package in _ROS:
        return InputError(f'this command needs ROS 2, but {package} is not found: source the setup file of ROS first')
    if package not in PACKAGES and package not in _OTHERS:
        raise error
    need, extra = _OTHERS.get(package, ('bags need', 'bags'))
    return InputError(f"{need} the Python package {package}: pip install 'trainid_ros[{extra}]'")
