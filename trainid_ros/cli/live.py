# SPDX-License-Identifier: Apache-2.0
"""``trainid run``, ``play`` and ``monitor``: the verbs on a ROS graph, which import ROS when they run."""

from __future__ import annotations

import math
import os
import sys
import time
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.cli.arguments import LIVE_NODES
from trainid_ros.cli.output import EXIT_NO_ANSWER, progress, show
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from trainid_ros.monitor.screen import Lines
    from trainid_ros.ros.node import ManagedNode
    from trainid_ros.ros.playback import BagPlayer
    from trainid_ros.ros.train_monitor import TrainMonitor


def run_nodes(args: argparse.Namespace) -> int:
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
    # ROS is imported only here, so that an invalid train file is reported without it.
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.estimator_node import SPECS, EstimatorNode  # noqa: PLC0415
    from trainid_ros.ros.inputs import SharedInputs  # noqa: PLC0415
    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415

    arguments = start_ros(args.ros_args)
    overrides = [Parameter(name, value=str(path.absolute())) for name, path in files.items() if path is not None]
    inputs = SharedInputs()
    nodes = [EstimatorNode(SPECS[name], arguments, inputs, parameter_overrides=overrides) for name in names]
    for node in nodes:
        if not node.bring_up():
            raise _refused(f'{node.get_name()}: {node.failure}', nodes)
        print(f'{node.get_name()} is active', flush=True)
    spin_nodes(nodes)
    return 0


def play(args: argparse.Namespace) -> int:
    """Play a bag to its end or until SIGINT or SIGTERM.

    Raises:
        InputError: The bag or a ROS argument cannot be used.
    """
    # Imported here because the other verbs run without libraries for bags.
    from trainid_ros.cli.bags import opened  # noqa: PLC0415

    mapping = OWN if args.map is None else load_mapping(args.map)
    with opened(args, mapping=mapping):
        pass  # an unreadable bag is reported before ROS starts
    # ROS is imported only here, so that other commands work without it.
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415
    from trainid_ros.ros.playback import BagPlayer  # noqa: PLC0415

    arguments = start_ros(args.ros_args)
    overrides = [Parameter(name, value=value) for name, value in _parameters(args).items()]
    player = BagPlayer(arguments, parameter_overrides=overrides)
    if not player.bring_up():
        raise _refused(player.failure, [player])
    with progress(f'playing {args.bag.name}', player.timeline.duration_s) as advance:
        shown = _Shown(player, advance)
        spin_nodes([player], until=shown.is_done)
    return 0


def _refused(failure: str, nodes: Sequence[ManagedNode]) -> InputError:
    """Return the error of a node that cannot be brought up, and end ROS with all nodes."""
    from trainid_ros.ros.node import close_nodes, stop_ros  # noqa: PLC0415

    close_nodes(nodes)
    stop_ros()
    return InputError(failure)


def _parameters(args: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of the player."""
    return {
        'bag': str(args.bag.absolute()),
        'bag_namespace': args.namespace,
        'mapping_file': '' if args.map is None else str(args.map.absolute()),
        'max_chunk': args.max_chunk >> 20,
        'rate': args.rate,
        'start': args.start,
        'duration': args.duration,
        'loop': args.loop,
        'wait': args.wait,
    }


class _Shown:
    """Advances the progress bar with the player."""

    def __init__(self, player: BagPlayer, advance: Callable[[float], None]) -> None:
        self._player = player
        self._advance = advance
        self._shown_ns = player.timeline.first_ns

    def is_done(self) -> bool:
        """Update the progress; return True at the end."""
        position = self._player.position_ns
        if position:
            self._advance((position - self._shown_ns) / NS_PER_S)
            self._shown_ns = position
        return self._player.finished


# Times between two screens, and between two lines of text [s].
_SCREEN_S: Final = 0.25
_LINES_S: Final = 1.0
# Time for which ROS may be looking for publishers before the duration begins [s].
_DISCOVERY_S: Final = 3.0
_ASCII_LOCALES: Final = ('C', 'POSIX')


def monitor(args: argparse.Namespace) -> int:
    """Show what is published until SIGINT or SIGTERM, or for a time; return 1 if nothing was in that time.

    Raises:
        InputError: A ROS argument cannot be used, or ROS is not installed.
    """
    # ROS and rich are imported only here, so that other commands work without them.
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415

    from trainid_ros.monitor.screen import Lines, Screen  # noqa: PLC0415
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
