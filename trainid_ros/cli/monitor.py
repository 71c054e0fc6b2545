# SPDX-License-Identifier: Apache-2.0
"""``trainid monitor``: inputs, estimates and diagnostics of running nodes, live in a terminal."""

from __future__ import annotations

import os
import sys
import time
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.live import Live

from trainid_ros.cli.output import EXIT_NO_ANSWER, show
from trainid_ros.monitor.lines import Lines
from trainid_ros.monitor.screen import Screen

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from trainid_ros.ros.train_monitor import TrainMonitor

_SCREEN_S: Final = 0.25
_LINES_S: Final = 1.0


def run(args: argparse.Namespace) -> int:
    """Show what is published until SIGINT or SIGTERM, or for a time; return 1 if nothing was in that time.

    Raises:
        InputError: A ROS argument cannot be used, or ROS is not installed.

    """
    # ROS is imported only here, so that other commands work without it.
    from trainid_ros.ros.runner import spin_nodes, start_ros  # noqa: PLC0415
    from trainid_ros.ros.train_monitor import TrainMonitor  # noqa: PLC0415

    node = TrainMonitor(start_ros(args.ros_args), args.namespace)
    console = Console()
    draws = console.is_terminal and not console.is_dumb_terminal and not os.environ.get('NO_COLOR')
    if not draws:
        lines = Lines()
        display = _Display(_LINES_S, args.duration, lambda: _print(lines, node))
        spin_nodes([node], until=display.is_done)
    else:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            display = _Display(
                _SCREEN_S, args.duration, lambda: live.update(Screen(node.views(), node.notice), refresh=True)
            )
            spin_nodes([node], until=display.is_done)
    return EXIT_NO_ANSWER if display.is_over and not node.trains.by_namespace else 0


def _print(lines: Lines, node: TrainMonitor) -> None:
    for line in lines.of(node.views(), node.notice):
        show(line)
    sys.stdout.flush()


class _Display:
    """Draws at intervals, for a time.

    Attributes:
        is_over: True if it ended because the time was over.

    """

    def __init__(self, every_s: float, duration_s: float, draw: Callable[[], None]) -> None:
        self.is_over = False
        self._every_s = every_s
        self._draw = draw
        self._next_s = time.monotonic()
        self._end_s = self._next_s + duration_s if duration_s else float('inf')

    def is_done(self) -> bool:
        """Draw if it is time; return True at the end."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + self._every_s
            self._draw()
        self.is_over = now_s >= self._end_s
        return self.is_over
