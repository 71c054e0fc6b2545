# SPDX-License-Identifier: Apache-2.0
"""``trainid monitor``: inputs, estimates and diagnostics of running nodes, live in a terminal."""

from __future__ import annotations

import math
import os
import sys
import time
from io import TextIOWrapper
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.live import Live

from trainid_ros.cli.output import EXIT_NO_ANSWER, show
from trainid_ros.monitor.screen import Lines, Screen

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from trainid_ros.ros.train_monitor import TrainMonitor

_SCREEN_S: Final = 0.25
_LINES_S: Final = 1.0
# Time for which ROS may be looking for publishers before the duration begins [s].
_DISCOVERY_S: Final = 3.0
_ASCII_LOCALES: Final = ('C', 'POSIX')


def run(args: argparse.Namespace) -> int:
    """Show what is published until SIGINT or SIGTERM, or for a time; return 1 if nothing was in that time.

    Raises:
        InputError: A ROS argument cannot be used, or ROS is not installed.
    """
    # ROS is imported only here, so that other commands work without it.
    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415
    from trainid_ros.ros.train_monitor import TrainMonitor  # noqa: PLC0415

    node = TrainMonitor(start_ros(args.ros_args), args.namespace)
    # Python replaces this locale by one with Unicode, which terminals that are set to it may lack.
    if os.environ.get('LC_ALL') in _ASCII_LOCALES and isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(encoding='ascii', errors='replace')
    console = Console()
    # Not Console.is_terminal, which FORCE_COLOR makes true for files.
    draws = sys.stdout.isatty() and not console.is_dumb_terminal and not os.environ.get('NO_COLOR')
    if not draws:
        lines = Lines()
        display = Display(_LINES_S, args.duration, lambda: _print(lines, node))
        spin_nodes([node], until=lambda: display.draw_if_due(has_found=bool(node.trains.by_namespace)))
    else:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            display = Display(
                _SCREEN_S, args.duration, lambda: live.update(Screen(node.views(), node.notice), refresh=True)
            )
            spin_nodes([node], until=lambda: display.draw_if_due(has_found=bool(node.trains.by_namespace)))
    return EXIT_NO_ANSWER if display.is_over and not node.trains.has_messages(time.monotonic()) else 0


def _print(lines: Lines, node: TrainMonitor) -> None:
    for line in lines.of(node.views(), node.notice):
        show(line)
    sys.stdout.flush()


class Display:
    """Draws at intervals, for a time that begins when a train is found, or ROS has had time to find one.

    Attributes:
        is_over: True if it ended because the time was over.
    """

    def __init__(
        self, every_s: float, duration_s: float, draw: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.is_over = False
        self._every_s = every_s
        self._duration_s = duration_s or math.inf
        self._draw = draw
        self._clock = clock
        self._next_s = clock()
        self._begin_s = self._next_s + _DISCOVERY_S

    def draw_if_due(self, *, has_found: bool) -> bool:
        """Draw if it is time, and take in whether a train is found; return True at the end."""
        now_s = self._clock()
        if now_s >= self._next_s:
            self._next_s = now_s + self._every_s
            self._draw()
        if has_found:
            self._begin_s = min(self._begin_s, now_s)
        self.is_over = now_s - self._begin_s >= self._duration_s
        return self.is_over
