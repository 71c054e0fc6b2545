# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``bag_player``: publishes a bag's inputs and ``/clock`` in bag order, paced by log time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trainid_ros.bag import missing_package_error
from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.mapping import OWN
from trainid_ros.mapping.mapping_file import load_mapping
from trainid_ros.ros.playback import (
    ForeignOutput,
    PlaybackNode,
    StoredMessage,
    TimedRecord,
    Timeline,
    playback_parameters,
)
from trainid_ros.ros.runner import run_node
from trainid_ros.setup.parameter_specs import ParameterSpec

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.bag.reader import BagReader
    from trainid_ros.mapping.mapping import Mapping

NAME: Final = 'bag_player'
_PARAMETERS: Final = (
    ParameterSpec('bag', '', 'rosbag2 directory, .mcap or .db3 file; takes effect on the next configure'),
    ParameterSpec('bag_namespace', '/', 'namespace of the topics in the bag; takes effect on the next configure'),
    ParameterSpec('mapping_file', '', 'mapping file, whose topics are played; takes effect on the next configure'),
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
            raise InputError('no bag: give the parameter bag')
        # Imported here so that the node can name what is missing.
        try:
            from trainid_ros.bag.reader import BagReader  # noqa: PLC0415

            max_chunk = int(self.parameters.value('max_chunk')) << 20
            namespace = str(self.parameters.value('bag_namespace'))
            reader = BagReader(path, namespace, max_chunk, mapping=self._mapping()).__enter__()
        except ModuleNotFoundError as error:
            raise missing_package_error(error) from None
        self._reader = reader
        for warning in reader.warnings:
            self.get_logger().warning(warning)
        span = reader.time_range()
        if span is None or not reader.input_count:
            self.close_timeline()
            raise InputError(f'{path}: no messages on the input topics')
        foreign = {name: ForeignOutput(kind.name, kind.digest) for name, kind in reader.mapped_types().items()}
        return Timeline(*span, lambda: _entries(reader), foreign, reader.mapping.replaced)

    def _mapping(self) -> Mapping:
        path = str(self.parameters.value('mapping_file'))
        return load_mapping(Path(path).expanduser()) if path else OWN

    def close_timeline(self) -> None:
        """Close the bag."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None


def _entries(reader: BagReader) -> Iterator[TimedRecord]:
    for log_ns, topic, content in reader.stored():
        yield TimedRecord(log_ns, StoredMessage(topic, content) if isinstance(content, bytes) else content)


def main() -> int:
    """Run the node as a program."""
    return run_node(BagPlayer)
