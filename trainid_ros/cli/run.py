# SPDX-License-Identifier: Apache-2.0
"""``trainid run``: the estimator nodes live, in one process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainid_ros.cli.arguments import LIVE_NODES
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping
    from pathlib import Path


def run(args: argparse.Namespace) -> int:
    """Run the nodes until SIGINT or SIGTERM.

    Raises:
        InputError: The train file, a ROS argument or a parameter cannot be used.
    """
    if args.train is not None:
        mapped_inputs(args.map, load_train_file(args.train))
    elif args.map is not None:
        load_mapping(args.map)
    names = tuple(dict.fromkeys(args.node)) if args.node else LIVE_NODES
    files = {'train_file': args.train, 'mapping_file': args.map}
    return run_live(names, {name: path for name, path in files.items() if path is not None}, args.ros_args)


def run_live(names: tuple[str, ...], files: Mapping[str, Path], ros_args: list[str]) -> int:
    """Configure, activate and spin nodes; return the exit code.

    Args:
        names: Names of the nodes.
        files: Paths by name of the parameter.
        ros_args: Arguments for ROS.
    """
    # ROS is imported only here, so that an invalid train file is reported without it.
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.estimator_node import SPECS, EstimatorNode  # noqa: PLC0415
    from trainid_ros.ros.inputs import SharedInputs  # noqa: PLC0415
    from trainid_ros.ros.node import close_nodes, spin_nodes, start_ros, stop_ros  # noqa: PLC0415

    arguments = start_ros(ros_args)
    overrides = [Parameter(name, value=str(path.absolute())) for name, path in files.items()]
    inputs = SharedInputs()
    nodes = [EstimatorNode(SPECS[name], arguments, inputs, parameter_overrides=overrides) for name in names]
    for node in nodes:
        if not node.bring_up():
            message = f'{node.get_name()}: {node.failure}'
            close_nodes(nodes)
            stop_ros()
            raise InputError(message)
        print(f'{node.get_name()} is active', flush=True)
    spin_nodes(nodes)
    return 0
