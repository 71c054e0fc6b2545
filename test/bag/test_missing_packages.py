# SPDX-License-Identifier: Apache-2.0
"""What is said of a package that is not installed."""

from __future__ import annotations

import pytest

from trainid_ros.bag import missing_package_error


def missing(name: str) -> ModuleNotFoundError:
    return ModuleNotFoundError(f'No module named {name!r}', name=name)


@pytest.mark.parametrize(
    ('name', 'said'),
    [
        ('mcap.reader', "bags need the Python package mcap: pip install 'trainid_ros[bags]'"),
        ('pyarrow', "Parquet needs the Python package pyarrow: pip install 'trainid_ros[tables]'"),
        ('rclpy', 'this command needs ROS 2, but rclpy is not found: source the setup file of ROS first'),
    ],
)
def test_a_missing_package_is_named_with_the_remedy(name: str, said: str) -> None:
    assert str(missing_package_error(missing(name))) == said


def test_other_missing_modules_are_no_input_error() -> None:
    with pytest.raises(ModuleNotFoundError, match='numpy'):
        missing_package_error(missing('numpy'))
