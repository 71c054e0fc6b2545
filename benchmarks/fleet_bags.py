# SPDX-License-Identifier: Apache-2.0
"""Fleets of the simulator with the faults that are looked for, on the line of the metro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from trainid_ros.sim import worlds
from trainid_ros.sim.scenario import Simulation
from trainid_ros.sim.worlds import WORLDS, FleetDay, FleetTrain, world_train
from trainid_ros.train.train_file import Effect, TrainFile

FAULTS: Final = ('dragging_brake', 'worn_pads', 'wheel_diameter', 'wrong_weighing')


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a train from a day on: one of FAULTS, and how much of its usual range, from 0 to 1."""

    kind: str
    size: float
    onset: int

    @property
    def effect(self) -> Effect:
        """The effect of the library."""
        match self.kind:
            case 'dragging_brake':
                return Effect(self.kind, (('permille', 1.0 + 2.0 * self.size), ('time', 40.0)))
            case 'worn_pads':
                return Effect('brake_scale', (('ratio', 0.94 - 0.09 * self.size),))
            case 'wheel_diameter':
                return Effect(self.kind, (('ratio', 1.012 + 0.018 * self.size),))
        return Effect('mass_error', (('ratio', 1.05 + 0.07 * self.size),))


def stated_train() -> TrainFile:
    """Return the train file of the whole fleet."""
    return worlds.fleet_train(world_train(WORLDS['metro']))


def drive(
    seed: int, train: FleetTrain, day: FleetDay, fault: Fault | None = None, runs: int = 6, run: int = 0
) -> Simulation:
    """Simulate one drive of a train; a fault acts if it is given."""
    effects = () if fault is None else (fault.effect,)
    return worlds.drive(
        worlds.Fleet(WORLDS['metro'], world_train(WORLDS['metro']), seed), train, day, effects, runs, run
    )
