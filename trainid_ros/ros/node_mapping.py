# SPDX-License-Identifier: Apache-2.0
"""The mapping of an estimator node, from its parameter ``mapping_file``."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from trainid_ros.interface.errors import InputError
from trainid_ros.mapping.mapped_inputs import mapped_inputs
from trainid_ros.mapping.mapping import OWN
from trainid_ros.mapping.mapping_file import load_mapping
from trainid_ros.setup.parameter_specs import MAPPING_FILE

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node

    from trainid_ros.mapping.mapped_inputs import MappedInputs
    from trainid_ros.setup.pipelines import EstimatorSettings
    from trainid_ros.train.train_file import TrainFile


class NodeMapping:
    """Where the inputs of a node come from, if not from our own topics.

    Attributes:
        topics: Topics that the file names, known from the start as they have parameters; none if it cannot be used,
            which is said on configure.
    """

    def __init__(self, node: Node) -> None:
        """Read the file, if the node is given one."""
        self._node = node
        self._make: Callable[[], MappedInputs] | None = None
        self._mapping = OWN
        self.topics: tuple[str, ...] = ()
        given = node._parameter_overrides.get(MAPPING_FILE.name)  # rclpy gives no public access to them
        if given is not None and isinstance(given.value, str) and given.value:
            with suppress(InputError):
                self.topics = load_mapping(Path(given.value).expanduser()).topics

    def configure(self, train_file: TrainFile, settings: EstimatorSettings) -> EstimatorSettings:
        """Read the file again; return settings that fit it.

        Raises:
            InputError: The file cannot be used.
        """
        path = str(self._node.get_parameter(MAPPING_FILE.name).value)
        self._make = mapped_inputs(Path(path).expanduser() if path else None, train_file)
        self._mapping = OWN if (inputs := self.inputs()) is None else inputs.mapping
        if inputs is None:
            return settings
        return replace(settings, alignment=inputs.mapping.alignment(settings.alignment))

    def named(self, text: str) -> str:
        """Return a text for people with the topics that are read in place of our own ones."""
        return self._mapping.named(text)

    def inputs(self) -> MappedInputs | None:
        """Return what makes records of the messages of foreign topics, None without a mapping."""
        return None if self._make is None else self._make()
