# SPDX-License-Identifier: Apache-2.0
"""What is said where a package is not installed."""

from __future__ import annotations

import pytest

from trainid_ros.bag import missing_package_error


@pytest.mark.parametrize(
    ('name', 'said'),
    [
        ('rclpy.node', 'this command needs ROS 2, but rclpy is not found: source the setup file of ROS first'),
        ('rosbags', "bags need the Python package rosbags: pip install 'trainid_ros[bags]'"),
    ],
)
def test_a_missing_package_is_named_with_what_installs_it(name: str, said: str) -> None:
    assert str(missing_package_error(ModuleNotFoundError(name=name))) == said


def test_any_other_failed_import_is_an_error_of_ours() -> None:
    error = ModuleNotFoundError(name='nothing_of_this_name')
    with pytest.raises(ModuleNotFoundError) as raised:
        missing_package_error(error)
    assert raised.value is error
