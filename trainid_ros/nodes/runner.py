# SPDX-License-Identifier: Apache-2.0
"""Spinning nodes until a signal, and leaving without a trace of it."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from trainid_ros.core.errors import InputError
from trainid_ros.nodes.lifecycle import RCLError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from trainid_ros.nodes.lifecycle import ManagedNode


def spin_nodes(nodes: Sequence[ManagedNode], *, until: Callable[[], bool] = lambda: False) -> None:
    """Spin nodes in one thread until SIGINT, SIGTERM or a condition; then deactivate and destroy them.

    Args:
        nodes: The nodes, made in the default context.
        until: Checked after every callback.

    """
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    try:
        while rclpy.ok() and not until():
            executor.spin_once()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        close_nodes(nodes)
        executor.shutdown()
        rclpy.try_shutdown()


def close_nodes(nodes: Sequence[ManagedNode]) -> None:
    """Deactivate what is active and destroy all."""
    for node in nodes:
        if node.state == 'active':
            # A signal has closed the context already, and the transition cannot be announced.
            with contextlib.suppress(RCLError):
                node.trigger_deactivate()
        node.destroy_node()


def start_ros(ros_args: Sequence[str]) -> list[str]:
    """Start ROS with the arguments that follow ``--ros-args``; return them as ROS saw them.

    Raises:
        InputError: ROS cannot use them.

    """
    arguments = ['trainid', '--ros-args', *ros_args]
    try:
        rclpy.init(args=arguments)
    except (RCLError, RuntimeError, ValueError) as error:
        msg = f'ROS does not start: {str(error).splitlines()[0]}'
        raise InputError(msg) from error
    return arguments


def stop_ros() -> None:
    """Stop ROS if a signal has not done so already."""
    rclpy.try_shutdown()


def run_node(make: Callable[[Sequence[str]], ManagedNode]) -> int:
    """Run one node as a program of its own; with the parameter ``autostart`` it activates itself."""
    rclpy.init(args=sys.argv)
    node = make(sys.argv)
    if node.get_parameter('autostart').value:
        node.bring_up()
    spin_nodes([node])
    return 0
