# SPDX-License-Identifier: Apache-2.0
"""Lifecycle node ``train_simulator``: publishes a simulated train on the input topics, in real time.

Without ``publish_clock`` its stamps are those of the present, as a real train's would be.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from trainid_ros.interface.errors import InputError
from trainid_ros.ros.playback import PlaybackNode, TimedRecord, Timeline, playback_parameters
from trainid_ros.ros.runner import run_node
from trainid_ros.setup.parameter_specs import TRAIN_FILE, ParameterSpec
from trainid_ros.sim.scenario import Scenario, simulate
from trainid_ros.sim.worlds import REALISMS, WORLDS, find_world, make_case, unknowns_of, world_train
from trainid_ros.train.train_file import load_train_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from trainid_ros.interface.records import Record

NAME: Final = 'train_simulator'
_PARAMETERS: Final = (
    TRAIN_FILE,
    ParameterSpec(
        'world',
        '',
        'type of railway, with its own train unless train_file is given, whose values are the stated ones, not true; '
        'takes effect on the next configure',
        choices=('', *WORLDS),
    ),
    ParameterSpec(
        'realism',
        'clean',
        'with world only: clean, the train file is exact, or field, it has errors as on real trains; '
        'takes effect on the next configure',
        choices=tuple(REALISMS),
    ),
    ParameterSpec('runs', 4, 'runs from stop to stop; takes effect on the next configure', 1, 1000),
    ParameterSpec('seed', 1, 'seed of the random numbers; takes effect on the next configure', 0, 2**31 - 1),
    *playback_parameters(live=True),
)


class TrainSimulator(PlaybackNode):
    """Lifecycle node that simulates on configure and publishes while active."""

    def __init__(self, arguments: Any = (), **options: Any) -> None:
        super().__init__(NAME, _PARAMETERS, arguments=arguments, **options)

    def open_timeline(self) -> Timeline:
        """Simulate, and return the records as a timeline.

        Raises:
            InputError: The train file is missing or cannot be simulated.
        """
        rng = np.random.default_rng(int(self.parameters.value('seed')))
        records = simulate(self._scenario(rng), rng).records
        return Timeline(records[0].stamp_ns, records[-1].stamp_ns, lambda: _entries(records))

    def _scenario(self, rng: np.random.Generator) -> Scenario:
        path, name = str(self.parameters.value('train_file')), str(self.parameters.value('world'))
        realism, runs = str(self.parameters.value('realism')), int(self.parameters.value('runs'))
        if not (path or name):
            raise InputError('no train: give the parameter train_file or world')
        given = load_train_file(Path(path).expanduser()) if path else None
        if not name and given:
            if realism != 'clean':
                raise InputError(f'realism = {realism!r} needs the parameter world')
            return Scenario(given, runs=runs)
        world = find_world(name)
        stated = given or world_train(world)
        return make_case(world, stated, unknowns_of(realism, (), stated), runs, rng.spawn(1)[0]).scenario


def _entries(records: tuple[Record, ...]) -> Iterator[TimedRecord]:
    return (TimedRecord(record.stamp_ns, record) for record in records)


def main() -> int:
    """Run the node as a program."""
    return run_node(TrainSimulator)
