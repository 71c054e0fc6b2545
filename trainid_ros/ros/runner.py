# SPDX-License-Identifier: Apache-2.0
"""Spin nodes until a signal, then shut down cleanly.

rclpy's own handlers close the context at once, while callbacks may still run: a publish or a wait then
raises, and nodes can no longer be deactivated. So signals are only recorded here.
"""

from __future__ import annotations

import gc
import signal
import sys
from typing import TYPE_CHECKING, Any, Final

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from trainid_ros.interface.errors import InputError
from trainid_ros.ros.node import ManagedNode, RCLError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.node import Node

# A waiting executor notices a signal only when it returns.
_REACTION_S: Final = 0.2
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


_EXIT_INTERRUPTED: Final = 130


class _StopRequest:
    """Records SIGINT and SIGTERM; a second one interrupts code that did not react to the first.

    While the nodes are closed, and until the process has ended, further ones are ignored.
    """

    def __init__(self) -> None:
        self.requested = False

    def install(self) -> None:
        self.requested = False
        for number in _SIGNALS:
            signal.signal(number, self._note)

    @staticmethod
    def ignore_more() -> None:
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _note(self, _number: int, _frame: Any) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


_STOP: Final = _StopRequest()


def start_ros(ros_args: Sequence[str]) -> list[str]:
    """Start ROS with the arguments that follow ``--ros-args``; return all arguments passed to ROS.

    From then on, SIGINT and SIGTERM only end :func:`spin_nodes`.

    Raises:
        InputError: ROS cannot use the arguments.
    """
    return _start(['trainid', '--ros-args', *ros_args])


def _start(arguments: list[str]) -> list[str]:
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, RuntimeError, ValueError) as error:
        raise InputError(f'ROS cannot start: {str(error).splitlines()[0]}') from error
    _STOP.install()
    return arguments


def stop_ros() -> None:
    """Stop ROS."""
    rclpy.try_shutdown()


def spin_nodes(nodes: Sequence[Node], *, until: Callable[[], bool] = lambda: False) -> None:
    """Spin nodes in one thread until a signal or a condition; then deactivate and destroy them, and stop ROS.

    The process is expected to end after that: it ignores further signals.

    Args:
        nodes: The nodes, created in the default context after :func:`start_ros`.
        until: Checked after every callback.
    """
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    # What exists now stays: without it, a full garbage collection takes tens of milliseconds.
    gc.collect()
    gc.freeze()
    try:
        while not (_STOP.requested or until()):
            executor.spin_once(timeout_sec=_REACTION_S)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        _STOP.ignore_more()
        gc.unfreeze()
        executor.shutdown()
        close_nodes(nodes)
        stop_ros()


def close_nodes(nodes: Sequence[Node]) -> None:
    """Deactivate the active nodes and destroy all."""
    for node in nodes:
        if isinstance(node, ManagedNode) and node.state == 'active' and rclpy.ok():
            node.trigger_deactivate()
        node.destroy_node()


def run_node(make: Callable[[Sequence[str]], ManagedNode]) -> int:
    """Run one node as a stand-alone program; with the parameter ``autostart`` it activates itself."""
    try:
        node = make(_start(list(sys.argv)))
        if node.get_parameter('autostart').value:
            node.bring_up()
    except InputError as error:
        sys.stderr.write(f'{error}\n')
        return 2
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED
    spin_nodes([node])
    return 0
