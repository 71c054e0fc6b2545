# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``bag_player``: publishes a bag's inputs and ``/clock`` in bag order, paced by log time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag import missing_package_error
from trainid_ros.errors import InputError
from trainid_ros.ros.parameter_specs import ParameterSpec
from trainid_ros.ros.playback import PlaybackNode, TimedRecord, Timeline, playback_parameters
from trainid_ros.ros.runner import run_node

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.bag.reader import BagReader

NAME: Final = 'bag_player'
_PARAMETERS: Final = (
    ParameterSpec('bag', '', 'rosbag2 directory or .mcap file; takes effect on the next configure'),
    ParameterSpec('bag_namespace', '/', 'namespace of the topics in the bag; takes effect on the next configure'),
    ParameterSpec('max_chunk', 64, 'largest chunk to unpack [MB]; takes effect on the next configure', 1, 4095),
    *playback_parameters(live=False),
)


class BagPlayer(PlaybackNode):
    """Lifecycle node that plays a bag."""

    def __init__(self, arguments: Any = (), **options: Any) -> None:
        self._reader: BagReader | None = None
        super().__init__(NAME, _PARAMETERS, arguments=arguments, **options)

    def open_timeline(self) -> Timeline:
        """Open the bag.

        Raises:
            InputError: It cannot be read or has no messages on the input topics, or the packages for bags are missing.

        """
        path = str(self.parameters.value('bag'))
        if not path:
            msg = 'no bag: give the parameter bag'
            raise InputError(msg)
        # Imported here so that the node can name what is missing.
        try:
            from trainid_ros.bag.reader import BagReader  # noqa: PLC0415

            max_chunk = int(self.parameters.value('max_chunk')) << 20
            reader = BagReader(path, str(self.parameters.value('bag_namespace')), max_chunk).__enter__()
        except ModuleNotFoundError as error:
            raise missing_package_error(error) from None
        self._reader = reader
        for warning in reader.warnings:
            self.get_logger().warning(warning)
        span = reader.time_range()
        if span is None or not reader.input_count:
            self.close_timeline()
            msg = f'{path}: no messages on the input topics'
            raise InputError(msg)
        return Timeline(span[0], span[1], lambda: _entries(reader))

    def close_timeline(self) -> None:
        """Close the bag."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _entries(reader: BagReader) -> Iterator[TimedRecord]:
    return (TimedRecord(entry.log_ns, entry.record) for entry in reader.logged_records())


def main() -> int:
    """Run the node as a program."""
    return run_node(BagPlayer)
