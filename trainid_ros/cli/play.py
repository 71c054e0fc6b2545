# SPDX-License-Identifier: Apache-2.0
"""``trainid play``: publish a bag's inputs with ``/clock``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trainid_ros.cli.bags import opened
from trainid_ros.cli.output import progress
from trainid_ros.inputs.mapping import OWN, load_mapping
from trainid_ros.interface.errors import InputError
from trainid_ros.interface.records import NS_PER_S

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from trainid_ros.ros.playback import BagPlayer


def run(args: argparse.Namespace) -> int:
    """Play a bag to its end or until SIGINT or SIGTERM.

    Raises:
        InputError: The bag or a ROS argument cannot be used.
    """
    mapping = OWN if args.map is None else load_mapping(args.map)
    with opened(args, mapping=mapping):
        pass  # an unreadable bag is reported before ROS starts
    # ROS is imported only here, so that other commands work without it.
    from rclpy.parameter import Parameter  # noqa: PLC0415

    from trainid_ros.ros.node import close_nodes, spin_nodes, start_ros, stop_ros  # noqa: PLC0415
    from trainid_ros.ros.playback import BagPlayer  # noqa: PLC0415

    arguments = start_ros(args.ros_args)
    overrides = [Parameter(name, value=value) for name, value in _parameters(args).items()]
    player = BagPlayer(arguments, parameter_overrides=overrides)
    if not player.bring_up():
        failure = player.failure
        close_nodes([player])
        stop_ros()
        raise InputError(failure)
    with progress(f'playing {args.bag.name}', player.timeline.duration_s) as advance:
        shown = _Shown(player, advance)
        spin_nodes([player], until=shown.is_done)
    return 0


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
