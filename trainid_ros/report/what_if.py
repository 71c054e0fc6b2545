# SPDX-License-Identifier: Apache-2.0
"""What a change of the train file means for operation: running time, energy and stopping distance.

Plant and driver of the simulator go along the line and back, without gusts, passengers and dwells. The driver never
coasts: it runs as fast as train and line allow, which depends neither on chance nor on when coasting ends.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from trainid_ros.client.train_model import TrainModel
from trainid_ros.interface.errors import NoAnswerError, TrainIdError
from trainid_ros.interface.records import NS_PER_S
from trainid_ros.report.words import DASH, number
from trainid_ros.resistance.suggested_drive import KM_H, top_speed
from trainid_ros.sim.plant import Driver, DriverModel, Plant
from trainid_ros.sim.scenario import DEFAULT_START_NS, MAX_RUN_S, TICK_NS
from trainid_ros.train.line import profile_of

if TYPE_CHECKING:
    from trainid_ros.train.train_file import TrainFile

_DRIVER: Final = DriverModel(cruise_low=MAX_RUN_S, cruise_high=MAX_RUN_S)
# Steps of 0.1 s change running times and energies by 0.1 % against those of 0.02 s, in a third of the time.
_STEPS: Final = 2  # Steps between two decisions of the driver
_J_PER_KWH: Final = 3.6e6


def what_if_rows(before: TrainFile, after: TrainFile) -> list[tuple[str, str, str, str, str]]:
    """Return quantity, unit, values by two train files, and the change; none if they are equal or give no value."""
    if before == after:
        return []
    speed = top_speed(before)
    names = (
        ('running time, rising positions', 's'),
        ('traction energy, rising positions', 'kWh'),
        ('running time, falling positions', 's'),
        ('traction energy, falling positions', 'kWh'),
        (f'stopping distance from {speed / KM_H:.0f} km/h, rising positions', 'm'),
    )
    return [
        (*name, number(old), number(new), f'{new / old - 1.0:+.1%}' if old > 0.0 and math.isfinite(new) else DASH)
        for name, old, new in zip(names, _values(before, speed), _values(after, speed), strict=True)
        if not (math.isnan(old) and math.isnan(new))
    ]


def _values(train_file: TrainFile, speed: float) -> list[float]:
    """Return the values of all rows by a train file, NaN where it gives none."""
    values = [math.nan] * 5
    with suppress(TrainIdError):
        values[4] = TrainModel(None, train_file).stopping_distance(speed).value
    with suppress(TrainIdError):
        values[:4] = *drive(train_file, 1), *drive(train_file, -1)
    return values


def drive(train_file: TrainFile, direction: int) -> tuple[float, float]:
    """Return running time [s] and energy of the traction [kWh] along the line in a direction.

    Raises:
        InputError: An effect cannot be evaluated.
        NoAnswerError: The line has no two stops, or the train does not reach one.
    """
    stops, profile = train_file.line.stops[::direction], profile_of(train_file)
    if len(stops) < 2:
        raise NoAnswerError(f'line.stops has {len(stops)} stops; a drive needs at least 2')
    train = Plant(train_file, profile, DEFAULT_START_NS, _DRIVER.jerk)
    train.position, train.direction = stops[0], direction
    driver = Driver(_DRIVER, train_file, profile, np.random.default_rng(0))
    for stop in stops[1:]:
        start_ns, arrived = train.now_ns, len(driver.arrivals)
        driver.depart(stop)
        while len(driver.arrivals) == arrived:
            if train.now_ns - start_ns > MAX_RUN_S * NS_PER_S:
                raise NoAnswerError(f'the train does not reach stop {stop:g} m within {MAX_RUN_S:g} s')
            decision = driver.decide((train.now_ns - DEFAULT_START_NS) / NS_PER_S, train)
            train.command(decision.brake)
            for _ in range(_STEPS):
                train.step(decision.traction, TICK_NS // _STEPS)
    return (train.now_ns - DEFAULT_START_NS) / NS_PER_S, train.work / _J_PER_KWH
