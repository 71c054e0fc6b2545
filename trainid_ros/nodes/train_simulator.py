# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``train_simulator``: a simulated train on the input topics, in real time.

Without ``publish_clock`` its stamps are those of the present, as a real train's would be.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.core.errors import InputError
from trainid_ros.nodes.parameter_specs import TRAIN_FILE, ParameterSpec
from trainid_ros.nodes.playback import TimedRecord, Timeline
from trainid_ros.nodes.playback_node import PlaybackNode, playback_parameters
from trainid_ros.nodes.runner import run_node
from trainid_ros.physics.train_file import load_train_file
from trainid_ros.simulation.scenario import Scenario, simulate

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.core.records import Record

NAME: Final = 'train_simulator'
_PARAMETERS: Final = (
    TRAIN_FILE,
    ParameterSpec('runs', 4, 'runs from stop to stop; takes effect on the next configure', 1, 1000),
    ParameterSpec('seed', 1, 'seed of the random numbers; takes effect on the next configure', 0, 2**31 - 1),
    *playback_parameters(live=True),
)


class TrainSimulator(PlaybackNode):
    """Simulates on configure, publishes while active."""

    def __init__(self, arguments: Any = (), **options: Any) -> None:
        super().__init__(NAME, _PARAMETERS, arguments=arguments, **options)

    def open_timeline(self) -> Timeline:
        """Simulate.

        Raises:
            InputError: The train file is missing or cannot be driven.

        """
        path = str(self.parameters.value('train_file'))
        if not path:
            msg = 'no train: give the parameter train_file'
            raise InputError(msg)
        train_file = load_train_file(Path(path).expanduser())
        scenario = Scenario(train_file, runs=int(self.parameters.value('runs')))
        records = simulate(scenario, np.random.default_rng(int(self.parameters.value('seed')))).records
        return Timeline(records[0].stamp_ns, records[-1].stamp_ns, lambda: _entries(records))


def _entries(records: tuple[Record, ...]) -> Iterator[TimedRecord]:
    return (TimedRecord(record.stamp_ns, record) for record in records)


def main() -> int:
    """Run the node as a program."""
    return run_node(TrainSimulator)
