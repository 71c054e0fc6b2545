# SPDX-License-Identifier: Apache-2.0
"""``trainid run``, ``play`` and ``monitor``: the verbs on a ROS graph, which import ROS when they run."""

from __future__ import annotations

import math
import os
import sys
import time
from contextlib import nullcontext
from io import TextIOWrapper
from typing import TYPE_CHECKING

from trainid_ros.cli.arguments import LIVE_NODES
from trainid_ros.cli.output import EXIT_NO_ANSWER, opened, progress, show
from trainid_ros.inputs.mapped_inputs import mapped_inputs
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.interface.errors import InputError, NoAnswerError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from trainid_ros.ros.node import ManagedNode


def run_nodes(args: argparse.Namespace) -> int:
    """Run the nodes until SIGINT or SIGTERM; NoAnswerError if others have shut some down, at once if all."""
    if args.train is not None:
        mapped_inputs(args.map, load_train_file(args.train))
    elif args.map is not None:
        load_mapping(args.map)
    names = tuple(dict.fromkeys(args.node)) if args.node else LIVE_NODES
    files = {'train_file': args.train, 'mapping_file': args.map, 'record_folder': args.record}
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.estimator_node import SPECS, EstimatorNode  # noqa: PLC0415
    from trainid_ros.ros.inputs import SharedInputs  # noqa: PLC0415
    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415

    arguments = start_ros(args.ros_args)
    overrides = [Parameter(name, value=str(path.absolute())) for name, path in files.items() if path is not None]
    inputs = SharedInputs()
    nodes = [EstimatorNode(SPECS[name], arguments, inputs, parameter_overrides=overrides) for name in names]
    for node in nodes:
        node.is_quiet = True
        if not node.bring_up():
            raise _refused(f'{node.get_name()}: {node.failure}', nodes)
        node.is_quiet = False
        print(f'{node.get_name()} is active: {node.about()}; {node.shared.parameters.given_values}', flush=True)
    ended = set[str]()

    def is_over() -> bool:
        ended.update(node.get_name() for node in nodes if node.state == 'finalized')
        return len(ended) == len(nodes)

    spin_nodes(nodes, until=is_over)
    if ended:
        raise NoAnswerError(f'{", ".join(sorted(ended))}: shut down by a request of another process')
    return 0


def play(args: argparse.Namespace) -> int:
    """Play a bag to its end or until SIGINT or SIGTERM."""
    mapping = OWN if args.map is None else load_mapping(args.map)
    with opened(args, mapping=mapping):
        pass  # an unreadable bag is reported before ROS starts
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415
    from trainid_ros.ros.playback import BagPlayer  # noqa: PLC0415

    arguments = start_ros(args.ros_args)
    parameters = {
        'bag': str(args.bag.absolute()),
        'bag_namespace': args.namespace,
        'mapping_file': '' if args.map is None else str(args.map.absolute()),
        'max_chunk': args.max_chunk >> 20,
        **{name: getattr(args, name) for name in ('rate', 'start', 'duration', 'loop', 'wait')},
    }
    overrides = [Parameter(name, value=value) for name, value in parameters.items()]
    player = BagPlayer(arguments, parameter_overrides=overrides)
    if not player.bring_up():
        raise _refused(player.failure, [player])
    shown_ns = player.timeline.first_ns
    with progress(f'playing {args.bag.name}', player.timeline.duration_s) as advance:

        def is_done() -> bool:
            nonlocal shown_ns
            if position := player.position_ns:
                advance((position - shown_ns) / NS_PER_S)
                shown_ns = position
            return player.finished

        spin_nodes([player], until=is_done)
    return 0


def _refused(failure: str, nodes: Sequence[ManagedNode]) -> InputError:
    """Return the error of a node that cannot be brought up, and end ROS with all nodes."""
    from trainid_ros.ros.node import close_nodes  # noqa: PLC0415

    close_nodes(nodes)
    return InputError(failure)


def monitor(args: argparse.Namespace) -> int:
    """Show what is published until SIGINT or SIGTERM, or for a time; return 1 if nothing was in that time."""
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415

    from trainid_ros.monitor.screen import Lines, Screen  # noqa: PLC0415
    from trainid_ros.ros.node import spin_nodes, start_ros  # noqa: PLC0415
    from trainid_ros.ros.train_monitor import TrainMonitor  # noqa: PLC0415

    node = TrainMonitor(start_ros(args.ros_args), args.namespace)
    # Python replaces this locale by one with Unicode, which terminals that are set to it may lack.
    if os.environ.get('LC_ALL') in {'C', 'POSIX'} and isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(encoding='ascii', errors='replace')
    console = Console()
    # Not Console.is_terminal, which FORCE_COLOR makes true for files.
    draws = sys.stdout.isatty() and not console.is_dumb_terminal and not os.environ.get('NO_COLOR')
    lines = Lines()

    def print_lines() -> None:
        for line in lines.of(node.views(), node.notice):
            show(line)
        sys.stdout.flush()

    with Live(console=console, screen=True, auto_refresh=False) if draws else nullcontext() as live:
        display = (
            Display(1.0, args.duration, print_lines)
            if live is None
            else Display(0.25, args.duration, lambda: live.update(Screen(node.views(), node.notice), refresh=True))
        )
        spin_nodes([node], until=lambda: display.draw_if_due(has_found=bool(node.trains.by_namespace)))
    return EXIT_NO_ANSWER if display.is_over and not node.trains.has_messages(time.monotonic()) else 0


class Display:
    """Draws at intervals, for a time that begins when a train is found, or ROS has had time to find one."""

    def __init__(
        self, every_s: float, duration_s: float, draw: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.is_over = False  # at the end of the time
        self._every_s = every_s
        self._duration_s = duration_s or math.inf
        self._draw = draw
        self._clock = clock
        self._next_s = clock()
        self._begin_s = self._next_s + 3.0  # ROS may be looking for publishers until then

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
