# SPDX-License-Identifier: Apache-2.0
"""Types of railway in the simulator: each has a train on its line, a load and a driver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Final

from trainid_ros.errors import InputError
from trainid_ros.package_files import shared_path
from trainid_ros.sim.driver import DriverModel
from trainid_ros.train.fields import did_you_mean
from trainid_ros.train.train_file import TrainFile, load_train_file


@dataclass(frozen=True, slots=True)
class World:
    """A type of railway.

    Attributes:
        train: Name of its train file in ``config/trains``.
        passengers: Maximum load as a share of the mass [1].
        driver: Parameters of the driver.
        mean_speed: Typical mean speed from stop to stop, without dwell [m/s].

    """

    train: str
    passengers: float
    driver: DriverModel
    mean_speed: float


_EMU: Final = DriverModel(
    acceleration=0.8, deceleration=0.6, dwell_low=30.0, dwell_high=60.0, cruise_low=15.0, cruise_high=80.0
)
_HIGH_SPEED: Final = DriverModel(
    acceleration=0.5,
    deceleration=0.5,
    max_deceleration=1.0,
    jerk=0.5,
    dwell_low=60.0,
    dwell_high=120.0,
    cruise_low=30.0,
    cruise_high=200.0,
)
# A brake with 7 s of dead time and lag allows only low gains and stops less accurately.
_FREIGHT: Final = DriverModel(
    acceleration=0.3,
    deceleration=0.15,
    max_deceleration=0.6,
    jerk=0.3,
    dwell_low=60.0,
    dwell_high=120.0,
    cruise_low=40.0,
    cruise_high=200.0,
    coast_floor=0.85,
    holding=0.4,
    brake_gain=0.15,
    brake_integral=0.005,
    stop_window=4.0,
)
_TRAM: Final = DriverModel(
    acceleration=1.1,
    deceleration=0.9,
    max_deceleration=1.6,
    jerk=1.2,
    speed_margin=0.5,
    dwell_low=15.0,
    dwell_high=30.0,
    cruise_low=2.0,
    cruise_high=12.0,
    coast_floor=0.75,
)
WORLDS: Final[Mapping[str, World]] = MappingProxyType(
    {
        'metro': World('yizhuang', 0.25, DriverModel(), 14.0),
        'emu': World('emu', 0.15, _EMU, 21.0),
        'high_speed': World('high_speed', 0.08, _HIGH_SPEED, 37.0),
        'freight': World('freight', 0.05, _FREIGHT, 16.0),
        'tram': World('tram', 0.3, _TRAM, 7.7),
    }
)


def find_world(name: str) -> World:
    """Return a world by its name.

    Raises:
        InputError: There is no such world.

    """
    if name not in WORLDS:
        msg = f'world {name!r} is not known; {did_you_mean(name, WORLDS)}'
        raise InputError(msg)
    return WORLDS[name]


def world_train(world: World) -> TrainFile:
    """Return the train file of a world.

    Raises:
        InputError: The file is not part of this installation.

    """
    return load_train_file(shared_path(f'config/trains/{world.train}.yaml'))


def usual_duration(world: World, stops: tuple[float, ...], runs: int) -> float:
    """Return the approximate duration [s] of a number of runs over these stops [m], including dwell."""
    if len(stops) < 2:
        return 0.0
    there = [after - before for before, after in pairwise(stops)]
    round_trip = [*there, *reversed(there)]
    distance = sum(round_trip[i % len(round_trip)] for i in range(runs))
    return distance / world.mean_speed + runs * 0.5 * (world.driver.dwell_low + world.driver.dwell_high)
